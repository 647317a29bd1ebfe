"""Gains that minimise a loss, and how far their gradients can be trusted."""
