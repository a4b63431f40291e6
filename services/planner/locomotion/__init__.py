"""Plan one step: gait, footholds, body pose and leg clearance."""
