"""Map a passage from a merged point cloud, and choose its next best view."""
