"""Services fail during a walk.

The robot holds, the reason is reported, and the walk goes on to its goal.
"""

import numpy as np
import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.evaluation.metrics.walk_metrics import stability_margin
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Fault, Scenario
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Mode
from tests.support.walks import Walk, flat, walk

AT_S = 4.5  # [s] the third step is in its middle, three feet are in the air
TIMES_S = (AT_S, 10.0)  # [s] and another fault after it has walked on
FOR_S = 2.5  # [s] longer than the age limit of a map, the step planned on it, and the step before
SETTLE_S = 0.5  # [s] in which servos without commands reach the last goal
REASONS = {
    "perception": "no fresh pose from perception",
    "mapper": "no fresh terrain map",
    "planner": "no new plan received for 0.18 s",
}
SERVOS = load_profile("phantomx_mk2").servo_ids.ravel().tolist()


def course(service: str, *kinds: str, for_s: float = FOR_S) -> Scenario:
    """Return a walk on which a service fails in several ways, each during a step."""
    faults = tuple(Fault(at_s, service, kind, for_s=for_s) for at_s, kind in zip(TIMES_S, kinds, strict=False))  # type: ignore[arg-type]
    return flat(0.4 + 0.25 * (len(kinds) - 1), faults=faults)


def assert_stood_safely_and_reached_goal(found: Walk) -> None:
    """Check that the robot stood safely throughout, and reached its goal."""
    report = found.report
    assert report.success, report.reason
    assert (report.falls, report.shutdowns) == (0, 0)
    assert report.min_stability_margin_m >= 0
    assert report.tilt_deg.max < 5
    # A step counts once, also if a service restarts during it, and no foot slips more than on other walks.
    steps = np.array([state.step for state in found.states()])
    assert report.steps == np.count_nonzero(np.diff(steps) > 0)
    assert report.slip_m_per_step.p95 < 0.006
    truth = found.heard.of(topics.TRUTH, AT_S)
    feet = np.array([m.feet[:, :2] for m in truth])
    contact = np.array([m.contact for m in truth], dtype=np.bool_)
    body = np.array([m.T_world_body[:2, 3] for m in truth])
    assert stability_margin(feet, contact, body).min() >= 0


@pytest.mark.parametrize("service", ["perception", "mapper", "planner"])
def test_robot_holds_with_reason_without_a_service_and_resumes(service: str) -> None:
    """Kill the service, then hang it."""
    found = walk(course(service, "kill", "hang"), 1000)
    for at_s in TIMES_S:
        states = found.states(at_s, at_s + FOR_S)
        assert states[0].mode is Mode.WALK
        assert states[0].swing.sum() == 3
        first = next(i for i, state in enumerate(states) if state.mode is Mode.HOLD)
        assert all(state.mode is Mode.HOLD and not state.swing.any() for state in states[first:]), (
            "it holds till the service is back"
        )
        said = {state.reason for state in states[first:]} | {status.reason for status in found.statuses(at_s, at_s + FOR_S)}
        assert any(REASONS[service] in reason for reason in said), said
    assert_stood_safely_and_reached_goal(found)


class Servos:
    """Goals and torques of the servos while no host commands them, read over the bus."""

    def __init__(self, for_s: float):
        self.seen: list[tuple[list[int | None], list[int | None]]] = []
        self.warnings: set[str] = set()
        self._from_ns, self._until_ns = round((AT_S + SETTLE_S) * 1e9), round((AT_S + for_s) * 1e9)

    def look(self, run: LockstepRun) -> None:
        if self._from_ns < run.now_ns() < self._until_ns:
            simulator = run.service("simulator")
            assert isinstance(simulator, Simulator)
            port = MemoryPort(simulator.bus, run.now_ns)
            bus = ServoBus(port, SERVOS, port.now_ns)
            goals, torques = (
                [bus.read(servo, register) for servo in SERVOS] for register in (dxl.GOAL_POSITION, dxl.TORQUE_ENABLE)
            )
            self.seen.append((goals, torques))
            self.warnings.update(run.attendance.monitor.view.warnings)


@pytest.mark.parametrize(("kind", "for_s"), [("kill", FOR_S), ("hang", 4.5)])
def test_servos_keep_goals_and_torque_without_actuator_and_walk_resumes(kind: str, for_s: float) -> None:
    servos = Servos(for_s)
    found = walk(course("actuator", kind, for_s=for_s), 1000, look=servos.look)
    assert not found.states(AT_S, AT_S + for_s), "nothing commands the servos"
    assert len(servos.seen) > 10
    goals, torques = servos.seen[0]
    assert torques == [1] * 18
    assert None not in goals
    assert all(seen == (goals, torques) for seen in servos.seen)
    still = np.array([m.T_world_body[:3, 3] for m in found.heard.of(topics.TRUTH, AT_S + SETTLE_S, AT_S + for_s)])
    assert np.ptp(still, axis=0).max() < 0.002, "it stands where it was"
    if kind == "kill":
        assert found.states(AT_S + for_s)[0].reason.startswith("torque was on at the start")
    else:
        assert any(warning.startswith("actuator: no message") for warning in servos.warnings), servos.warnings
    assert_stood_safely_and_reached_goal(found)
