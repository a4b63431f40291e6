"""Error for recordings that cannot be replayed."""


class ReplayError(ValueError):
    """A recording does not fit; the message states where."""
