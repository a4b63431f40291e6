"""Recordings: what the wire carried, in MCAP files that people's tools open too."""
