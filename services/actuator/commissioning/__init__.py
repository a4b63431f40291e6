"""Set up a robot's servos: bus scan, ids, calibration, joint test and torque off."""
