"""Evaluation of a run from ground truth and recorded messages."""
