"""Identification of an arm's parameters from recorded motions."""
