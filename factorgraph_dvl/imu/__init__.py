"""Samples of the IMU to increments, preintegrated segments and motion at any time."""
