"""A page that plays motions in a browser."""
