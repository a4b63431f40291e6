"""What is wrong with a recording that is to be replayed."""


class ReplayError(ValueError):
    """What in the recording does not fit, with the place."""
