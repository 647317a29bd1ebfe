"""Kinematics and equations of motion at one instant, without force elements."""
