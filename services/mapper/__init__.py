"""Mapper: elevation map with variance, and a foothold score for each cell."""
