"""Motion in time: integration, its steps, and batches of motions."""
