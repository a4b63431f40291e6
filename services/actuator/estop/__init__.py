"""The stop path: hears `off` beside the actuator, and latches it whatever becomes of that."""
