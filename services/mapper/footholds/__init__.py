"""Score how well each cell of the elevation map carries a foot."""
