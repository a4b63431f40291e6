"""Fuzzing of every message and file parser: `python -m benchmarks fuzz`."""
