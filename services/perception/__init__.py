"""Owns the depth camera and where the robot is: cameras, scan reduction, registration."""
