"""The table of faults: actions on a walk, durations, and required reactions.

A number without a limit is infinite. Times count from the start of the fault unless stated otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Literal

from sextant.shared.scenario.mover import BoxMover, LegsMover, Mover
from sextant.shared.scenario.scenario import CameraFaultKind
from sextant.shared.servo.bus_fault import BusFault


@dataclass(frozen=True, slots=True)
class Away:
    """A process is unavailable.

    If killed, a new process replaces it. If stopped, the same one continues, unless the launcher detects that it hangs.
    """

    service: Literal[
        "planner", "actuator", "stop", "perception", "mapper", "operator", "router", "base router", "console", "recorder"
    ]
    kill: bool
    for_s: float  # in live walks, a killed process restarts as soon as possible, and is killed again during this time
    after_s: float = 0.0  # after the start of the fault


@dataclass(frozen=True, slots=True)
class Meddling:
    """The planner runs, but its messages are manipulated."""

    how: Literal["mute", "repeating", "fuzzed"]
    for_s: float


@dataclass(frozen=True, slots=True)
class OnBus:
    """A fault of servos, bus or power supply."""

    fault: BusFault  # starts at time 0, for servo 0 if it concerns a servo
    any_servo: bool = False  # replace servo 0 by a random servo

    @property
    def for_s(self) -> float:
        """Duration [s]."""
        return self.fault.for_s


@dataclass(frozen=True, slots=True)
class Off:
    """Torque is ordered off, and the order is repeated as an operator's page does."""

    from_s: float = 0.05  # a random time between the two, after the start of the fault
    until_s: float = 0.8
    for_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Clock:
    """The wall clock is stepped, and stepped back at the end."""

    step_s: float
    for_s: float


@dataclass(frozen=True, slots=True)
class Late:
    """The actuator's cycles take too long, as on a slow computer; lockstep only."""

    cycle_s: float
    for_s: float


@dataclass(frozen=True, slots=True)
class Hogs:
    """Other processes compute, one per core, with the services' priority; live only."""

    for_s: float


@dataclass(frozen=True, slots=True)
class OnCamera:
    """A fault of the camera or its images, or something that moves in its view."""

    what: CameraFaultKind | Mover
    for_s: float  # a mover ends by itself


Deed = Away | Meddling | OnBus | Off | Clock | Late | Hogs | OnCamera


@dataclass(frozen=True, slots=True)
class Limits:
    """The required reaction of the robot; it must never fall."""

    decided_s: float = inf  # until it reports that it stops
    named: str = ""  # pattern of the reported reason, with {servo} for the ID
    rest_s: float = inf  # until it stands still
    margin_m: float = -inf  # minimum stability margin in the three seconds after the fault's start
    unnamed_margin_m: float = -inf  # the same until a lie is named
    again_s: float = inf  # until it walks again, from the fault's end
    jump_deg: float = inf  # of a joint, from the fault's end until it walks again
    lunge_dps: float = inf  # [deg/s] of a joint, from the reset of a shutdown
    off_s: float = inf  # until the servos receive torque off; from the order, or from the bus' return
    torque_stays: bool = True  # no command switches torque
    walks_on: bool = False  # it does not stop
    cycle_s: float = inf  # p99 of the interval between sync writes of goals; five missed cycles in a row are reported
    goal_dps: float = inf  # [deg/s] of a goal from one cycle to the next
    lost_s: float = inf  # of a recording, from the last stored message to the kill
    seated: bool = False  # it sits with torque off before a servo shuts down or the battery is empty
    reasons: str = ""  # pattern of the reasons with which it may stand during the fault, or at its end
    stands: bool = False  # it may also stand at the end, with such a reason
    place_m: float = inf  # change of the error of the estimated position, from the start of the fault to the end


@dataclass(frozen=True, slots=True)
class Case:
    """One fault of the table."""

    name: str
    words: str
    deeds: tuple[Deed, ...]
    limits: Limits = field(default_factory=Limits)
    per_walk: int = 6  # injections in one walk in sequence, or each into a copy if they end the walk
    warm_c: float = 0.0  # [deg C] initial temperature of the random servo; 0 for the default
    charge: float = 1.0  # initial charge of the battery
    watch_s: float = 8.0  # [s] maximum observation after the fault's end
    live: bool = False  # processes over Zenoh in real time; else in lockstep
    course: str = ""  # scenario to walk, with every injection into a copy of the walk; empty for level ground
    lies: bool = False  # a lie of a leg, which does not end; the margin is evaluated over its whole duration
    halves: bool = False  # mapper, planner, page and operator use a separate router, as on another machine

    @property
    def for_s(self) -> float:
        """Duration [s]."""
        return max(deed.for_s + (deed.after_s if isinstance(deed, Away) else 0.0) for deed in self.deeds)

    @property
    def concerns_one(self) -> bool:
        """Whether one random servo is faulty."""
        return any(isinstance(deed, OnBus) and deed.any_servo for deed in self.deeds)

    @property
    def lets_go(self) -> bool:
        """Whether torque is ordered off."""
        return any(isinstance(deed, Off) for deed in self.deeds)

    @property
    def ends_the_walk(self) -> bool:
        """Whether it is injected into a copy of the walk, because the robot does not walk on, or not far enough."""
        return self.lets_go or self.limits.seated or self.lies or bool(self.course)


_OUT_S = 2.0  # [s] duration of a fault
_RESTART_S = 1.0  # [s] until a killed actuator has restarted: detected, started, imported
_STOPPED_S = 3.4  # [s] duration of a stopped actuator
_STOPPED = Limits(decided_s=3.5, jump_deg=2.0)
_STOPS = Limits(decided_s=0.28, named="no new plan", rest_s=0.7, margin_m=0.010, again_s=2.0)
_ONE_SERVO = Limits(decided_s=0.25, named=r"\(id {servo}\)", again_s=3.0)
_NO_BUS = Limits(decided_s=0.25, named="no servo answers|port", again_s=3.0)
# More than 30 % loss for 200 ms stops the robot. With 40 % drawn at random, 40 requests in a row reach that
# only after 0.44 s in 4 of 1000 cases, after 0.8 s in 2 of 100 000.
_MOSTLY_LOST = Limits(decided_s=0.8, named="lost or broken|does not answer|no servo answers", again_s=3.0)
_TOO_SLOW = Limits(decided_s=0.5, named="too slow: 5 cycles in a row", margin_m=0.010, again_s=2.0)
_CALM = Limits(walks_on=True)
_LETS_GO = Limits(off_s=0.060, torque_stays=False)
_LETS_GO_LATE = Limits(off_s=0.100, torque_stays=False)  # a late cycle and the packet


def _bus(target: str, kind: str, for_s: float = _OUT_S, **values: object) -> OnBus:
    fault = BusFault(target, kind, 0.0, for_s, **{"servo": 0, **values} if target == "servo" else values)  # type: ignore[arg-type]
    return OnBus(fault, any_servo=target == "servo" or kind == "heat")


def _lost(share: float, for_s: float = 4.0) -> OnBus:
    return _bus("packets", "silent", for_s, share=share)


def _corrupted(share: float, for_s: float = 4.0) -> OnBus:
    return _bus("packets", "wrong", for_s, share=share, part="two bytes")


_BROKEN_BUSES: tuple[tuple[str, str, OnBus], ...] = (
    ("lost-10", "10 % of the answers lost", _lost(0.10, _OUT_S)),
    ("lost-40", "40 % of the answers lost", _lost(0.40, _OUT_S)),
    ("bytes-lost", "1 % of the bytes lost, both ways", _bus("bytes", "silent", share=0.01)),
    ("bytes-garbage", "1 % of the bytes garbage, both ways", _bus("bytes", "garbage", share=0.01)),
    ("noise-bursts", "bursts of noise, 50 of every 250 ms", _bus("bytes", "intermittent")),
    ("packets-noisy", "noise in front of 20 % of the answers", _bus("packets", "garbage", share=0.20)),
    ("servo-silent", "one servo silent", _bus("servo", "silent")),
    ("servo-garbage", "one servo answers with garbage", _bus("servo", "garbage")),
    ("servo-slow", "one servo's answers 16 ms late", _bus("servo", "slow")),
    ("servo-intermittent", "one servo's cable is loose", _bus("servo", "intermittent", on_ms=200.0, off_ms=200.0)),
    ("bus-silent", "no servo receives, no servo answers", _bus("bus", "silent")),
    ("bus-stuck", "the line is held", _bus("bus", "stuck")),
    ("bus-garbage", "the line is full of garbage", _bus("bus", "garbage")),
    ("bus-wrong", "each answer repeats the one before", _bus("bus", "wrong")),
    ("bus-slow", "every answer 16 ms late", _bus("bus", "slow")),
    ("bus-intermittent", "the bus is away for 50 of every 250 ms", _bus("bus", "intermittent")),
    ("bus-gone", "the adapter is unplugged and comes back under another name", _bus("bus", "gone", renamed=True)),
)
_REST_OF_THE_GRID: tuple[tuple[str, str, OnBus], ...] = (
    ("bytes-stuck", "1 % of the bytes become 255, both ways", _bus("bytes", "stuck", share=0.01, value=255)),
    ("bytes-wrong", "1 % of the bytes with one bit flipped, both ways", _bus("bytes", "wrong", share=0.01)),
    ("bytes-slow", "1 % of the bytes from servos 16 ms late", _bus("bytes", "slow", share=0.01)),
    ("packets-stuck", "10 % of the answers replaced by the one before", _bus("packets", "stuck", share=0.10)),
    ("packets-slow", "10 % of the answers 16 ms late", _bus("packets", "slow", share=0.10)),
    ("packets-intermittent", "every answer lost, 50 of every 250 ms", _bus("packets", "intermittent")),
)
_ODD_SERVOS: tuple[tuple[str, str, OnBus], ...] = (
    ("servo-stuck", "one servo's position register does not change", _bus("servo", "stuck")),
    ("servo-wrong", "one servo's position register is 29 deg off", _bus("servo", "wrong")),
    ("servo-jammed", "one joint does not move", _bus("servo", "jammed", 1.0)),
)
# Legs that lie: the robot must name the leg while it stands safely. Link and encoder differ after a slip, a jump and a drift.
_LIES = Limits(unnamed_margin_m=0.010)
_LIARS: tuple[tuple[str, str, OnBus], ...] = (
    ("servo-slipped", "one horn slips by 20 deg", _bus("servo", "slipped", 6.0, degrees=20.0)),
    ("servo-jump", "one encoder jumps by 20 deg", _bus("servo", "jump", 6.0, degrees=20.0)),
    ("servo-drift", "one encoder drifts by 3 deg/s", _bus("servo", "drift", 9.0, deg_per_s=3.0)),
    ("servo-bit", "bit 6 of one goal register is stuck at 0", _bus("servo", "bit", 6.0, bit=6)),
    ("servo-sign", "one load register has the wrong sign", _bus("servo", "sign", 6.0)),
    ("servo-weak", "one servo has 30 % of its torque", _bus("servo", "weak", 6.0, share=0.3)),
)
_LIMITS_OF_BUSES = {
    "lost-40": _MOSTLY_LOST,
    "servo-silent": _ONE_SERVO,
    "servo-garbage": _ONE_SERVO,
    **dict.fromkeys(("bus-silent", "bus-stuck", "bus-garbage", "bus-gone"), _NO_BUS),
}
_HUNG, _REPEATING, _FUZZED = Meddling("mute", _OUT_S), Meddling("repeating", _OUT_S), Meddling("fuzzed", 1.0)
_SAG, _STEPPED = _bus("supply", "sag", 0.4, volts=3.0), Clock(3600.0, 3.0)
_SLOW, _LATE = Late(0.04, 1.0), Late(0.07, 1.0)  # as slow as it may walk, and slower

_OFF: tuple[tuple[str, str, tuple[Deed, ...]], ...] = (
    ("off", "the actuator is killed a second later", (Off(), Away("actuator", True, 0.5, 1.5))),
    *((f"off-{name}", words, (deed, Off())) for name, words, deed in (*_BROKEN_BUSES, *_REST_OF_THE_GRID, *_ODD_SERVOS)),
    *((f"off-{name}", words, (OnBus(replace(deed.fault, for_s=_OUT_S), True), Off())) for name, words, deed in _LIARS),
    ("off-lost-1", "1 % of the answers lost", (_lost(0.01, _OUT_S), Off())),
    ("off-corrupted-1", "1 % of the answers broken", (_corrupted(0.01, _OUT_S), Off())),
    ("off-corrupted-10", "10 % of the answers broken", (_corrupted(0.10, _OUT_S), Off())),
    ("off-overload", "one servo has shut down", (_bus("servo", "overload"), Off())),
    ("off-heat", "one servo is heated by 10 K/s", (_bus("servo", "heat", kelvin_per_s=10.0), Off())),
    ("off-hot-reading", "one servo's temperature reads 85 deg C", (_bus("servo", "hot"), Off())),
    ("off-drain", "the battery runs empty within 4 s", (_bus("supply", "drain", 4.0), Off())),
    ("off-sag", "the voltage is 3 V lower for 0.4 s", (_SAG, Off(until_s=0.4))),
    ("off-planner-killed", "the planner is killed", (Away("planner", True, _OUT_S), Off())),
    ("off-planner-hung", "the planner hangs", (_HUNG, Off())),
    ("off-planner-repeating", "the planner repeats its last plans", (_REPEATING, Off())),
    ("off-fuzzed-plans", "thousands of fuzzed plans", (_FUZZED, Off())),
    ("off-clock-stepped", "the wall clock is stepped by an hour", (_STEPPED, Off())),
    ("off-actuator-slow", "the actuator's cycles take 40 ms each", (_SLOW, Off())),
    ("off-actuator-late", "the actuator's cycles take 70 ms each", (_LATE, Off())),
    ("off-actuator-killed", "the actuator is killed", (Away("actuator", True, _RESTART_S), Off())),
    ("off-actuator-stopped", "the actuator is stopped", (Away("actuator", False, _OUT_S), Off())),
)

CASES: tuple[Case, ...] = (
    Case("planner-killed", "the planner is killed, another comes after 2 s", (Away("planner", True, _OUT_S),), _STOPS),
    Case("planner-hung", "the planner hangs for 2 s, its heartbeat goes on", (_HUNG,), _STOPS),
    Case("planner-repeating", "the planner repeats its last plans", (_REPEATING,), _STOPS),
    Case(
        "actuator-killed",
        "the actuator is killed, another is there after 1 s",
        (Away("actuator", True, _RESTART_S),),
        Limits(decided_s=1.5, jump_deg=2.0),
    ),
    Case(
        "actuator-stopped",
        "the actuator is stopped for 3.4 s",
        (Away("actuator", False, _STOPPED_S),),
        _STOPPED,
    ),
    Case("actuator-slow", "the actuator's cycles take 40 ms each, for 1 s", (_SLOW,), Limits(margin_m=0.010)),
    Case("actuator-late", "the actuator's cycles take 70 ms each, for 1 s", (_LATE,), _TOO_SLOW),
    Case("lost-1", "1 % of the answers lost", (_lost(0.01),), _CALM),
    Case("corrupted-1", "1 % of the answers broken", (_corrupted(0.01),), _CALM),
    Case("corrupted-10", "10 % of the answers broken", (_corrupted(0.10),)),
    *(
        Case(name, words, (deed,), _LIMITS_OF_BUSES.get(name, Limits()))
        for name, words, deed in (*_BROKEN_BUSES, *_REST_OF_THE_GRID, *_ODD_SERVOS)
    ),
    *(Case(name, words, (deed,), _LIES, watch_s=0.0, lies=True) for name, words, deed in _LIARS),
    Case(
        "overload",
        "one servo has shut down for its load",
        (_bus("servo", "overload", 0.5),),
        Limits(rest_s=1.0, named=r"\(id {servo}\)", again_s=10.0, lunge_dps=30.0),
        watch_s=12.0,
    ),
    Case(
        "heat",
        "one servo, 58 deg C warm, is heated by 1 K/s",
        (_bus("servo", "heat", 30.0, kelvin_per_s=1.0),),
        Limits(torque_stays=False, seated=True),
        warm_c=58.0,
        watch_s=0.0,
    ),
    Case("hot-reading", "one servo's temperature reads 85 deg C for 0.25 s", (_bus("servo", "hot", 0.25),), _CALM),
    Case(
        "drain",
        "the battery, nearly empty, runs empty within 60 s",
        (_bus("supply", "drain", 60.0),),
        Limits(torque_stays=False, seated=True),
        charge=0.12,
        watch_s=0.0,
    ),
    Case("sag", "the voltage is 3 V lower for 0.4 s", (_SAG,), _CALM),
    Case("fuzzed-plans", "thousands of fuzzed plans for 1 s", (_FUZZED,), Limits(goal_dps=354.0)),  # the servos' maximum speed
    Case("clock-stepped", "the wall clock is stepped by an hour", (_STEPPED,), _CALM),
    *(
        Case(
            name,
            f"torque is ordered off; {words}",
            deeds,
            _LETS_GO_LATE if _LATE in deeds else _LETS_GO,
            per_walk=12,
            watch_s=1.0,
        )
        for name, words, deeds in _OFF
    ),
)

_BACK_AT_ONCE = replace(_STOPS, rest_s=inf)  # before it has come to rest
_GOES_ON = Limits(named="no new plan", margin_m=0.010, again_s=8.0)
_UNHEARD = Limits(margin_m=0.010, again_s=8.0)  # its decision is received once the router forwards it
_LIVE: tuple[tuple[str, str, tuple[Deed, ...], Limits], ...] = (
    ("planner-killed", "the planner is killed", (Away("planner", True, 0.0),), _BACK_AT_ONCE),
    ("planner-crashing", "the planner is killed, and its successors are, for 2 s", (Away("planner", True, _OUT_S),), _STOPS),
    ("planner-stopped", "the planner is stopped for 2 s", (Away("planner", False, _OUT_S),), _STOPS),
    ("perception-killed", "perception is killed", (Away("perception", True, 0.0),), _GOES_ON),
    ("perception-stopped", "perception is stopped for 2 s", (Away("perception", False, _OUT_S),), _GOES_ON),
    ("mapper-killed", "the mapper is killed", (Away("mapper", True, 0.0),), Limits(margin_m=0.010)),
    ("mapper-stopped", "the mapper is stopped for 3 s", (Away("mapper", False, 3.0),), _GOES_ON),
    ("operator-killed", "the operator's side is killed", (Away("operator", True, 0.0),), Limits(margin_m=0.010)),
    ("operator-crashing", "the operator's side is killed again and again for 5 s", (Away("operator", True, 5.0),), _GOES_ON),
    ("router-killed", "the router is killed", (Away("router", True, 0.0),), _UNHEARD),
    ("router-stopped", "the router is stopped for 2 s", (Away("router", False, _OUT_S),), _UNHEARD),
    ("stop-killed", "the stop path is killed", (Away("stop", True, 0.0),), _CALM),
    ("stop-stopped", "the stop path is stopped for 3 s", (Away("stop", False, 3.0),), _CALM),
    ("actuator-killed", "the actuator is killed", (Away("actuator", True, 0.0),), Limits(decided_s=1.5, jump_deg=2.0)),
    (
        "actuator-stopped",
        "the actuator is stopped for good; the launcher detects that it hangs",
        (Away("actuator", False, _STOPPED_S),),
        _STOPPED,
    ),
    ("servo-silent", "one servo silent", (_bus("servo", "silent"),), _ONE_SERVO),
    ("bus-silent", "no servo receives, no servo answers", (_bus("bus", "silent"),), _NO_BUS),
    ("bus-gone", "the adapter is unplugged and comes back", (_bus("bus", "gone"),), _NO_BUS),
    ("hogs", "a busy process for each core, 5 s long", (Hogs(5.0),), Limits(cycle_s=0.025)),
    ("off", "torque is ordered off", (Off(),), _LETS_GO),
    (
        "off-actuator-killed",
        "torque is ordered off; the actuator is killed",
        (Away("actuator", True, 0.0), Off(until_s=0.3)),
        _LETS_GO,
    ),
    (
        "off-actuator-stopped",
        "torque is ordered off; the actuator is stopped, and found to hang",
        (Away("actuator", False, _OUT_S), Off()),
        _LETS_GO,
    ),
)
# Faults of processes for an operator's page, which a walk does not need.
_PAGE: tuple[tuple[str, str, tuple[Deed, ...], Limits], ...] = (
    ("console-killed", "the console is killed", (Away("console", True, 0.0),), _CALM),
    ("console-stopped", "the console is stopped for 3 s", (Away("console", False, 3.0),), _CALM),
    (
        "recorder-killed",
        "the recorder is killed while it records",
        (Away("recorder", True, 0.0),),
        Limits(walks_on=True, lost_s=1.0),
    ),
    ("recorder-stopped", "the recorder is stopped for 3 s while it records", (Away("recorder", False, 3.0),), _CALM),
)
# The same with two routers, without the faults that only concern the robot's own machine.
_HALVES: tuple[tuple[str, str, tuple[Deed, ...], Limits], ...] = (
    *(one for one in (*_LIVE, *_PAGE) if not one[0].startswith(("hogs", "off", "servo", "bus"))),
    ("base-router-killed", "the base's router is killed", (Away("base router", True, 0.0),), _UNHEARD),
    ("base-router-stopped", "the base's router is stopped for 2 s", (Away("base router", False, _OUT_S),), _UNHEARD),
)
LIVE_CASES: tuple[Case, ...] = (
    *(Case(f"live-{name}", words, deeds, limits, per_walk=10, live=True) for name, words, deeds, limits in (*_LIVE, *_PAGE)),
    *(
        Case(f"halves-{name}", f"two halves: {words}", deeds, limits, per_walk=10, live=True, halves=True)
        for name, words, deeds, limits in _HALVES
    ),
)

COURSES = ("steps", "stairs", "cobbles")
FOR_GOOD_S = 12.0  # [s] for which a robot is observed under a fault that does not end
_FOR_S = 4.0  # [s] duration of the others; the scripted operator waits 5 s for a pose
_WATCH_S = 15.0  # [s] maximum time until it walks again, or has its reason
_PER_WALK = 2

_PATH = ((0.8, 0.9), (0.8, -0.9))  # [m] across the view, in the robot's frame
_PERSON = LegsMover(_PATH, speed=0.9, frame="robot")
_ANIMAL = BoxMover(_PATH, speed=1.2, size=(0.5, 0.15, 0.3), frame="robot")
_PACING = LegsMover(_PATH, speed=0.45, frame="robot", period_s=4.2)

_UNSEEN = "measure|within its range|camera"  # the image shows too little
_CONTRADICTS = "overlap|agree|apart|jump|feet|camera"
_STAMPS = "stamp|late|out of order|no new image"
_SEEN = f"foothold|out of reach|{_UNSEEN}|{_CONTRADICTS}"  # the picture shows no ground to stand on

_FAULTS: tuple[tuple[str, str, CameraFaultKind | Mover, str], ...] = (
    ("absent", "it is unplugged", "absent", "unplugged"),
    ("blind", "nothing is in its range", "blind", _UNSEEN),
    ("sun", "sunlight in stripes on the ground, without return", "sun", f"{_UNSEEN}|{_CONTRADICTS}"),
    ("dark", "a dark surface returns too little light beyond 0.7 m", "dark", _UNSEEN),
    ("dropouts", "70 % of the pixels lost at random", "dropouts", _UNSEEN),
    ("blobs", "blobs without return, others in each image", "blobs", _UNSEEN),
    ("dirt", "dirt on the lens, which seems to be 0.55 to 0.6 m away", "dirt", _SEEN),
    ("wet", "puddles that mirror something 0.6 m above the ground", "wet", _SEEN),
    ("noise", "its images are noise", "noise", "noise"),
    ("frozen", "it repeats one image, with new stamps", "frozen", "frozen"),
    ("stale", "it repeats one image, with its stamp", "stale", _STAMPS),
    ("late", "images arrive 1 s late", "late", _STAMPS),
    ("ahead", "stamps are 1 s in the future", "ahead", _STAMPS),
    ("backward", "stamps run backward", "backward", _STAMPS),
    ("jumping", "stamps jump by 0.8 s to and fro", "jumping", _STAMPS),
    ("swapped", "cx and cy swapped, and fx and fy", "swapped", _CONTRADICTS),
    ("zoomed", "images of another resolution's focal length", "zoomed", _CONTRADICTS),
    ("person", "a person crosses 0.8 m ahead", _PERSON, _SEEN),
    ("animal", "a dog crosses 0.8 m ahead", _ANIMAL, _SEEN),
)


def _cases(course: str) -> tuple[Case, ...]:
    passing = tuple(
        Case(
            f"camera-{name}-{course}",
            f"on {course}, for {_FOR_S:g} s: {words}",
            (OnCamera(what, _FOR_S),),
            Limits(reasons=reasons, place_m=0.10),
            per_walk=_PER_WALK,
            watch_s=_WATCH_S,
            course=course,
        )
        for name, words, what, reasons in _FAULTS
    )
    lasting = tuple(
        Case(
            f"camera-{name}-lasting-{course}",
            f"on {course}, without end: {words}",
            (OnCamera(what if isinstance(what, str) else _PACING, FOR_GOOD_S),),
            Limits(reasons=reasons, stands=True, place_m=0.10),
            per_walk=_PER_WALK,
            watch_s=0.0,
            course=course,
        )
        for name, words, what, reasons in _FAULTS
        if name != "animal"
    )
    return (*passing, *lasting)


CAMERA_CASES = tuple(case for course in COURSES for case in _cases(course))
_LYING = ("servo-slipped", "servo-jump", "servo-drift", "servo-bit", "servo-sign", "servo-weak")
GRIDS: Mapping[str, tuple[Case, ...]] = {  # that the documentation has a table of
    "robot": tuple(case for case in CASES if case.name not in _LYING),
    "legs": tuple(case for case in CASES if case.name in _LYING),  # that report a wrong state
    "camera": CAMERA_CASES,
    "live": LIVE_CASES,
}
BY_NAME = {case.name: case for case in (*CASES, *LIVE_CASES, *CAMERA_CASES)}
