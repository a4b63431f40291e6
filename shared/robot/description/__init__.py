"""Import of robot descriptions: links and joints as a robot profile."""
