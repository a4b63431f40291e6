"""Firmware of the bridge, for MicroPython and for the simulator: docs/firmware.md.

Its modules use only what MicroPython 1.27 and CPython have in common, so a board, the simulator and all tests run the same
files.
"""
