"""Models of MuJoCo: read, written, and the law of its actuators."""
