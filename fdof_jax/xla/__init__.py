"""What XLA needs, and nothing about arms: precision, sines, loops, checks."""
