"""The equations at one instant, without forces and without time."""
