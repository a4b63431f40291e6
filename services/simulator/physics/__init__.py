"""Simulate the robot and its terrain in MuJoCo."""
