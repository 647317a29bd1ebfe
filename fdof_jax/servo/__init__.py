"""Loops, margins and responses of servos."""
