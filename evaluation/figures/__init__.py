"""Figures of runs: maps, walks, passages, comparisons and the figures of the theses."""
