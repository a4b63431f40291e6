"""Operator console: a web server that shows the robot and forwards commands."""
