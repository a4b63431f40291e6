"""Score each cell of the elevation map as a foothold."""
