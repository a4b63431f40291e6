"""Describe runs: terrain, start, goal, robot, movers and faults."""
