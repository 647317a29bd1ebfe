"""Motions as tables, trees in files, arms for other engines."""
