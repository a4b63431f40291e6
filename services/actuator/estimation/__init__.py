"""Estimate what the legs and the inertial sensor measure: contact, touchdown, odometry and attitude."""
