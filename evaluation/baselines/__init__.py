"""Published planners as plug-ins, to compare with on the same ground, map, actuator and scorer."""
