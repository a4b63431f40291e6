"""Turn plans into joint goals: steps, trajectories, standing up, sitting down."""
