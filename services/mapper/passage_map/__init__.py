"""Map a passage from a merged point cloud, and choose the next best view of it."""
