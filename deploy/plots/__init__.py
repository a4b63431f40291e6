"""Figures of recorded runs, one run by itself or several beside each other."""
