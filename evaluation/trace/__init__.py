"""A run as arrays: received messages, ground truth, touchdowns."""
