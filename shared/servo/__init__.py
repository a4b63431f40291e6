"""Communicate with servos: Dynamixel packets, bridge protocol, framing and faults."""
