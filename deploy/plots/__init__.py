"""Figures of recorded runs, of one run or of several for comparison."""
