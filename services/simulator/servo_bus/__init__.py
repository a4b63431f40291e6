"""Byte-level emulation of the servos, their bus and the microcontroller bridge."""
