"""Example of plug-ins for Sextant."""
