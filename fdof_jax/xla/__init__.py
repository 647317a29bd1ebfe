"""Helpers for XLA that know nothing of arms: settings, sines, loops, checks."""
