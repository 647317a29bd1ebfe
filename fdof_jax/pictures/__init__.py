"""Pictures, animations and sliders, by matplotlib."""
