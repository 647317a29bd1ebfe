"""Gain tuning by gradients, optimal efforts, and checks of the gradients."""
