"""Rate of the control cycle that this computer holds. Pure: time is an input."""

SHARES = (1.0, 2.0 / 3.0, 0.5)  # possible rates, of the nominal one
_LATE_PERIODS = 1.4  # [periods] from one cycle to the next from which a cycle is late
_FITS_PERIODS = 1.1  # [periods] longest time that a cycle needs at a rate that the computer holds
_HELD_PERIODS = 1.55  # [periods] the same at the lowest rate, at which some cycles may be late
_TOO_MANY = 4.0  # count of late cycles from which the rate falls; the health monitor stops the robot after five in a row
_PUNCTUAL = 0.25  # by which a punctual cycle lowers that count
_SPARE = 0.8  # largest share of a higher rate's period that a cycle may take for that rate to be held
_HIGHER_AFTER_S = 10.0  # [s] of cycles short enough for the next higher rate, from which the rate rises
_SLOW_COUNTS = 4.0  # times their duration that longer cycles take away from that time


class ControlRate:
    """Lowers the rate of the control cycle while the computer is too slow for it, and raises it again.

    If the computer holds none of the rates, the rate stays; the health monitor then stops the robot.
    """

    def __init__(self, nominal_hz: float):
        """Begin at the nominal rate [Hz]."""
        self._nominal_hz = nominal_hz
        self._level = 0  # index of the present rate in `SHARES`
        self._late = 0.0  # count of late cycles, lowered by punctual ones
        self._spare_s = 0.0  # [s] of cycles short enough for the next higher rate

    @property
    def share(self) -> float:
        """Present rate as a share of the nominal one."""
        return SHARES[self._level]

    @property
    def period_ns(self) -> int:
        """Present period [ns]."""
        return round(1e9 / (self._nominal_hz * self.share))

    @property
    def warning(self) -> str:
        """Warning that the rate is lower than the nominal one, or an empty string."""
        if not self._level:
            return ""
        nominal, present = f"{self._nominal_hz:.0f}", f"{self._nominal_hz * self.share:.0f}"
        return f"the computer is too slow for {nominal} control cycles per second: it runs {present}; walking slower"

    def note(self, since_last_s: float, took_s: float) -> bool:
        """Note a cycle, and return whether the rate changes.

        Args:
            since_last_s: [s] from the begin of the last cycle to that of this one.
            took_s: [s] that this cycle took, with its waits for the servo bus.
        """
        period_s = self.period_ns * 1e-9
        late = since_last_s > _LATE_PERIODS * period_s
        self._late = self._late + 1.0 if late else max(self._late - _PUNCTUAL, 0.0)
        # A cycle that takes longer than a period skips the next one: the time between two cycles is longer than needed.
        needed_s = took_s if took_s > period_s else since_last_s
        if self._late >= _TOO_MANY and (lower := self._held(needed_s)):
            return self._change(lower)
        if not self._level:
            return False
        higher_s = 1.0 / (self._nominal_hz * SHARES[self._level - 1])
        spare = not late and took_s <= _SPARE * higher_s
        self._spare_s = self._spare_s + period_s if spare else max(self._spare_s - _SLOW_COUNTS * period_s, 0.0)
        return self._spare_s >= _HIGHER_AFTER_S and self._change(self._level - 1)

    def _held(self, needed_s: float) -> int:
        """Return the highest lower rate at which a cycle may take `needed_s`, as an index in `SHARES`; 0 for none."""
        lowest = len(SHARES) - 1
        for level in range(self._level + 1, len(SHARES)):
            periods = _FITS_PERIODS if level < lowest else _HELD_PERIODS
            if needed_s <= periods / (self._nominal_hz * SHARES[level]):
                return level
        return 0

    def _change(self, level: int) -> bool:
        self._level = level
        self._late = self._spare_s = 0.0
        return True
