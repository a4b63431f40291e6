"""Faults injected into walks, in lockstep and live, what the robot did then, and how that is to the limits."""
