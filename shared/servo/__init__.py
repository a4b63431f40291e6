"""Speak to servos: Dynamixel packets, the bridge protocol, framing and the fault table."""
