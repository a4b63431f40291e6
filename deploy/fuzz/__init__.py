"""Fuzzing of every message and file parser: `sextant fuzz`."""
