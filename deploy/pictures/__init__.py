"""Pictures of runs, for people, who look before they read."""
