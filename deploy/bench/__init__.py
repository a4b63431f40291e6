"""Benchmarks: accuracy on generated scenes, and speed compared with peers."""
