"""Depth cameras behind one interface, selected by name in the robot's profile."""
