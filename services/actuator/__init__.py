"""Owns the servos: trajectories, servo bus, and the guard that is the last gate."""
