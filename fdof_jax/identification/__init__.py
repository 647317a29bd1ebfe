"""Parameters of an arm from recorded motions."""
