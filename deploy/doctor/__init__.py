"""Checks of a machine: installation, compilation, timing, servos and camera."""
