"""Estimate contact, touchdown, odometry and attitude from legs and IMU."""
