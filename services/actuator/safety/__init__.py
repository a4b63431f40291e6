"""Decide what may move the legs: commands, leases, plan validation, health limits and the torque-off latch."""
