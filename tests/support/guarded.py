"""A small model of the actuator around the guard, and plans that must be rejected."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from sextant.services.actuator.safety.guard import Act, Guard, Stance, Walk
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.geometry import apply, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import Mode, ModeCommand, StepPlan

PROFILE = load_profile("phantomx_mk2")
START = from_xyz_rpy((0.0, 0.0, PROFILE.stance.body_height), np.zeros(3))
FEET = apply(START, PROFILE.rest_feet())
TRIPOD = np.arange(6) % 2 == 0
AGE_NS = 600_000_000
CYCLE = 20_000_000
EPOCH = 7
ORDERS = ("off", "stop", "ready", "stand", "walk", "sit")
BROKEN, SPENT = Verdict(broken="a servo is silent"), Verdict(sit="the battery is low")


class Robot:
    """Legs that follow the guard, without the rest of an actuator.

    A step runs or does not run; a pose is reached or not reached.
    """

    def __init__(self, torque: bool) -> None:
        self.guard = Guard(PROFILE, AGE_NS * 1e-9, EPOCH, torque)
        self.now = 10_000_000_000
        self.torque, self.still, self.posing = torque, False, ""
        self.verdict = Verdict()
        self.step, self.swing = 0, np.zeros(6, dtype=bool)
        self.running = self.own = self.searching = False  # a step runs; it is not from a plan; a foot searches for the ground
        self.next: StepPlan | None = None
        self.trouble = ""
        self.lifted = np.full(6, np.inf)  # [m] clearance of the running step's swing feet
        self.number = 0
        self.stance_now = self.stance_at_end = Stance(START, FEET, np.full(6, np.inf))

    @property
    def mode(self) -> Mode:
        return self.guard.mode

    @property
    def walk(self) -> Walk:
        resting = not self.running and not self.searching
        planned = self.running and not self.own
        waits = self.trouble if self.searching else ""
        return Walk(self.step, resting, planned, self.trouble, waits, self.swing, self.lifted)

    def stance(self, now: bool) -> Stance:
        return self.stance_now if now else self.stance_at_end

    # Actions of the operator, the planner and the clock.

    def order(self, mode: str, holder: str = "a", take: bool = False) -> tuple[Act, ...]:
        """Send a new order."""
        self.number = max(self.number + 1, self.now)
        return self.handle_order(ModeCommand(self.now, mode, self.number, holder, take))  # type: ignore[arg-type]

    def handle_order(self, order: ModeCommand) -> tuple[Act, ...]:
        return self.perform(self.guard.handle_order(order, self.now))

    def plan(self, **changes: Any) -> StepPlan:
        """Return the next step, in place; it swings the other tripod."""
        good = StepPlan(
            stamp_ns=self.now,
            epoch=self.guard.epoch,
            step=self.step + 1,
            revision=1,
            T_world_odom=np.eye(4),
            swing=TRIPOD if self.step % 2 else ~TRIPOD,
            touchdown=FEET,
            clearance=np.full(6, 0.04),
            body_goal=START,
            duration=0.8,
            stop=False,
        )
        return replace(good, **changes)

    def renewal(self, **changes: Any) -> StepPlan:
        """Return a new revision of the running step."""
        return self.plan(**{"step": self.step, "swing": self.swing, **changes})

    def accept_plan(self, plan: StepPlan) -> bool:
        taken = self.guard.accept_plan(plan, self.now, self.walk, self.stance)
        if taken and plan.step != self.step:
            self.next = plan
        return taken

    def cycle(self, after: int = CYCLE, ends: bool = False) -> tuple[Act, ...]:
        """Run the next cycle; with `ends`, complete the current motion."""
        self.now += after
        acts = self.move(ends) if self.torque and not self.still else ()
        return (*acts, *self.perform(self.guard.watch(self.now, self.walk, self.verdict)))

    def move(self, ends: bool) -> tuple[Act, ...]:
        """Advance the legs; with `ends`, complete their current motion."""
        if self.posing and ends:
            posing, self.posing = self.posing, ""
            if posing == "lie":
                self.still = True
                return self.perform(self.guard.seated(self.now))
            self.guard.risen()
            self.running = self.own = self.searching = False
            self.step, self.swing, self.next = 0, np.zeros(6, dtype=bool), None
            self.guard.set_epoch(self.guard.epoch + 1)
        elif not self.posing:
            if ends:
                self.running = self.own = self.searching = False
            if not self.running and not self.searching and self.next is not None:
                self.step, self.swing, self.running, self.own = self.next.step, self.next.swing, True, False
                self.next = None
        return ()

    def perform(self, acts: tuple[Act, ...]) -> tuple[Act, ...]:
        """Perform the guard's acts as the actuator does."""
        for act in acts:
            match act:
                case Act.TORQUE_OFF:
                    self.torque, self.posing = False, ""
                case Act.TORQUE_ON:
                    self.torque, self.still, self.posing = True, True, ""
                case Act.RISE:
                    self.still, self.posing = False, "rise"
                case Act.LIE_DOWN:
                    self.still, self.posing = False, "lie"
                case Act.FREEZE:
                    self.still, self.posing = True, ""
                case Act.SET_DOWN:
                    self.next = None
        return acts

    # Ways to reach a state.

    def walking(self) -> "Robot":
        """Bring the robot to the middle of a step."""
        self.order("walk")
        assert self.accept_plan(self.plan())
        self.cycle()
        assert self.mode is Mode.WALK
        assert self.walk.planned
        return self


def in_mode(mode: Mode) -> Robot:
    """Return a robot in a mode; its operator is `a`."""
    robot = Robot(torque=mode is not Mode.OFF)
    robot.cycle()
    match mode:
        case Mode.READY | Mode.SIT:
            robot.order("sit")
            robot.cycle()
            if mode is Mode.READY:
                robot.cycle(ends=True)
        case Mode.STAND:
            robot.order("stand")
        case Mode.WALK:
            robot.walking()
        case Mode.FAULT:
            robot.verdict = BROKEN
            robot.cycle()
    assert robot.mode is mode
    return robot


def rested(robot: Robot, cycles: int = 6) -> Robot:
    """Complete all current motions."""
    for _ in range(cycles):
        robot.cycle(ends=True)
    return robot


BAD: dict[str, tuple[Callable[[Robot], StepPlan], str]] = {
    "old": (lambda r: r.renewal(stamp_ns=r.now - AGE_NS - 1), "0.60 s old"),
    "of the future": (lambda r: r.renewal(stamp_ns=r.now + AGE_NS + 1), "in the future"),
    "of another epoch": (lambda r: r.renewal(epoch=r.guard.epoch + 1), "made before {odom} restarted"),
    "repeated": (lambda r: r.renewal(stamp_ns=r.now - CYCLE), "not newer than the last accepted one"),
    "reordered": (lambda r: r.renewal(stamp_ns=r.now - CYCLE - 1), "not newer than the last accepted one"),
    "too far ahead": (lambda r: r.plan(step=r.step + 2), "does not follow step 1"),
    "over": (lambda r: r.renewal(step=r.step - 1), "does not follow step 1"),
    "with other legs": (lambda r: r.renewal(swing=~r.swing), "swings other legs"),
    "out of reach": (lambda r: r.renewal(touchdown=FEET + np.array([0.3, 0.0, 0.0])), "is out of reach"),
    "without end": (lambda r: r.renewal(duration=9.0), "found 9.00 s"),
    "no pose": (lambda r: r.renewal(body_goal=2.0 * START), "not a rigid transform"),
}
