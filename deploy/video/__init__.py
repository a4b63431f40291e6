"""Moving pictures of a walk, drawn from its recording after the run: for people, and for nothing that steers a robot."""
