"""Health of servos that answer: errors, voltage and temperature; one problem for what many of them have in common."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from sextant.services.actuator.servo_bus.bus_scan import Problem, ServoScan, each_of, named
from sextant.shared.servo.servo_model import ServoError, error_words

WARM = 10.0  # [deg C] below its limit from which a servo is too warm to start
_ADVICE = "correct this before anything moves"


class _Kind(NamedTuple):
    """Kind of abnormality that servos may have in common."""

    words: str  # with {} in place of the measured value
    digits: int  # of the value after the decimal point

    def of(self, values: Iterable[float]) -> str:
        """Return it for measured values."""
        return self.words.format(span(values, self.digits))


def span(values: Iterable[float], digits: int) -> str:
    """Return values as "10.9 to 11.1", or as one number if they are equal."""
    low, *_, high = (f"{value:.{digits}f}" for value in (2 * sorted(values)))
    return low if low == high else f"{low} to {high}"


def health_problems(seen: Mapping[int, ServoScan], low: float, names: Mapping[int, str]) -> list[Problem]:
    """Return abnormal voltages, temperatures and errors of servos, as one problem where many have the same.

    Args:
        seen: The servos by id, with clear responses.
        low: [V] lowest voltage, from the profile's battery.
        names: Id -> leg and joint of the robot's servos.
    """
    kinds: dict[_Kind, dict[int, float]] = {}
    for i, one in seen.items():
        for kind, value in _abnormal(one, low).items():
            kinds.setdefault(kind, {})[i] = value
    found: list[str] = []
    for kind, values in kinds.items():
        if many := each_of(values, names):
            found.append(f"{many} {kind.of(values.values())}")
        else:
            found += [f"{named(i, names)} {kind.of([value])}" for i, value in values.items()]
    return [Problem(words, _ADVICE) for words in found]


def health_problem(seen: ServoScan, low: float) -> str:
    """Return what is abnormal of one servo, or an empty string; see `health_problems`."""
    return "; ".join(kind.of([value]) for kind, value in _abnormal(seen, low).items())


def _abnormal(seen: ServoScan, low: float) -> dict[_Kind, float]:
    """Return what is abnormal of a servo, with the measured value."""
    limit, found = seen[seen.expected.table.temperature_limit], dict[_Kind, float]()
    if error := error_of(seen):
        found[_Kind(f"reports {error}; {remedy_of(seen)}", 0)] = 0.0
    if seen.voltage < low:
        found[_Kind(f"has {{}} V, at least {low:.1f} V expected: charge the battery", 1)] = seen.voltage
    if seen.temperature > limit - WARM:
        found[_Kind(f"is {{}} deg C hot, its limit is {limit}: let it cool", 0)] = seen.temperature
    return found


def error_of(seen: ServoScan) -> str:
    """Return shutdown reason, errors and reduced torque limit, or an empty string."""
    table, share = seen.expected.table, 100 * seen.expected.units.torque
    weak = seen[table.torque_limit] < seen[table.max_torque]
    left = f"a torque limit of {share * seen[table.torque_limit]:.0f} %" if weak else ""
    return ", ".join(filter(None, (error_words(seen.error), left)))


def remedy_of(seen: ServoScan) -> str:
    """Return what ends the errors of a servo."""
    table, volt = seen.expected.table, seen.expected.units.volt
    if seen.error != ServoError.INPUT_VOLTAGE or seen[table.torque_limit] < seen[table.max_torque]:
        return "switch its power off and on again"
    return f"supply it with {volt * seen[table.min_voltage]:.1f} to {volt * seen[table.max_voltage]:.1f} V, its limits"
