"""Static analysis of a robot profile: what the robot can do, and which value limits it."""
