"""Simulate the depth camera, the color camera and the inertial sensor."""
