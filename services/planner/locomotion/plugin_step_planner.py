"""A step planner of another package, in place of `StepPlanner`."""

from collections.abc import Set

import numpy as np

from sextant.services.planner.compiled_terrain import GOOD
from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.gait import gait_of
from sextant.services.planner.locomotion.replan_attempts import RefusedSteps
from sextant.services.planner.locomotion.step_planner import NoStep, PlannedStep, StepPlanner, StepStart
from sextant.services.planner.terrain import Terrain
from sextant.shared.plugins import step_planner as plugin
from sextant.shared.plugins.loading import Plugin
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.wire.messages import VelocityCommand

_ATTEMPTS = 8  # refused plans of one step, after which the planner gives up for a while


class PluginStepPlanner(StepPlanner):
    """Asks a plug-in for each step; it has no ways but the plug-in's own, and revises no running step."""

    def __init__(self, profile: RobotProfile, settings: Settings, refusals: RefusedSteps):
        """Load the plug-in that the settings name.

        Args:
            profile: The robot.
            settings: Settings of the planner.
            refusals: Refusals of the next step, which the plug-in is told.

        Raises:
            PluginError: It cannot be loaded.
        """
        super().__init__(profile, settings)
        self._plugin = Plugin.make("planner", settings.step_planner, profile)
        self._refusals = refusals
        refusals.of_plugin = True

    def choose(
        self, situations: list[StepStart], terrain: Terrain, refused: Set[int] = frozenset()
    ) -> tuple[PlannedStep | NoStep, int]:
        """Return the plug-in's step and the number of its attempt, or its reason for none."""
        if len(refused) >= _ATTEMPTS:
            return NoStep(self._refusals.words()), len(refused)
        request = self._request(situations, terrain)
        step = self._plugin.call(lambda planner: plugin.checked_step(planner.plan(request), request))
        if isinstance(step, plugin.NoStep):
            leg = f"{LEGS[step.leg]} leg: " if step.leg >= 0 else ""
            return NoStep(f"plug-in: {leg}{step.reason}", step.leg), len(refused)
        planned = PlannedStep(
            swing=step.swing,
            touchdown=step.touchdown,
            nominal=step.touchdown[:, :2],
            clearance=step.clearance,
            body_goal=step.T_world_body,
            body_after=step.T_world_body,
            start=situations[0].feet,
            moved=0,
            share=1.0,
            duration=step.duration_s,
            room=GOOD,
        )
        return planned, len(refused)

    def gather(
        self, situations: list[StepStart], terrain: Terrain, refused: Set[int] = frozenset()
    ) -> tuple[PlannedStep | NoStep, int]:
        """Return no step: the plug-in decides alone where feet go."""
        return NoStep("the plug-in plans no step on the spot"), 0

    def describe(self, planned: PlannedStep) -> str:
        """Return how many feet swing, as text: what is nominal only the plug-in knows."""
        return f"{planned.swing.sum()} feet to where the plug-in puts them"

    def describe_slowdown(self, command: VelocityCommand, stride: PlannedStep) -> str:
        """Return no text: the plug-in chooses the speed."""
        return ""

    def retarget(self, stride: PlannedStep, terrain: Terrain) -> PlannedStep:
        """Return the step as it is."""
        return stride

    def _request(self, situations: list[StepStart], terrain: Terrain) -> plugin.StepRequest:
        at = situations[0]
        command = at.command
        return plugin.StepRequest(
            T_world_body=at.T_world_body.copy(),
            feet=at.feet.copy(),
            due=tuple(one.swing.copy() for one in situations),
            velocity=np.array(command.velocity),
            yaw_rate=command.yaw_rate,
            body_height=command.body_height,
            lift=command.lift,
            step_s=self.duration(command, at.pace),
            stances=gait_of(command.gait).stances,
            map=terrain.map,
            step=at.number,
            refused=self._refusals.tries,
            refusal=self._refusals.reason,
        )
