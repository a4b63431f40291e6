"""What judges, shows and repeats a walk, without live processes."""
