"""Calibration of the camera and the legs, from a standing robot that moves its body over a flat floor."""
