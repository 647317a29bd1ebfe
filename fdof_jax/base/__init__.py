"""Helpers that know nothing of arms: checks, files, XLA and its arithmetic."""
