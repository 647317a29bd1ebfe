"""Bounded minimisation of many functions at once."""
