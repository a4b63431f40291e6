"""Emulate the servos, their bus and the microcontroller bridge, down to the bytes."""
