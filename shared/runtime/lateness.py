"""Ages of the inputs of services, and detection of a computer that is too slow.

Each service declares how old its inputs may be (`Limited`). Its worker measures the age of each input at every use, and sends
the worst ages of every second with its health. `SlowComputer` evaluates these reports. A computer is too slow if inputs are
already old when they arrive, or if cycles are late. An input that is old only because no newer one has arrived means that its
producer has stopped.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from sextant.shared.wire.messages import Health

BEAT = "beat"  # time from one beat of a service's own clock to the next
STALL = "stall"  # longest time for which a live service waited in vain for a message
MAX_STALL_S = 0.5  # [s] the wait ends every 0.2 s, unless the computer is too slow
_OLDEST_S = 1e3  # [s] a larger age means that the stamp is wrong
_LATE_SHARE = 0.1  # [1] share of late uses in one report from which the input counts as late
_KEPT_NS = 4_500_000_000  # [ns] time span of the evaluated reports
_REPORTS = 2  # number of these reports in which the same input must be late; a single one may be a restart
_ALREADY = 0.75  # [1] age on arrival, as a share of the limit, from which the producers are too slow
_COMFORT = 0.6  # [1] share of its limit up to which an input may age before simulated time waits
_WAITED_FOR_NS = {"actuator/state": 100_000_000}  # [ns] lower limit for some inputs: legs walk 180 ms without another plan
_SHOWN = 2  # late inputs in one text
_NAMES = {
    "camera/depth": "depth frames",
    "actuator/state": "leg states",
    "perception/pose": "poses",
    "perception/scan": "scans",
    "mapper/terrain": "maps",
    "planner/step": "step plans",
}
_CHAIN = (*reversed(_NAMES), STALL, BEAT)  # in order from plans back to depth frames


@runtime_checkable
class Limited(Protocol):
    """Service with age limits for its inputs."""

    @property
    def max_age_s(self) -> Mapping[str, float]:
        """Topic key or BEAT -> maximum usable age [s]."""
        ...


@dataclass(frozen=True, slots=True)
class InputAge:
    """Ages of one input of a service at its uses, over about one second."""

    what: str  # topic key, BEAT or STALL
    age_s: float  # [s] worst age
    arrived_s: float  # [s] worst age on arrival
    limit_s: float  # [s]
    late: float  # [1] share of the uses over the limit

    def words(self, service: str) -> str:
        """Return the worst age and the limit as text."""
        figures = f"{_seconds(self.age_s)} s", f"{_seconds(self.limit_s)} s allowed"
        if self.what == STALL:
            return f"the {service} process did not run for {figures[0]}, {figures[1]}"
        if self.what == BEAT:
            return f"the {service} cycle takes {figures[0]}, {figures[1]}"
        return f"{_NAMES[self.what]} are {figures[0]} old, {figures[1]}"


class InputAges:
    """Ages of a service's inputs since its last report."""

    def __init__(self, max_age_s: Mapping[str, float]):
        """Measure the inputs that have a limit.

        Args:
            max_age_s: Topic key, BEAT or STALL -> age [s].
        """
        self.limit_ns = {what: round(limit_s * 1e9) for what, limit_s in max_age_s.items()}
        self._uses: dict[str, list[int]] = {}  # worst age [ns], worst at arrival [ns], uses, late uses
        self._left_ns: dict[str, float] = {}  # how much older each input used in the current step may get

    def note(self, what: str, age_ns: int, arrived_ns: int | None = None) -> None:
        """Note one use of an input.

        Args:
            what: Name of the input; inputs without a limit are ignored.
            age_ns: Age [ns] at the use.
            arrived_ns: Age [ns] on arrival; `age_ns` by default.
        """
        limit_ns = self.limit_ns.get(what)
        if limit_ns is None:
            return
        if what not in (BEAT, STALL):
            self._left_ns[what] = min(_COMFORT * limit_ns, _WAITED_FOR_NS.get(what, limit_ns)) - age_ns
        worst = self._uses.setdefault(what, [0, 0, 0, 0])
        worst[0] = max(worst[0], age_ns)
        worst[1] = max(worst[1], age_ns if arrived_ns is None else arrived_ns)
        worst[2] += 1
        worst[3] += age_ns > limit_ns

    def forget_uses(self) -> None:
        """Forget which inputs the finished step has used."""
        self._left_ns = {}

    def left_ns(self) -> float | None:
        """Return how much older [ns] the inputs of this step may get.

        Simulated time waits beyond that.

        Returns None if the step used no input with a limit.
        """
        return min(self._left_ns.values(), default=None)

    def report(self) -> tuple[InputAge, ...]:
        """Return the ages since the last report, and start a new one."""
        found = tuple(
            InputAge(
                what,
                min(max(age_ns, 0) * 1e-9, _OLDEST_S),
                min(max(arrived_ns, 0) * 1e-9, _OLDEST_S),
                self.limit_ns[what] * 1e-9,
                late / uses,
            )
            for what, (age_ns, arrived_ns, uses, late) in self._uses.items()
        )
        self._uses = {}
        return found


def ages_of(health: Health) -> tuple[InputAge, ...]:
    """Return the ages in a Health message, without unknown or impossible ones."""
    columns = (health.input_age_s, health.input_arrived_s, health.input_limit_s, health.input_late_share)
    rows = np.stack(columns, axis=1).tolist()
    ages = (InputAge(what, *row) for what, row in zip(health.inputs, rows, strict=True))
    return tuple(age for age in ages if age.what in _CHAIN and _is_measured(age))


def _is_measured(age: InputAge) -> bool:
    """Return whether the values can come from `InputAges`.

    A received report is not trusted.
    """
    return 0.0 < age.limit_s <= _OLDEST_S and 0.0 <= age.late <= 1.0 and max(abs(age.age_s), abs(age.arrived_s)) <= _OLDEST_S


class SlowComputer:
    """Detects from the reports of services whether a computer is too slow for them."""

    def __init__(self, real_time: bool = True, linked: bool = False, computer: str = "this computer"):
        """Start without reports.

        Args:
            real_time: Whether services run in real time; in lockstep no computer is too slow.
            linked: Whether a link between machines may be too slow; the attribute may change later.
            computer: Name of the computer in the text.
        """
        self.linked = linked
        self.severity = (False, 0.0)  # of the last text: whether inputs are late, and the worst age as a share of its limit [1]
        self._real_time, self._computer = real_time, computer
        self._reports: deque[tuple[int, str, InputAge]] = deque()  # arrival [ns], service, age; only late ones
        self._heard_ns: dict[str, int] = {}  # arrival of the newest health of each service

    def update(self, services: Mapping[str, tuple[Health, int]]) -> list[tuple[str, Health]]:
        """Add health reports, and return the new ones.

        Args:
            services: Name -> newest health and its arrival time [ns].
        """
        new = [(name, health, at_ns) for name, (health, at_ns) in services.items() if at_ns > self._heard_ns.get(name, -1)]
        self._heard_ns = {name: at_ns for name, (_, at_ns) in services.items()}
        for name, health, at_ns in new:
            self._reports += [(at_ns, name, age) for age in ages_of(health) if age.late >= _LATE_SHARE]
        return [(name, health) for name, health, _ in new]

    def words(self, now_ns: int) -> str:
        """Return a text that the computer is too slow, or an empty text.

        It lists the latest inputs.
        """
        while self._reports and now_ns - self._reports[0][0] > _KEPT_NS:
            self._reports.popleft()
        worst: dict[tuple[str, str], InputAge] = {}
        counts: dict[tuple[str, str], int] = {}
        for _, service, age in self._reports:
            key = service, age.what
            counts[key] = counts.get(key, 0) + 1
            if key not in worst or age.age_s > worst[key].age_s:
                worst[key] = age
        late = {key: age for key, age in worst.items() if counts[key] >= _REPORTS}
        slow = (
            (age.what in (BEAT, STALL) and self._real_time) or age.arrived_s > _ALREADY * age.limit_s for age in late.values()
        )
        causes = ((self._computer,) if self._real_time else ()) + (("the link between the machines",) if self.linked else ())
        if not (causes and any(slow)):
            return ""
        order = sorted(late.items(), key=lambda item: (item[1].what in (BEAT, STALL), -item[1].age_s / item[1].limit_s))
        first = order[0][1]
        self.severity = first.what not in (BEAT, STALL), first.age_s / first.limit_s
        # Sorted in a fixed order, so that the text stays the same while the numbers change.
        shown = sorted(order[:_SHOWN], key=lambda item: (_CHAIN.index(item[1].what), item[0]))
        return f"{' or '.join(causes)} is too slow: {'; '.join(age.words(service) for (service, _), age in shown)}"


def _seconds(duration_s: float) -> str:
    return f"{duration_s:.1f}" if duration_s >= 0.95 else f"{duration_s:.2g}"
