"""Find and follow a path to a goal over the terrain map."""
