import re
from dataclasses import dataclass, field, replace

import numpy as np

from sextant.evaluation.observers.monitor import Monitor, View
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lateness import SlowComputer
from sextant.shared.runtime.lockstep import Lockstep
from sextant.shared.runtime.service import Every, ServiceRunner
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, CameraState, GroundTruth, Health, Message, Mode, PlannerStatus
from tests.support.scripted_service import Scripted
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")

S = 1_000_000_000


def pose(stamp_ns: int, x: float, ok: bool = True) -> BodyPose:
    T = np.eye(4)
    T[0, 3] = x
    return BodyPose(
        stamp_ns, T, np.eye(4), np.zeros((6, 6)), 1.0, ok, "" if ok else "too few points met the reference", np.zeros((0, 6))
    )


def state(
    stamp_ns: int, mode: Mode = Mode.WALK, reason: str = "", refused: str = "", warnings: tuple[str, ...] = ()
) -> ActuatorState:
    no = np.zeros(6, dtype=np.bool_)
    said = {"stamp_ns": stamp_ns, "mode": mode, "reason": reason, "plan_refusal": refused, "warnings": warnings}
    return actuator_state(PROFILE, step=1, phase=0.5, contact=no, temperature=40.0, **said)


def truth(stamp_ns: int) -> GroundTruth:
    joints, flags = np.zeros((6, 3)), np.zeros(6, dtype=np.bool_)
    return GroundTruth(
        stamp_ns, np.eye(4), joints, joints, joints, flags, flags, joints > 0, 11.1, 30.0, "flat", 0, PROFILE.name
    )


def health(stamp_ns: int, service: str, refused: int = 0, **stages: float) -> Health:
    p50 = np.array(list(stages.values()), dtype=np.float64)
    names = tuple(name.replace("latency_", "latency ") for name in stages)
    return Health(stamp_ns, service, f"{service} at work", 1, refused, 0, "bad header", names, p50, 2 * p50)


class Bench:
    """A monitor on a separate clock."""

    def __init__(self, goal: float = 2.5, has_truth: bool = False):
        self.now_ns = 0
        self.monitor = Monitor(goal, has_truth=has_truth)
        self.worker = ServiceRunner(self.monitor, lambda *_: None, lambda: self.now_ns)

    def hear(self, at_ns: int, *messages: Message) -> View:
        self.now_ns = at_ns
        for message in messages:
            self.worker.inbox.receive(topics.OF_TYPE[type(message)], codec.encode(message), at_ns)
        self.worker.tick()
        return self.monitor.view


def test_monitor_without_messages_is_not_up() -> None:
    view = Bench().hear(S)
    assert not view.up
    assert view.to_goal == 2.5


def test_time_starts_at_first_actuator_message_and_speed_is_mean() -> None:
    bench = Bench()
    for i in range(40):
        view = bench.hear(10 * S + i * S // 4, state(10 * S + i * S // 4), pose(10 * S + i * S // 4, 0.1 * i / 4))
    assert view.time_s == 39 / 4
    assert abs(view.speed - 0.1) < 1e-9
    assert abs(view.to_goal - (2.5 - 0.1 * 39 / 4)) < 1e-9


def test_time_of_a_simulated_run_starts_at_its_first_truth() -> None:
    bench = Bench(has_truth=True)
    bench.hear(S)
    view = bench.hear(2 * S, truth(50 * S), truth(50 * S + S // 5))
    assert (view.time_s, view.up) == (0.2, False)
    view = bench.hear(6 * S, truth(54 * S), state(9 * S))
    assert (view.time_s, view.up) == (4.2, True)


def test_remaining_distance_is_zero_past_goal() -> None:
    assert Bench().hear(S, pose(S, 2.6)).to_goal == 0.0


def test_service_problems_become_warnings() -> None:
    status = PlannerStatus(S, "blocked", "no foothold for the left front leg", 3, 0, 0)
    spoken = state(S, Mode.FAULT, "overload", "plan from the future", ("servo 3 is hot",))
    view = Bench().hear(S, spoken, pose(S, 0.0, ok=False), status, health(S, "mapper", refused=2))
    assert view.warnings == (
        "actuator: fault, overload",
        "actuator refused a plan: plan from the future",
        "actuator: servo 3 is hot",
        "perception: too few points met the reference",
        "planner: blocked, no foothold for the left front leg",
        "mapper: refused 2 messages, last reason: bad header",
    )


def test_refused_messages_are_a_warning_for_ten_seconds_since_the_last_one() -> None:
    bench = Bench()
    warned = [bool(bench.hear(k * S, health(k * S, "mapper", refused=1 if k < 5 else 2)).warnings) for k in range(1, 20)]
    assert warned == [k <= 15 for k in range(1, 20)]


def test_silent_service_is_named_in_warning() -> None:
    bench = Bench()
    assert bench.hear(S, health(S, "mapper"), health(S, "planner")).warnings == ()
    bench.hear(4 * S, health(4 * S, "planner"))
    assert bench.hear(5 * S).warnings == ("mapper: no message for 4 s",)
    assert bench.hear(6 * S, health(6 * S, "mapper")).warnings == ()


def test_missing_camera_warns_until_it_publishes() -> None:
    bench = Bench()
    assert bench.hear(S, CameraState(S, "openni2", False, "no device found")).warnings == ("camera: no device found",)
    assert bench.hear(S + S // 4, CameraState(S, "openni2", True, "")).warnings == ()


def test_stage_times_use_slowest_subscriber_of_topic() -> None:
    bench = Bench()
    bench.hear(
        S, health(S, "planner", planner=3.0, search=2.0, latency_scan=5.0), health(S, "mapper", mapper=1.0, latency_scan=4.0)
    )
    assert bench.monitor.stages_ms() == {
        "planner": (3.0, 6.0),
        "planner.search": (2.0, 4.0),
        "latency scan": (5.0, 10.0),
        "mapper": (1.0, 2.0),
    }
    bench.hear(2 * S, health(2 * S, "planner", planner=3.0, latency_scan=1.0))
    assert bench.monitor.stages_ms()["latency scan"] == (4.0, 8.0), "the newest percentiles count, not the start's"


def test_status_cannot_control_the_terminal() -> None:
    view = Bench().hear(S, replace(health(S, "mapper"), status="\x1b[2J[red]busy"))
    assert view.doing == {"mapper": "\N{REPLACEMENT CHARACTER}[2J[red]busy"}


@dataclass
class Follower(Scripted):
    """A service that cannot use poses older than 0.4 s."""

    max_age_s: dict[str, float] = field(default_factory=lambda: {topics.BODY_POSE.key: 0.4})


def monitored_run(latency_s: float, computer: SlowComputer) -> Monitor:
    """Return a monitor after 6 s of lockstep with delayed poses."""
    monitor = Monitor(2.5, computer)
    poses = Scripted("perception", Every.hz(15), publishes=(topics.BODY_POSE,), act=lambda tick, _: [pose(tick.stamp_ns, 0.0)])
    follower = Follower("planner", Every.hz(25), (topics.BODY_POSE,), act=lambda _, box: (box.latest(topics.BODY_POSE), ())[1])
    makers = {"perception": lambda: poses, "planner": lambda: follower, "monitor": lambda: monitor}
    Lockstep(makers, latency_s={topics.BODY_POSE.key: latency_s}).run(6 * S)
    return monitor


def test_late_inputs_warn_with_advice() -> None:
    monitor = monitored_run(0.9, SlowComputer())
    (warning,) = monitor.view.warnings
    assert re.fullmatch(
        r"this computer is too slow: poses are (0\.9\d|1\.0) s old, 0\.4 s allowed; use --lockstep or close programs", warning
    )
    lateness = monitor.lateness
    assert 2.0 < lateness.late_s < 6.0
    ages = lateness.ages()["planner perception/pose"]
    assert (0.9 < ages.max < 1.1, ages.limit, ages.late) == (True, 0.4, 1.0)


def test_timely_inputs_are_measured_without_warning() -> None:
    monitor = monitored_run(0.05, SlowComputer())
    assert monitor.view.warnings == ()
    assert (monitor.lateness.late_s, monitor.lateness.words) == (0.0, "")
    assert 0.05 < monitor.lateness.ages()["planner perception/pose"].max < 0.2


def test_lockstep_does_not_warn_about_slow_computer() -> None:
    monitor = monitored_run(0.9, SlowComputer(real_time=False))
    assert monitor.view.warnings == ()
    assert monitor.lateness.ages()["planner perception/pose"].late == 1.0, "it is measured all the same"


def test_lateness_keeps_worst_input() -> None:
    monitor = Monitor(2.5)

    def late(at_s: float, age_s: float) -> Health:
        figures = [np.array([figure]) for figure in (age_s, age_s, 0.8, 0.5)]
        return replace(
            health(round(at_s * S), "planner"),
            inputs=("mapper/terrain",),
            **dict(zip(("input_age_s", "input_arrived_s", "input_limit_s", "input_late_share"), figures, strict=True)),
        )

    for second, age_s in enumerate((1.0, 3.0, 3.0, 1.2, 1.2, 1.2, 1.2, 1.2)):
        monitor.lateness.update({"planner": (late(second, age_s), second * S)}, second * S)
    assert monitor.lateness.words == "this computer is too slow: maps are 3.0 s old, 0.8 s allowed"
    assert monitor.lateness.late_s == 7.0
