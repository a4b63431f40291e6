"""Read and write files: whole or not at all, of bounded size, with one clear error."""
