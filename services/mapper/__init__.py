"""Owns the terrain map: elevation with its variance, and how well each cell carries a foot."""
