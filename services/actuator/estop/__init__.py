"""Stop path: receives `off` independently of the actuator and latches it."""
