"""Replay of recordings through the real services, compared with the old results."""
