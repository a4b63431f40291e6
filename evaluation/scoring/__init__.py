"""The verdict on a run: success or failure, its cause, and the figures of its report."""
