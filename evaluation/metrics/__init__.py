"""Metrics of a walk and of its maps against the true ground."""
