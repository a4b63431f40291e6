"""Video of a walk, rendered from its recording after the run."""
