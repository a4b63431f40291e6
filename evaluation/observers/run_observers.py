"""Observers of a run: operator, scorer and monitor; and the run's files."""

import json
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

from sextant.evaluation import params
from sextant.evaluation import report as reports
from sextant.evaluation.observers.monitor import Monitor
from sextant.evaluation.observers.operator import Operator
from sextant.evaluation.report import Report, StageTime
from sextant.evaluation.scoring.scorer import Scorer
from sextant.evaluation.walked_scenario import as_text
from sextant.shared.files import config, whole_files
from sextant.shared.files.whole_files import WriteError
from sextant.shared.recording.layout import SCENARIO
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.lateness import SlowComputer
from sextant.shared.runtime.service import Service
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.wire import topics

RECORDING = "recording.mcap"
PICTURES = ("summary.png", "passage.png", "walk.png")
_LATE_S = 2.0  # [s] of late inputs in a run from which a failure report mentions them
_LAST_LOOK_S = 6.0  # [s] simulated time for the scorer's verdict after the operator is done


class RunObservers:
    """Commands, scores and monitors one run, live or in lockstep."""

    def __init__(self, profile: RobotProfile, scenario: Scenario, seed: int, live: bool = False, linked: bool = False):
        self.operator = Operator(profile, scenario)
        self.scorer = Scorer(profile, scenario, seed)
        computer = SlowComputer(live, linked or scenario.link.exists)
        self.monitor = Monitor(None if scenario.goal.waypoints else scenario.goal.distance, computer, has_truth=True)
        self._operator_done_s: float | None = None
        # The parameters of services that were started elsewhere are not known.
        self.params = {} if linked else config.as_table(params.of_scenario(scenario))
        self.plugins = {} if linked else scenario.plugins.chosen()

    def services(self) -> Mapping[str, Service]:
        """Return the three services by name."""
        return {"operator": self.operator, "scorer": self.scorer, "monitor": self.monitor}

    def over(self) -> bool:
        """Return whether the run is over.

        It is over when the scorer has a verdict, or some time after the operator is done.
        """
        if self.scorer.finished:
            return True
        if self.operator.finished and self._operator_done_s is None:
            self._operator_done_s = self.monitor.view.time_s
        return self._operator_done_s is not None and self.monitor.view.time_s > self._operator_done_s + _LAST_LOOK_S

    def kept_up(self) -> float:
        """Return the share [1] of real time that a live simulator has simulated.

        Ground truth is missing where the simulator falls behind.
        """
        try:
            t = self.scorer.trace.t
        except ValueError:  # no ground truth arrived
            return math.nan
        return float((len(t) - 1) / (topics.TRUTH.rate_hz * (t[-1] - t[0]))) if len(t) > 1 else math.nan

    def judge(self, real_time_factor: float, ended_by: str = "", in_a_hurry: bool = False, slowed_down: str = "") -> Report:
        """Compute the report of the run.

        Args:
            real_time_factor: Simulated time over elapsed time.
            ended_by: External reason for the end of the run, which then counts as failed; else empty.
            in_a_hurry: Skip evaluations that take long.
            slowed_down: A sentence if simulated time ran slower than real time, else empty.
        """
        lateness = self.monitor.lateness
        stages = {name: StageTime(p50, p99) for name, (p50, p99) in self.monitor.stages_ms().items()}
        report = self.scorer.result(self.operator.reason, real_time_factor, stages, in_a_hurry)
        report = replace(
            report,
            too_slow=slowed_down or lateness.words,
            late_s=round(lateness.late_s, 3),
            input_ages_s=lateness.ages(),
            missed_beats=dict(sorted(lateness.missed_beats.items())),
            params=self.params,
            plugins=self.plugins,
        )
        if ended_by:
            report = replace(report, success=False, reason=ended_by)
        if not report.success and lateness.late_s >= _LATE_S:
            report = replace(report, reason=f"{report.reason}; {lateness.words}")
        return report

    def leave_behind(self, report: Report, out: Path, picture: bool = True) -> list[str]:
        """Write report.json and, if `picture` is set, pictures into a folder.

        The pictures are summary.png, walk.png if the robot walked, and passage.png if it planned over a gap.

        Returns:
            A sentence for each file that could not be written.
        """
        problems: list[str] = []
        for write in (reports.write, *((self._draw,) if picture else ())):
            try:
                write(report, out)
            except WriteError as error:
                problems.append(str(error))
        return problems

    def _draw(self, report: Report, out: Path) -> None:
        from sextant.evaluation.figures import passage_picture, walk_picture
        from sextant.evaluation.figures import (
            summary as summaries,
        )  # takes a second to import, which an interrupted run avoids

        try:
            trace = self.scorer.trace
        except ValueError:  # the run ended before the simulator sent a message
            return
        summary, passage, walk = (out / name for name in PICTURES)
        summaries.draw(summary, report, trace)
        if trace.sections:
            passage_picture.draw(passage, report, trace)
        walk_picture.draw(walk, report, trace)


def clear(out: Path) -> None:
    """Prepare a folder for a run: remove the report and pictures of an earlier one.

    Raises:
        WriteError: The folder cannot be made, or its files cannot be removed.
    """
    whole_files.make_folder(out)
    for name in (reports.FILE, *PICTURES):
        with whole_files.explained(out / name):
            (out / name).unlink(missing_ok=True)


def about(scenario: Scenario, seed: int, way: str) -> dict[str, str]:
    """Return the metadata of a recording.

    It includes the map size, the planner's settings and the parameters that were changed, which a replay uses too, and the
    whole scenario, from which figures and video draw the ground.
    """
    size = {f"map.{field.name}": str(getattr(scenario.map, field.name)) for field in fields(scenario.map)}
    walk = {"walk.blind": str(scenario.walk.blind), "walk.footholds": scenario.walk.footholds}
    tuned = {"params": json.dumps(scenario.params), "plugins": scenario.plugins.words()}
    whole = {SCENARIO: as_text(scenario)}
    return {"scenario": scenario.name, "seed": str(seed), "robot": scenario.robot, "run": way, **size, **walk, **tuned, **whole}
