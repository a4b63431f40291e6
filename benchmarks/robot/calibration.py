"""Calibrations of simulated robots that differ from their profile: errors, and whether the stated uncertainty holds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
    errors: dict[str, float]  # see `Rehearsal.errors`; empty without a result
    sigma: dict[str, float]  # their stated standard deviations
    known_legs: int


def measure(robot: str, scenario: str, seeds: Sequence[int], jobs: int, tell: Callable[[str], object]) -> list[Calibration]:
    """Calibrate a robot, with the deviations of a scenario, with each seed."""
    found = []
    for one in share_out(_calibrate, [(robot, scenario, seed) for seed in seeds], jobs):
        found.append(one)
        tell(f"seed {one.seed}: {one.refusal or f'{one.known_legs} legs and the camera are calibrated'}")
    return found


def _calibrate(profile: str, scenario: str, seed: int) -> Calibration:
    try:
        found = rehearse(replace(load_scenario(scenario), robot=profile), seed)
    except CalibrationError as error:
        return Calibration(scenario, seed, str(error), {}, {}, 0)
    robot = found.robot
    sigma = {**robot.camera_sigma, **{f"imu_{name}": value for name, value in robot.imu_sigma.items()}}
    return Calibration(scenario, seed, "; ".join(robot.refusals), found.errors, sigma, len(robot.known_legs))


def in_words(found: Sequence[Calibration]) -> str:
    """Return medians and coverage as Markdown."""
    good = [one for one in found if not one.refusal]
    lines = ["| number | error, median | largest | within its 95 % interval |", "|---|---|---|---|"]
    for name in dict.fromkeys(name for one in good for name in one.errors):
        scale, unit = _UNITS.get(name, (1.0, "deg"))
        known = [one for one in good if name in one.errors]
        errors = [scale * abs(one.errors[name]) for one in known]
        held = wilson(sum(abs(one.errors[name]) <= 2.0 * one.sigma[name] for one in known), len(known))
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
