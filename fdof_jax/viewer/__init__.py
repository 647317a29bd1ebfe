"""A window on motions: a page that plays them in a browser, written by `view`."""
