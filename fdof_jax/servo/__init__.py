"""What control engineers ask of a servo: its loops, margins and responses."""
