"""Pictures and animations, by matplotlib."""
