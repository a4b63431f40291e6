"""Faults injected into walks in lockstep, what the robot did then, and how that is to the limits."""
