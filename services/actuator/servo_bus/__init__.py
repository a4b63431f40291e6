"""Talk to the servos: serial port, Dynamixel bus, microcontroller bridge and validation of readings."""
