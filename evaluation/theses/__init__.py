"""Figures and tables of both theses, drawn from our data next to the printed numbers."""
