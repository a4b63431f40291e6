"""Simulation of the robot, terrain and moving obstacles in MuJoCo."""
