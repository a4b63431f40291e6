"""Choice of gait and speed by what the planner sees; used where the operator's request is `auto`.

The rule has three steps:

1. `classify` puts the situation into one of four classes, from even to difficult. Each observation alone gives a class, and the
   worst one counts. So a worse observation never leads to a faster walk.
2. A worse class counts at once, a better one after `calm_s`, so that the choice does not flicker.
3. The fastest walk is chosen that the class permits and the servos bear by the prediction of `servo_load`: gait, foot height
   and foot speed. A worse class permits fewer walks, and so does a hotter or more loaded servo.

A choice is made for the next step, which begins with all feet on the ground, so every gait may follow every other.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from itertools import product

import numpy as np

from sextant.services.planner.locomotion.gait import GAITS, Pace
from sextant.services.planner.locomotion.ground_ahead import GroundAhead
from sextant.services.planner.locomotion.params import GaitChoiceParams, StepParams
from sextant.services.planner.locomotion.servo_load import ServoLoad, pace_at, predict_load
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.protection import Protection
from sextant.shared.wire.messages import GaitName, VelocityCommand

_SPEED_FACTORS = (1.4, 1.35, 1.3, 1.25, 1.2, 1.15, 1.1, 1.05, 1.0, 0.9, 0.8, 0.7, 0.6)  # of the profile's foot speed
_PROTECTION = Protection()


class GroundClass(IntEnum):
    """How the robot may walk, from fast to slow."""

    EVEN = 0
    UNEVEN = 1
    DOUBTFUL = 2
    DIFFICULT = 3

    @property
    def words(self) -> str:
        """Return the class as text."""
        return f"{self.name.lower()} ground"


@dataclass(frozen=True, slots=True)
class _Permission:
    """Walks that a class permits; each class permits what the next one does, and more."""

    gaits: tuple[GaitName, ...]
    max_factor: float  # [1] largest foot speed, as a multiple of the profile's
    low_feet: bool  # whether feet may go lower than commanded


_PERMITTED = {
    GroundClass.EVEN: _Permission(("tripod", "ripple", "wave"), math.inf, True),
    GroundClass.UNEVEN: _Permission(("tripod", "ripple", "wave"), math.inf, False),
    GroundClass.DOUBTFUL: _Permission(("tripod", "ripple", "wave"), 1.0, False),
    GroundClass.DIFFICULT: _Permission(("ripple", "wave"), 1.0, False),
}


@dataclass(frozen=True, slots=True)
class Situation:
    """What the choice is made by."""

    ground: GroundAhead
    pose_fault: str = ""  # why the pose is uncertain; empty if it is certain
    failures: tuple[str, ...] = ()  # of the last `memory_s`: what failed
    temperature: float = _PROTECTION.ambient  # [deg C] of the hottest servo
    duty: float = 0.0  # [1] measured root mean square torque of the most loaded joint, of its stall torque


@dataclass(frozen=True, slots=True)
class Walk:
    """A way to walk with full strides over level ground."""

    gait: GaitName
    speed: float  # [m/s]
    lift: float  # [m] clearance of swinging feet; higher swings take more time, by which they load the servos no more
    pace: Pace
    load: ServoLoad


@dataclass(frozen=True, slots=True)
class GaitChoice:
    """Walk of the next step."""

    walk: Walk
    reason: str  # class of the ground, a colon, and what decided
    sets_speed: bool  # whether also the speed is left to the planner, not only the gait

    @property
    def words(self) -> str:
        """Return the choice as text."""
        speed = f" at {self.walk.speed * 100:.1f} cm/s" if self.sets_speed else ""
        return f"{self.walk.gait}{speed}, {self.reason}"

    def apply_to(self, command: VelocityCommand, max_speed: float) -> VelocityCommand:
        """Return a command with the choice in place of `auto`; `max_speed` [m/s] is that of the profile."""
        if command.gait == "auto":
            command = replace(command, gait=self.walk.gait)
        if not self.sets_speed:
            return command
        asked = float(np.linalg.norm(command.velocity))
        share = self.walk.speed * min(1.0, asked / max_speed) / max(asked, 1e-9)
        return replace(command, velocity=command.velocity * share, lift=self.walk.lift, auto_speed=False)


def classify(at: Situation, params: GaitChoiceParams) -> tuple[GroundClass, str]:
    """Return the class of a situation, and the observation that decided."""
    found = max(_observations(at, params), key=lambda one: one[0])
    return GroundClass(found[0]), found[1]


def _observations(at: Situation, params: GaitChoiceParams) -> Iterator[tuple[GroundClass, str]]:
    """Yield the class by each observation alone, those that decide between equal classes first."""
    count = len(at.failures)
    if count >= params.difficult_failures:
        yield GroundClass.DIFFICULT, f"{count} failures in {params.memory_s:g} s, the last: {at.failures[-1]}"
    elif count >= params.doubtful_failures:
        yield GroundClass.DOUBTFUL, at.failures[-1]
    if at.pose_fault:
        yield GroundClass.DOUBTFUL, f"the pose is uncertain: {at.pose_fault}"
    ground, even, firm = at.ground, GroundClass.EVEN, GroundClass.UNEVEN
    for unlike_even, unlike_firm, words in (
        (
            ground.carrying < params.even_carrying,
            ground.carrying < params.firm_carrying,
            f"{ground.carrying:.0%} of its cells carry a foot",
        ),
        (ground.unseen > params.even_unseen, ground.unseen > params.firm_unseen, f"{ground.unseen:.0%} of it is unseen"),
        (
            ground.slope_deg > params.even_slope_deg,
            ground.slope_deg > params.firm_slope_deg,
            f"its slope is {ground.slope_deg:.0f} deg",
        ),
        (ground.step_m > params.even_step_m, False, f"it has steps of {ground.step_m * 100:.1f} cm"),
    ):
        yield GroundClass.DOUBTFUL if unlike_firm else firm if unlike_even else even, words


def allowed_duty(profile: RobotProfile, at: Situation, params: GaitChoiceParams) -> float:
    """Return the root mean square torque [1], of the stall torque, that the servos may be planned to take.

    With it, the hottest servo comes within `heat_horizon_s` no nearer to its temperature limit than where the actuator begins
    to walk slower. If the servos already take more than `max_measured_duty`, the plan takes less by that ratio.
    """
    warm = min(servo.warm_temperature for servo in profile.servos.each) - params.heat_reserve_k
    kept = math.exp(-params.heat_horizon_s / _PROTECTION.cooling_time)
    rise = warm - _PROTECTION.ambient - kept * max(at.temperature - _PROTECTION.ambient, 0.0)
    by_heat = math.sqrt(max(rise, 0.0) / (_PROTECTION.heating * _PROTECTION.cooling_time * (1.0 - kept)))
    excess = max(at.duty / params.max_measured_duty, 1.0)
    return min(params.max_duty, by_heat) / excess


def fastest_walk(
    profile: RobotProfile,
    steps: StepParams,
    params: GaitChoiceParams,
    ground: GroundClass,
    duty: float,
    command: VelocityCommand,
) -> Walk:
    """Return the fastest permitted walk that the servos bear; if they bear none, the one with the least load.

    Args:
        profile: The robot.
        steps: Parameters of a step, with the limit of the joints' speed.
        params: Foot height on even ground.
        ground: Class of the ground.
        duty: [1] allowed root mean square torque, of the stall torque.
        command: Its gait stays unless it is `auto`. Without `auto_speed` feet are as fast and as high as they would be.
    """
    permitted = _PERMITTED[ground]
    gaits: tuple[GaitName, ...] = permitted.gaits if command.gait == "auto" else (command.gait,)
    lifts: tuple[float, ...] = (command.lift,)
    factors: tuple[float, ...] = (1.0,)
    if command.auto_speed:
        factors = tuple(factor for factor in _SPEED_FACTORS if factor <= permitted.max_factor)
        lifts += (min(command.lift, params.even_lift_m),) if permitted.low_feet else ()
    walks = _walks(profile, steps, gaits, lifts, factors, command.body_height)
    borne = (walk for walk in walks if walk.load.duty <= duty and walk.load.speed <= steps.max_joint_speed)
    return next(borne, None) or min(walks, key=lambda walk: walk.load.duty)


@lru_cache(maxsize=256)
def _walks(
    profile: RobotProfile,
    steps: StepParams,
    gaits: tuple[GaitName, ...],
    lifts: tuple[float, ...],
    factors: tuple[float, ...],
    body_height: float,
) -> tuple[Walk, ...]:
    """Return all walks of these gaits and foot heights, the fastest first, and of equal ones that with the least load."""
    found = []
    for name, lift, factor in product(gaits, lifts, factors):
        gait, pace = GAITS[name], pace_at(profile, steps, name, lift, factor)
        load = predict_load(profile, steps, name, pace, lift, body_height)
        found.append(Walk(name, profile.stance.stride / gait.stances / (pace.step_s * gait.pace), lift, pace, load))
    return tuple(sorted(found, key=lambda walk: (-walk.speed, walk.load.duty)))


class GaitChooser:
    """Chooses gait and speed; it remembers the classes of the last seconds."""

    def __init__(self, profile: RobotProfile, steps: StepParams, params: GaitChoiceParams):
        """Initialize for a robot."""
        self._profile, self._steps, self._params = profile, steps, params
        self._recent: deque[tuple[int, GroundClass, str, float]] = deque()  # [ns] time, class, reason, allowed duty

    def choose(self, now_ns: int, at: Situation, command: VelocityCommand) -> GaitChoice:
        """Return the choice for the next step.

        Args:
            now_ns: [ns] current time.
            at: The situation.
            command: The command: a gait and a speed that it gives stay; its foot and body heights are limits.
        """
        ground, reason = classify(at, self._params)
        self._recent.append((now_ns, ground, reason, allowed_duty(self._profile, at, self._params)))
        while now_ns - self._recent[0][0] > round(self._params.calm_s * 1e9):
            self._recent.popleft()
        _, ground, reason, _ = max(reversed(self._recent), key=lambda one: one[1])
        duty = min(one[3] for one in self._recent)
        walk = fastest_walk(self._profile, self._steps, self._params, ground, duty, command)
        return GaitChoice(walk, f"{ground.words}: {reason}", command.auto_speed)
