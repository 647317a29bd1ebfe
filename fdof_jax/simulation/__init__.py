"""Motion in time: the equations that are integrated, and what is read from them."""
