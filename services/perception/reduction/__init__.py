"""Reduce a depth frame to one point per map cell, with free-space rays and colors."""
