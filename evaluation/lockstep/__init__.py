"""Runs with all services in one process, on simulated time."""
