"""Owns where the feet go: gait, foothold search, body motion."""
