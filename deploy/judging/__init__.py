"""Judges a run by its truth and by what was heard of it: arrays, figures, and the report that they come to."""
