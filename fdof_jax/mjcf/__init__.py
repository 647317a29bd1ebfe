"""Models of MuJoCo, read and written."""
