"""What one asks of a motion or a configuration: reactions, linearisation."""
