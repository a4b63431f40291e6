"""Live run over Zenoh: services as processes, with its observers."""
