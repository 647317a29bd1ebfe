"""The runs behind the command line."""
