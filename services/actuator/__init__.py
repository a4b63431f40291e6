"""Actuator service: servo bus, leg trajectories and the guard of all motion."""
