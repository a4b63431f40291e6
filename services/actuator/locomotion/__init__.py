"""Turn plans into joint goals: step execution, swing and body trajectories, standing up and sitting down."""
