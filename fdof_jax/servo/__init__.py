"""Servos: drives, linearisation about rest, loops, margins, signals, responses."""
