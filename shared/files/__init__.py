"""Read and write files: atomic writes, bounded size, and clear errors."""
