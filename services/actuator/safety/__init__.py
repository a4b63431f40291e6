"""Authorize leg motion: commands, leases, plans, health limits, torque-off latch."""
