"""Simulation of the depth camera, the colour camera and the IMU."""
