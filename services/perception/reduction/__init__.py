"""Reduction of a depth frame to one point per map cell, free rays and colours."""
