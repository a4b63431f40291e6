"""Depth cameras behind one interface, each opened by the name that the robot's profile gives it."""
