"""Walks of robots with one error each: whether the robot names it, how soon, and whether it names anything else."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.peers import kept
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.evaluation.report import camera_errors_named
from sextant.evaluation.trials.statistics import wilson
from sextant.shared.robot.profile import JOINTS, LEGS
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.runtime.workers import share_out
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.mismatch import Deviation, Mismatch
from sextant.shared.wire import codec, topics

KINDS = ("none", "pitch", "roll", "yaw", "height", "depth", "delay", "horn")  # of errors
_NAMES = ("looks|leans|sits|measures|stamps", "horn is off|horns or links")  # of errors of the camera, and of the legs
SOON = 10  # steps within which an error should be named
_STEPS, _LONGEST_S = 20, 60  # end of a walk
_SLICE_NS = 500_000_000  # [ns] between two looks at the walk
_ANGLE_DEG, _HEIGHT_M, _DEPTH, _DELAY_S, _HORN_DEG = 3.0, 0.01, 0.03, 0.05, 4.0  # sizes of the errors
_SIZES = {axis: f"{axis}, {_ANGLE_DEG:g} deg" for axis in ("pitch", "roll", "yaw")} | {
    "height": f"height, {1000 * _HEIGHT_M:g} mm",
    "depth": f"depth, {100 * _DEPTH:g} %",
    "delay": f"stamps, {1000 * _DELAY_S:g} ms",
    "horn": f"one horn, {_HORN_DEG:g} deg",
}


@dataclass(frozen=True, slots=True)
class Error:
    """An error of a robot, and its name."""

    changes: Mapping[str, object]  # of `Deviation`
    name: str  # regular expression of a sentence that names it
    also: str = ""  # the same of one that names it among others; "" if there is none


def error(kind: str, seed: int) -> Error:
    """Return the error of a kind; the seed decides its sign, and the joint of a horn."""
    sign = 1.0 if seed % 2 else -1.0
    if kind == "none":
        return Error({}, "(?!)")  # nothing matches
    if kind == "horn":
        leg, joint = divmod(seed % 18, 3)
        horns = np.zeros((6, 3))
        horns[leg, joint] = sign * _HORN_DEG
        name = f"the {JOINTS[joint]} servo of the {LEGS[leg]} leg|^{LEGS[leg]} leg: a horn is off"
        return Error({"horns_deg": horns}, name, f"{LEGS[leg]}.* leg: a horn is off")
    change, positive, negative = _CAMERA[kind]
    return Error(change(sign), positive if sign > 0.0 else negative)


def _turned(axis: int) -> Callable[[float], Mapping[str, object]]:
    return lambda sign: {"camera_rpy_deg": np.eye(3)[axis] * sign * _ANGLE_DEG}


# Errors of the camera by a sign, and how they are named if it is positive or negative.
_CAMERA: Mapping[str, tuple[Callable[[float], Mapping[str, object]], str, str]] = {
    "roll": (_turned(0), "leans farther right", "leans farther left"),
    "pitch": (_turned(1), "looks lower", "looks higher"),
    "yaw": (_turned(2), "looks farther left", "looks farther right"),
    "height": (lambda sign: {"camera_xyz": np.array([0.0, 0.0, sign * _HEIGHT_M])}, "sits higher", "sits lower"),
    "depth": (lambda sign: {"depth_scale": sign * _DEPTH}, "measures depths longer", "measures depths shorter"),
    "delay": (lambda sign: {"stamp_offset_s": sign * _DELAY_S}, "stamps images later", "stamps images earlier"),
}


@dataclass(frozen=True, slots=True)
class _OneError(Mismatch):
    """A robot that matches its profile but for given numbers."""

    changes: Mapping[str, object] = field(default_factory=dict)

    def draw(self, rng: np.random.Generator) -> Deviation:
        """Return the deviations."""
        return replace(Mismatch().draw(rng), **self.changes)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Walk:
    """Result of one walk."""

    kind: str
    scenario: str
    seed: int
    steps: int  # of the walk
    sentence: str  # that names the error first
    others: tuple[str, ...]  # sentences that name something else
    named_at: int | None = None  # step at which the error was named first; None if it was not


def measure(
    scenarios: Sequence[str], kinds: Sequence[str], seeds: Sequence[int], jobs: int, tell: Callable[[str], object]
) -> list[Walk]:
    """Walk with each error on each course, once with each seed."""
    found = []
    tasks = [(kind, scenario, seed) for seed in seeds for scenario in scenarios for kind in kinds]
    for walk in share_out(_walk, tasks, jobs):
        found.append(walk)
        said = f"named at step {walk.named_at}" if walk.named_at is not None else "not named"
        tell(f"{walk.kind}, {walk.scenario}, seed {walk.seed}: {said}; {len(walk.others)} other names")
    return found


def _walk(kind: str, name: str, seed: int) -> Walk:
    """Walk for `_STEPS` steps, and listen to what the robot names."""
    wrong = error(kind, seed)
    scenario = replace(load_scenario(name), mismatch=_OneError(changes=wrong.changes))
    said: dict[str, int] = {}  # sentence -> step at which the robot said it first
    step = 0

    def listen(topic: AnyTopic, frame: bytes, _at_ns: int) -> None:
        nonlocal step
        if topic is topics.ACTUATOR_STATE:
            state = codec.decode(frame, topics.ACTUATOR_STATE.type)[0]
            step = state.step
            for warning in state.warnings:
                said.setdefault(warning, step)
        elif topic is topics.CAMERA_ERRORS and (finding := codec.decode(frame, topics.CAMERA_ERRORS.type)[0].finding):
            said.setdefault(finding, step)

    run = LockstepRun(scenario, seed, load_profile(scenario.robot), listen, every_frame=False)
    while step < _STEPS and run.now_ns() < _LONGEST_S * 1_000_000_000:
        run.run(run.now_ns() + _SLICE_NS)
    parts = [(part, at) for sentence, at in said.items() for part in _parts(sentence)]
    right = [(at, part) for part, at in parts if re.search(wrong.name, part)]
    also = {part for part, _ in parts if wrong.also and re.search(wrong.also, part)}
    others = sorted({part for part, _ in parts} - {part for _, part in right} - also)
    at, sentence = min(right, default=(None, ""))
    return Walk(kind, name, seed, step, sentence, tuple(others), at)


def _parts(sentence: str) -> list[str]:
    """Return each thing that a sentence names without its size; [] if it names no error of the robot."""
    if re.search(_NAMES[1], sentence):
        return [re.sub(r" *\d+ deg.*", "", sentence)]
    if not re.search(_NAMES[0], sentence):
        return []
    return [re.sub(r" [\d.]+( deg| mm| ms|%) \([^)]*\)", "", named) for named in camera_errors_named(sentence)]


def _share(hits: int, n: int) -> str:
    share = wilson(hits, n)
    return f"{hits} of {n} ({share.low:.0%} to {share.high:.0%})"


def in_words(found: Sequence[Walk]) -> str:
    """Return how many errors were named, and how many wrong names there were, as Markdown."""
    lines = [f"| error | named within {SOON} steps | later | something else named |", "|---|---|---|---|"]
    for kind in dict.fromkeys(walk.kind for walk in found):
        of_kind = [walk for walk in found if walk.kind == kind]
        named = [walk.named_at for walk in of_kind if walk.named_at is not None]
        soon, others = sum(at <= SOON for at in named), sum(bool(walk.others) for walk in of_kind)
        right = f"{_share(soon, len(of_kind))} | {len(named) - soon}" if kind in _SIZES else "- | -"
        lines.append(f"| {_SIZES.get(kind, kind)} | {right} | {_share(others, len(of_kind))} |")
    return "\n".join(lines)


def to_json(found: Sequence[Walk]) -> str:
    """Return the walks as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[Walk]:
    """Read walks written by `to_json`."""
    return kept.rows_from_json(text, Walk)
