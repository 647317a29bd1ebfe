"""What is commanded: controllers, drives, paths and their timing."""
