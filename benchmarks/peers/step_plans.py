"""Step planners at the same requests: time of a plan, share of requests with a step, and share that the actuator accepts.

Sextant's planner walks in lockstep and its requests are kept. Then every planner gets each of them, so that none is judged by
where its own steps have led.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.peers.timing import Measured, Race, Timing, one_core
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.actuator.config import Settings as ActuatorSettings
from sextant.services.actuator.safety.plan_validation import PlanCheck
from sextant.services.planner.config import Settings as PlannerSettings
from sextant.services.planner.locomotion.gait import GAITS
from sextant.services.planner.locomotion.step_planner import PlannedStep, StepStart
from sextant.services.planner.locomotion.step_planner import StepPlanner as SextantPlanner
from sextant.services.planner.terrain import Terrain
from sextant.shared.plugins.loading import Plugin, Plugins
from sextant.shared.plugins.step_planner import NoStep, Step, StepPlanner, StepRequest, checked_step
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.wire.messages import StepPlan, VelocityCommand

OURS = "Sextant"
COURSES = ("steps", "rubble", "stepping_stones")  # by default
HEADINGS = {"solved": ("solved, %", 100.0, 1), "accepted": ("accepted, %", 100.0, 1), "travel_mm": ("travel, mm", 1.0, 1)}
_WALK_NS = 250_000_000  # [ns] simulated time between two looks whether the walk is over
_LIMIT_NS = 60_000_000_000  # [ns] simulated time of a walk


class SextantSteps:
    """Sextant's own step planner behind the interface of plug-ins."""

    def __init__(self, profile: RobotProfile):
        """Initialize for a robot."""
        self._settings = PlannerSettings()
        self._planner = SextantPlanner(profile, self._settings)
        self._refused: set[int] = set()  # ways of the present step that the actuator has refused
        self._way = 0

    def plan(self, request: StepRequest) -> Step | NoStep:
        """Return the step that Sextant takes."""
        self._refused = self._refused | {self._way} if request.refused else set()
        gait = next(name for name, gait in GAITS.items() if gait.stances == request.stances)
        command = VelocityCommand(-1, request.velocity, request.yaw_rate, request.body_height, request.lift, gait)
        starts = [StepStart(request.T_world_body, request.feet, swing, command) for swing in request.due]
        terrain = Terrain(request.map, self._settings.footholds, self._settings.foothold)
        found, self._way = self._planner.choose(starts, terrain, self._refused)
        if not isinstance(found, PlannedStep):
            return NoStep(found.reason, found.leg)
        return Step(found.swing, found.touchdown, found.body_goal, found.clearance, found.duration)


class Recorder(SextantSteps):
    """Plug-in that keeps each request."""

    requests: list[StepRequest] = []  # noqa: RUF012 - of all objects, because the planner service makes its own

    def plan(self, request: StepRequest) -> Step | NoStep:
        """Return the step that Sextant takes, and keep the request."""
        self.requests.append(request)
        return super().plan(request)


def measure(
    scenarios: Sequence[Scenario],
    seeds: Sequence[int],
    count: int,
    plugin: str = "",
    say: Callable[[str], object] = lambda _: None,
) -> Measured:
    """Compare step planners.

    Figures: `solved`, share of the requests with a step; `accepted`, share of these steps that the actuator would execute;
    `travel_mm`, mean horizontal motion of the body in them.

    Args:
        scenarios: Courses to walk; each names its robot.
        seeds: One walk over each course for each seed.
        count: Most requests of a walk.
        plugin: Name of a step planner that is compared; empty for none.
        say: Called with the progress.

    Raises:
        PluginError: The plug-in failed.
        ConfigError: A course cannot be built.
    """
    out: list[Timing] = []
    with one_core():
        for scenario in scenarios:
            profile = load_profile(scenario.robot)
            race = Race("step plan", scenario.name, warm=1)
            judge = _Judge(profile)
            for seed in seeds:
                planners: dict[str, Callable[[StepRequest], Step | NoStep]] = {OURS: SextantSteps(profile).plan}
                if plugin:
                    planners[plugin] = _checked(Plugin.make("planner", plugin, profile))
                race.start(planners)
                requests = requests_of(scenario, seed, count)
                for request in requests:
                    judge.note(request, race.run(request))
                say(f"plans: {scenario.name}, seed {seed} done, {len(requests)} requests")
            out += race.timings(judge.figures())
    return Measured(timings=tuple(out))


def requests_of(scenario: Scenario, seed: int, count: int) -> list[StepRequest]:
    """Return the first requests of a walk of Sextant's planner over a course."""
    Recorder.requests = []
    walked = replace(scenario, plugins=Plugins(planner=f"{__name__}:{Recorder.__name__}"))
    run = LockstepRun(walked, seed, load_profile(scenario.robot), every_frame=False)
    while len(Recorder.requests) < count and not run.attendance.over() and run.now_ns() < _LIMIT_NS:
        run.run(run.now_ns() + _WALK_NS)
    return Recorder.requests[:count]


def _checked(plugin: Plugin) -> Callable[[StepRequest], Step | NoStep]:
    def plan(request: StepRequest) -> Step | NoStep:
        def ask(planner: StepPlanner) -> Step | NoStep:
            return checked_step(planner.plan(request), request)

        return plugin.call(ask)

    return plan


class _Judge:
    """Counts the solved requests, accepted steps and travel of each planner."""

    def __init__(self, profile: RobotProfile):
        settings = ActuatorSettings()
        self._handover_s, self._plan_age_s = settings.unload_s + settings.load_s, settings.plan_age_s
        self._profile = profile
        self._solved: dict[str, list[bool]] = {}
        self._accepted: dict[str, list[bool]] = {}
        self._travel_m: dict[str, list[float]] = {}

    def note(self, request: StepRequest, found: Mapping[str, Step | NoStep]) -> None:
        """Judge the answers to a request."""
        for name, step in found.items():
            self._solved.setdefault(name, []).append(isinstance(step, Step))
            if isinstance(step, Step):
                self._accepted.setdefault(name, []).append(not self._refusal(request, step))
                way = step.T_world_body[:2, 3] - request.T_world_body[:2, 3]
                self._travel_m.setdefault(name, []).append(float(np.linalg.norm(way)))

    def figures(self) -> dict[str, dict[str, float]]:
        """Return the figures of each planner; without a step there are none but `solved`."""
        out = {name: {"solved": float(np.mean(solved))} for name, solved in self._solved.items()}
        for name, accepted in self._accepted.items():
            out[name] |= {"accepted": float(np.mean(accepted)), "travel_mm": 1e3 * float(np.mean(self._travel_m[name]))}
        return out

    def _refusal(self, request: StepRequest, step: Step) -> str:
        """Return why the actuator would refuse a step, or an empty string."""
        plan = StepPlan(
            stamp_ns=0,
            epoch=0,
            step=1,
            revision=0,
            T_world_odom=np.eye(4),
            swing=step.swing,
            touchdown=step.touchdown,
            clearance=step.clearance,
            body_goal=step.T_world_body,
            duration=step.duration_s,
            stop=False,
        )
        check = PlanCheck(self._profile, self._plan_age_s, handover_s=self._handover_s)
        return check.unwalkable(plan, request.T_world_body, request.feet)
