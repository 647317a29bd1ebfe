"""Tables of motions, files of pytrees, and export to other engines."""
