"""Record, read and recover runs, in MCAP files that other tools can open."""
