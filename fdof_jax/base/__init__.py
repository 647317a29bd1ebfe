"""Helpers that know nothing of arms: checks, names, files, XLA and its arithmetic."""
