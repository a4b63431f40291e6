"""Calibrations of simulated robots that differ from their profile: errors, and whether the stated uncertainty holds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from benchmarks.peers import kept
from sextant.evaluation.lockstep.calibration_run import rehearse
from sextant.evaluation.trials.statistics import wilson
from sextant.services.perception.calibration.calibrated_robot import CalibrationError
from sextant.shared.runtime.workers import share_out
from sextant.shared.scenario.loading import load_scenario

_UNITS = {"x": (1e3, "mm"), "y": (1e3, "mm"), "z": (1e3, "mm"), "depth_error": (100.0, "%"), "time_offset_s": (1e3, "ms")}


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result of one seed."""

    scenario: str
    seed: int
    refusal: str  # why nothing would be written, or ""
    errors: dict[str, float]  # of the camera's numbers, see `Rehearsal.errors`; empty without a result
    sigma: dict[str, float]  # their stated standard deviations
    known_legs: int


def measure(scenario: str, seeds: Sequence[int], jobs: int, tell: Callable[[str], object]) -> list[Calibration]:
    """Calibrate the robot of a scenario with each seed."""
    found = []
    for one in share_out(_calibrate, [(scenario, seed) for seed in seeds], jobs):
        found.append(one)
        tell(f"seed {one.seed}: {one.refusal or f'{one.known_legs} legs and the camera are calibrated'}")
    return found


def _calibrate(scenario: str, seed: int) -> Calibration:
    try:
        found = rehearse(load_scenario(scenario), seed)
    except CalibrationError as error:
        return Calibration(scenario, seed, str(error), {}, {}, 0)
    robot = found.robot
    return Calibration(scenario, seed, "; ".join(robot.refusals), found.errors, robot.camera_sigma, len(robot.known_legs))


def in_words(found: Sequence[Calibration]) -> str:
    """Return medians and coverage as Markdown."""
    good = [one for one in found if not one.refusal]
    lines = ["| number | error, median | largest | within its 95 % interval |", "|---|---|---|---|"]
    for name in good[0].errors if good else ():
        scale, unit = _UNITS.get(name, (1.0, "deg"))
        errors = [scale * abs(one.errors[name]) for one in good]
        held = wilson(sum(abs(one.errors[name]) <= 2.0 * one.sigma[name] for one in good), len(good))
        share = f"{held.successes} of {held.n} ({held.low:.0%} to {held.high:.0%})"
        lines.append(f"| `{name}` | {median(errors):.2f} {unit} | {max(errors):.2f} {unit} | {share} |")
    courses = ", ".join(dict.fromkeys(f"`{one.scenario}`" for one in found))
    lines += ["", f"{len(good)} of {len(found)} calibrations over {courses} are written."]
    return "\n".join(lines)


def to_json(found: Sequence[Calibration]) -> str:
    """Return the results as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[Calibration]:
    """Read results written by `to_json`."""
    return kept.rows_from_json(text, Calibration)
