"""Broken messages for whatever takes in something that others have made: `sextant fuzz`."""
