"""Planner: gait, footholds, body motion, path following and gap crossing."""
