"""Live and recorded data for Foxglove and rerun."""
