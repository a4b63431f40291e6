"""Simulator with the interfaces of the real hardware.

It contains the MuJoCo world, the terrain, the depth camera and the servo bus emulator.
"""
