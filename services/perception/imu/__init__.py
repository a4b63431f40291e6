"""Inertial sensors: their readings as messages in the body frame."""
