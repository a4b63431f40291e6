"""Gymnasium environment of a hexapod on rough terrain: the whole robot in lockstep, led by velocity commands.

    >>> import gymnasium
    >>> env = gymnasium.make("sextant.gym:sextant/Hexapod-v0", scenario="steps")

All services run in it: camera, registration, map, planner and servos. An action is a velocity, held for `step_s` seconds of
simulated time; the planner chooses the footholds. Observations are the robot's own estimates. The ground truth determines the
reward and the end of an episode.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, TypeVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.shared.errors import SextantError
from sextant.shared.geometry import Array, apply, inverse, rotation_z, rpy_from_rotation, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Scenario, Walk
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    GroundTruth,
    Message,
    Mode,
    ModeCommand,
    TerrainMap,
    Tick,
    VelocityCommand,
)

MAX_YAW_RATE = 0.3  # [rad/s] of an action of 1
_CELLS, _CELL_M = 24, 0.05  # cells along an edge of the height patch, and their edge
_HEIGHT_M, _FAR_M = 0.5, 20.0  # largest height and distance in an observation
_ORDER_NS = 500_000_000  # interval of repeated orders
_LOOK_NS = 100_000_000  # simulated time between two checks whether the robot is ready
_READY_S = 60.0  # simulated time for the robot to stand up

Observation = dict[str, Any]  # arrays by name
M = TypeVar("M", bound=Message)


class EpisodeError(SextantError, RuntimeError):
    """An episode cannot start or go on."""

    exit_status = 1


class HexapodEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Walk to the goal line of a scenario.

    Action: (3,) in [-1, 1]: forward, left, turn left, as shares of the robot's highest speed and of `MAX_YAW_RATE`.

    Observation, a Dict; the heading frame is {body} without roll and pitch:
        heights: (24, 24) [m] of the map above the feet's mean height, around the body in cells of 5 cm, row 0 at the back and
            column 0 on the right.
        known: (24, 24) whether a cell's height is known; heights of unknown cells are 0.
        feet: (6, 3) [m] {body} measured foot centres.
        contact: (6,) legs that carry load.
        tilt: (2,) [rad] estimated roll and pitch.
        command: (3,) the action before.
        goal: (2,) [m] estimated position of the goal line's middle in the heading frame.

    Reward: true progress toward the goal [m]; 1 more at the goal, 1 less for a fall or servos that shut down.

    An episode terminates there, and is truncated at the scenario's time limit. `info` has the simulated time [s], the seed of
    the run and, at the end, the reason. The seed of `reset` is that of `sextant run --seed`; it determines the episode.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, scenario: str = "steps", robot: str = "", step_s: float = 1.0):
        """Load the scenario.

        Args:
            scenario: Name or TOML file; without a planned route and without passage.
            robot: Profile by name or TOML file; empty for the scenario's.
            step_s: Simulated time [s] of an action, 0.1 to 10.

        Raises:
            ConfigError: The scenario or the profile is wrong.
            ValueError: `step_s` is out of range, or the scenario is a passage.
        """
        found = load_scenario(scenario)
        if not 0.1 <= step_s <= 10.0:
            raise ValueError(f"step_s of 0.1 to 10 s expected, found {step_s}")
        if found.goal.passage:
            raise ValueError(f"a scenario that is walked by velocity expected, found {found.name}, which is a passage")
        self._scenario: Scenario = replace(found, robot=robot) if robot else found
        self._profile: RobotProfile = load_profile(self._scenario.robot)
        self._step_ns = round(step_s * 1e9)
        self._scale = np.array([*[self._profile.stance.max_speed] * 2, MAX_YAW_RATE])
        self._run: LockstepRun | None = None
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        parts: dict[str, spaces.Space[Any]] = {
            "heights": spaces.Box(-_HEIGHT_M, _HEIGHT_M, (_CELLS, _CELLS), np.float32),
            "known": spaces.MultiBinary((_CELLS, _CELLS)),
            "feet": spaces.Box(-_FAR_M, _FAR_M, (6, 3), np.float32),
            "contact": spaces.MultiBinary(6),
            "tilt": spaces.Box(-np.pi, np.pi, (2,), np.float32),
            "command": spaces.Box(-1.0, 1.0, (3,), np.float32),
            "goal": spaces.Box(-_FAR_M, _FAR_M, (2,), np.float32),
        }
        self.observation_space = spaces.Dict(parts)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start a new run, and let the robot stand up; without a seed one is drawn."""
        super().reset(seed=seed)
        self._seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._newest: dict[AnyTopic, bytes] = {}
        walk = self._scenario.walk
        height = self._profile.stance.height_or_own(walk.body_height)
        self._driver = _Driver(replace(walk, body_height=height))
        self._command = np.zeros(3, np.float32)
        self._run = LockstepRun(
            self._scenario, self._seed, self._profile, self._tap, every_frame=False, around={"operator": lambda _: self._driver}
        )
        while not (self._driver.leads and topics.TERRAIN in self._newest):
            if self._run.now_ns() > _READY_S * 1e9:
                raise EpisodeError(f"the robot does not stand within {_READY_S:g} s; `sextant run` shows why")
            self._run.run(self._run.now_ns() + _LOOK_NS)
        self._T_start = self._latest(GroundTruth).T_world_body
        self._walked = 0.0
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Walk at a velocity for `step_s` seconds.

        Raises:
            EpisodeError: `reset` was not called.
            ValueError: The action is not in the action space.
            ServiceFailedError: A service has failed.
        """
        if self._run is None:
            raise EpisodeError("reset() expected before step()")
        self._command = np.asarray(action, np.float32)
        if not self.action_space.contains(self._command):
            raise ValueError(f"an action (3,) from -1 to 1 expected, found {action}")
        forward, left, yaw_rate = (self._command * self._scale).tolist()
        self._driver.velocity, self._driver.yaw_rate = np.array([forward, left]), yaw_rate
        self._run.run(self._run.now_ns() + self._step_ns)
        before = self._walked
        self._walked = float((inverse(self._T_start) @ self._latest(GroundTruth).T_world_body)[0, 3])
        reached = self._walked >= self._scenario.goal.distance
        truncated = not reached and self._run.now_ns() >= self._scenario.time_limit_s * 1e9
        scorer = self._run.attendance.scorer
        failed = scorer.finished and not reached and not truncated
        info = self._info()
        if reached or failed or truncated:
            info["reason"] = "goal reached" if reached else scorer.reason or "time limit"
        return self._observation(), self._walked - before + reached - failed, reached or failed, truncated, info

    def _tap(self, topic: AnyTopic, frame: bytes, _at_ns: int) -> None:
        self._newest[topic] = frame

    def _latest(self, kind: type[M]) -> M:
        """Return the newest message of a type."""
        message, _ = codec.decode(self._newest[topics.OF_TYPE[kind]], kind)
        return message

    def _info(self) -> dict[str, Any]:
        assert self._run is not None
        return {"time_s": self._run.now_ns() * 1e-9, "seed": self._seed}

    def _observation(self) -> Observation:
        state, T = self._latest(ActuatorState), self._latest(BodyPose).T_world_body
        floor = float(np.mean(apply(T, state.feet)[:, 2])) - self._profile.foot.radius
        heights = _patch(self._latest(TerrainMap), T) - floor
        known = np.isfinite(heights)
        goal = rotation_z(-yaw_of(T))[:2, :2] @ (np.array([self._scenario.goal.distance, 0.0]) - T[:2, 3])
        return {
            "heights": np.clip(np.where(known, heights, 0.0), -_HEIGHT_M, _HEIGHT_M).astype(np.float32),
            "known": known.astype(np.int8),
            "feet": np.clip(state.feet, -_FAR_M, _FAR_M).astype(np.float32),
            "contact": state.contact.astype(np.int8),
            "tilt": rpy_from_rotation(T[:3, :3])[:2].astype(np.float32),
            "command": self._command.copy(),
            "goal": np.clip(goal, -_FAR_M, _FAR_M).astype(np.float32),
        }


def _patch(terrain: TerrainMap, T_world_body: Array) -> Array:
    """Return map heights [m] around the body, (24, 24) in its heading frame, NaN where unknown."""
    along = (np.arange(_CELLS) - (_CELLS - 1) / 2) * _CELL_M
    xy = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1) @ rotation_z(yaw_of(T_world_body))[:2, :2].T
    ij = np.round((xy + T_world_body[:2, 3] - terrain.origin) / terrain.resolution).astype(int)
    inside = ((ij >= 0) & (ij < terrain.elevation.shape)).all(axis=-1)
    heights = np.full((_CELLS, _CELLS), np.nan)
    heights[inside] = terrain.elevation[tuple(ij[inside].T)]
    return heights


class _Driver:
    """Operator that lets the robot stand up, and then repeats the environment's velocity."""

    name = "operator"
    subscribes: tuple[AnyTopic, ...] = (topics.ACTUATOR_STATE, topics.BODY_POSE)
    publishes: tuple[AnyTopic, ...] = (topics.VELOCITY, topics.MODE)

    def __init__(self, walk: Walk):
        self.trigger = Every.hz(topics.VELOCITY.rate_hz)
        self.stages = Stages()
        self.velocity, self.yaw_rate = np.zeros(2), 0.0
        self.leads = False  # whether the robot stands and is ordered to walk
        self._walk, self._robot = walk, RobotClockEstimate()
        self._given_ns, self._due_ns, self._rising = -1, 0, False

    def status(self) -> str:
        """Return the current activity."""
        return "leading" if self.leads else "standing up"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Order to stand, then to walk at the velocity."""
        state = inbox.latest(topics.ACTUATOR_STATE)
        self._robot.see(tick.stamp_ns, None if state is None else state.stamp_ns)
        if state is None or not self._robot.known:
            return
        self._rising |= state.mode is Mode.STAND
        starts = not self.leads and self._rising and state.mode is Mode.HOLD and inbox.latest(topics.BODY_POSE) is not None
        if starts or self._given_ns < 0:
            self.leads, self._given_ns, self._due_ns = starts, max(self._given_ns + 1, self._robot()), 0
        if tick.stamp_ns >= self._due_ns:
            self._due_ns = tick.stamp_ns + _ORDER_NS
            yield ModeCommand(self._robot(), "walk" if self.leads else "stand", self._given_ns)
        if self.leads:
            walk = self._walk
            how = walk.body_height, walk.lift, walk.gait
            yield VelocityCommand(self._robot(), self.velocity, self.yaw_rate, *how, auto_speed=walk.auto_speed)


gymnasium.register(id="sextant/Hexapod-v0", entry_point="sextant.gym:HexapodEnv")
