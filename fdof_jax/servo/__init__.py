"""Servos: equilibria, linearisation, loops and margins, test signals, responses."""
