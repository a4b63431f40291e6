"""A running robot: start-up, servo bus, recording, radio link, fleet, soak."""
