"""Fault injection into a walk in lockstep over level ground.

Each fault is injected at a different phase of the step.
"""

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import inf, nan
from typing import Self
from zlib import crc32

import numpy as np

from benchmarks.faults.bus_log import Role
from benchmarks.faults.cases import Away, Case, Clock, Deed, Late, Meddling, Off, OnBus
from benchmarks.faults.fault_run import LEAST_WATCH_S, REPEAT_S, SCENARIO, FaultRun, Observed
from benchmarks.faults.planner_faults import PlannerFaultInjector
from benchmarks.faults.timeline import Timeline
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.simulator.service import Simulator
from sextant.shared.runtime.lockstep import HandOver, Outage, ServiceFailedError
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.runtime.workers import in_copy
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.models import AX_12A
from sextant.shared.servo.servo_model import ServoModel
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Mode, ModeCommand

_LOOK_NS = 20_000_000
_BESIDE_S = 0.001  # [s] margin between a cycle and the outage after it
SOON_S = 0.06  # [s] in which a torque-off order should be on the bus: an outage that begins in it may block the order


class FaultWalk(FaultRun):
    """A walk in lockstep, its recorded messages, and its faults."""

    start_s = 20.0
    scenario = SCENARIO
    listens_to: tuple[AnyTopic, ...] = (topics.ACTUATOR_STATE, topics.TRUTH, topics.ODOMETRY)

    def __init__(self, case: Case, seed: int, robot: str = SCENARIO.robot):
        """Assemble the walk.

        Args:
            case: The fault to inject.
            seed: Random seed of everything but the phases.
            robot: Robot profile by name, or path of a TOML file.
        """
        super().__init__(case, robot)
        self._rng = np.random.default_rng([crc32(case.name.encode()), seed])
        self._meddler = PlannerFaultInjector(np.random.default_rng([seed, 1]))
        self._late_s, self._late_until_s = 0.0, -math.inf  # [s] duration of the actuator's cycles until a time
        self._walked: set[int] = set()  # [ns] stamps of executed fuzzed plans
        self._sequence = 0
        self._failed = ""  # the service that raised an exception, and the exception
        stop_port = f"faults {os.getpid()}"
        self._latch = Latch.of_port(stop_port)
        self._latch.open()
        around, scenario = {"planner": self._meddler.around}, replace(self.scenario, robot=robot)
        fuzzed = any(isinstance(deed, Meddling) and deed.how == "fuzzed" for deed in case.deeds)
        # Only the codec finds the wrong values of fuzzed plans.
        hand_over = None if fuzzed else HandOver(lambda topic, _: topic in self.listens_to)
        self._run = LockstepRun(
            scenario, seed, self.profile, self._hear, every_frame=False, around=around, stop_port=stop_port, hand_over=hand_over
        )
        simulator = self._run.service("simulator")
        assert isinstance(simulator, Simulator)
        self._simulator = simulator
        simulator.bus.overhear(self.recorder.sent, self.recorder.heard)
        self._servo = int(self._rng.choice(self.profile.servo_ids.ravel()))
        servos = simulator.servos
        servos.charge = case.charge
        if case.warm_c:
            servos.temperature[servos.column(servos.table.id) == self._servo] = case.warm_c

    @property
    def now_s(self) -> float:
        """Simulated time [s]."""
        return self._run.now_ns() * 1e-9

    @property
    def walks(self) -> bool:
        """Whether the robot walks on its plans, with all services alive."""
        return not self._failed and super().walks

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the latch."""
        self._latch.open()

    def what_happens(self, rng: np.random.Generator) -> Timeline:
        """Inject the fault now, and observe.

        A fault that ends the walk is injected into a copy of it, and this walk continues.
        """
        if not self._case.ends_the_walk:
            return super().what_happens(rng)
        try:
            return in_copy(partial(super().what_happens, rng))
        finally:
            self._latch.open()  # the copy has used the same file

    def break_and_watch(self, begin: float, rng: np.random.Generator) -> Observed:
        """Inject the faults of the case, and observe the robot."""
        case, ordered, empty, wall, fuzzed = self._case, nan, nan, time.time, self._meddler.fuzzed
        self._meddler.stamps.clear()
        self._walked.clear()
        if not case.warm_c:
            self._servo = int(rng.choice(self.profile.servo_ids.ravel()))
        due = [self._do(deed, begin) for deed in case.deeds if not isinstance(deed, Off)]
        order_s = next((begin + rng.uniform(d.from_s, d.until_s) for d in case.deeds if isinstance(d, Off)), nan)
        end = begin + case.for_s
        last, least = max(end + case.watch_s, begin + LEAST_WATCH_S), max(end, begin + LEAST_WATCH_S)
        again_due = order_s
        try:
            while self.now_s < last:
                self.look(min([t for t in (again_due, *due) if t > self.now_s], default=last))
                now = self.now_s
                if now >= again_due - 1e-9:
                    self._order_off()
                    ordered, again_due = (now if np.isnan(ordered) else ordered), now + REPEAT_S
                if now >= end - 1e-9:
                    self._meddler.how, time.time = "", wall
                if np.isnan(empty) and self._simulator.servos.charge <= 0.0:
                    empty = now
                let_go = self.state is not None and self.state.mode is Mode.OFF
                if case.limits.seated and let_go:
                    break
                if now >= least and self.walks:
                    break
        except ServiceFailedError as error:
            self._failed = str(error)
        finally:
            self._meddler.how, time.time = "", wall
        servos = self._simulator.servos
        return Observed(
            end_s=end,
            servo=self._servo if case.concerns_one else -1,
            pulls=servos.column(servos.table.torque_enable) > 0,
            ordered_s=ordered,
            returned_s=begin + max(self._away_for(), self._gap_until(ordered - begin, begin)) if case.lets_go else nan,
            empty_s=empty,
            plans=self._meddler.fuzzed - fuzzed,
            walked=len(self._walked),
            voltage=float(self._simulator.servos.voltage),
            stuck=self._failed,
        )

    def _do(self, deed: Deed, begin: float) -> float:
        """Start a fault; return its end time [s]."""
        match deed:
            case Away(service, kill, for_s, after_s):
                from_ns = round((begin + after_s) * 1e9)
                self._run.lose(Outage(service, from_ns, from_ns + round(for_s * 1e9), kill))
                return begin + after_s + for_s
            case Meddling(how, for_s):
                self._meddler.how = how
                return begin + for_s
            case OnBus(fault, any_servo):
                servo, models = self._servo if any_servo else fault.servo, self.profile.servo_models
                same = of_same_angle(fault, models.get(servo, self.profile.servo_model))
                self._simulator.inject(replace(same, at_s=begin, servo=servo))
                return begin + fault.for_s
            case Late(cycle_s, for_s):
                self._late_s, self._late_until_s = cycle_s, begin + for_s
                return begin + for_s
            case Clock(step_s, for_s):
                time.time = _stepped(time.time, step_s)
                return begin + for_s
        raise ValueError(f"a lockstep fault expected, found {deed}; run it live")

    def _away_for(self) -> float:
        """Return how long [s] after the start torque cannot be switched off.

        Bus or actuator are unavailable then.
        """
        away = 0.0
        for deed in self._case.deeds:
            if isinstance(deed, OnBus) and deed.fault.target == "bus" and deed.fault.kind in _BUSES_AWAY:
                away = max(away, deed.for_s)
            if isinstance(deed, Away) and deed.service == "actuator" and not deed.after_s:
                away = max(away, deed.for_s)
        return away

    def _gap_until(self, ordered_s: float, begin: float) -> float:
        """Return when [s] after the start the outage ends that blocked a torque-off order.

        Return 0 if the order was received before.
        """
        from_s, until_s = gap_after(self._case.deeds, ordered_s)
        offs = [s.t_s - begin for s in self.recorder.switches if s.heard and s.role is Role.TORQUE]
        met = from_s - ordered_s < SOON_S and not any(ordered_s <= t < from_s for t in offs)
        return until_s if met else 0.0

    def _order_off(self) -> None:
        self._sequence = self._sequence or self._run.now_ns()
        self._run.say(ModeCommand(self._run.now_ns(), "off", self._sequence, "bench"))

    def look(self, until_s: float = float("inf")) -> None:
        """Run at most one interval of simulated time."""
        now = self._run.now_ns()
        self._run.run(min(now + _LOOK_NS, max(round(min(until_s, 1e6) * 1e9), now + 1)))

    def _hear(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        if topic is topics.ACTUATOR_STATE:
            self.hear_state(frame, at_ns)
            if self.state is not None and self.state.plan_ns in self._meddler.stamps:
                self._walked.add(self.state.plan_ns)
        elif topic is topics.TRUTH:
            self.hear_truth(frame)
        elif topic is topics.ODOMETRY and at_ns * 1e-9 < self._late_until_s:  # sent in each of the actuator's cycles
            until_ns = at_ns + round((self._late_s - _BESIDE_S) * 1e9)
            self._run.lose(Outage("actuator", at_ns + round(_BESIDE_S * 1e9), until_ns, kill=False))


def of_same_angle(fault: BusFault, model: ServoModel) -> BusFault:
    """Return a fault given in ticks of an AX-12A, with the same angle in ticks of another servo."""
    finer = AX_12A.units.tick_rad / model.units.tick_rad
    offset, bit = round(fault.offset_ticks * finer), fault.bit + round(math.log2(finer))
    match fault.target, fault.kind:
        case "servo", "wrong":
            return replace(fault, offset_ticks=offset)
        case "servo", "bit":
            return replace(fault, bit=bit)
    return fault


_BUSES_AWAY = ("silent", "stuck", "garbage", "gone")


def gap_after(deeds: Sequence[Deed], since_s: float) -> tuple[float, float]:
    """Return begin and end [s] of the next or current outage of an intermittent bus.

    Both are infinite without such a fault.
    """
    for deed in deeds:
        if isinstance(deed, OnBus) and deed.fault.target in ("bus", "bytes") and deed.fault.kind == "intermittent":
            on, whole = deed.fault.on_ms * 1e-3, (deed.fault.on_ms + deed.fault.off_ms) * 1e-3
            begun = since_s - since_s % whole
            return begun + on, begun + whole
    return inf, inf


def _stepped(clock: Callable[[], float], by_s: float) -> Callable[[], float]:
    return lambda: clock() + by_s
