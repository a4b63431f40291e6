"""Fault injection into walks, in lockstep and live.

It measures the robot's reaction and compares it with limits.
"""
