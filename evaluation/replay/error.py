"""Error for recordings that cannot be replayed."""

from sextant.shared.errors import SextantError


class ReplayError(SextantError, ValueError):
    """A recording does not fit; the message states where."""
