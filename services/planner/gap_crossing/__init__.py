"""Crossing of a gap that ends the ground: detection, approach, survey, and the walk of planned sections."""
