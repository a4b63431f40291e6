"""Talk to the servos: serial port, Dynamixel bus, bridge, reading validation."""
