"""Independent processes that meet only on the wire; each imports `shared` and itself."""
