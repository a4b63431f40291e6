"""Perception: depth cameras, scan reduction and registration of the robot's pose."""
