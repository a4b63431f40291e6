"""`sextant plan`: footholds, path and gap crossings on a map, without a robot."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, out_folder, say
from sextant.deploy.terminal.arguments import Choice, Parsed, argument, command, flag, number, option, options_of

if TYPE_CHECKING:
    from sextant.shared.wire.messages import GaitName

_FARTHEST_M = 1e4


def _place(text: str) -> tuple[float, ...]:
    return _numbers(text, (2,), "two lengths X,Y in metres")


def _pose(text: str) -> tuple[float, ...]:
    x, y, *yaw_deg = _numbers(text, (2, 3), "X,Y or X,Y,YAW in metres and degrees")
    return x, y, math.radians(yaw_deg[0] if yaw_deg else 0.0)


def _numbers(text: str, counts: tuple[int, ...], expected: str) -> tuple[float, ...]:
    parts = text.split(",")
    found = tuple(float(part) for part in parts) if len(parts) in counts else ()
    if not found or not all(abs(value) <= _FARTHEST_M for value in found):
        raise ValueError(f"{expected} expected, found {text!r}")
    return found


@dataclass(frozen=True, slots=True)
class _MapOptions:
    """What a map file does not tell."""

    resolution: float | None
    scale: float | None
    layer: str
    topic: str


@command()
@argument("map_file", "heights: .npy, .png, .mcap with a GridMap, or a recorded walk", "MAP")
@option("--goal", "goal of the body [m]", "X,Y", type=Parsed(_place, "place"), required=True)
@option("--start", "place of the body [m] and its yaw [deg]", "X,Y[,YAW]", type=Parsed(_pose, "pose"), default="0,0,0")
@option("--robot", "robot profile, by name or TOML file", "PROFILE", default="phantomx_mk2")
@option("--gait", "groups of legs that swing together", type=Choice(("tripod", "ripple", "wave")), default="tripod")
@options_of(
    _MapOptions,
    "of_map",
    option("--resolution", "edge of the cells of a .npy or .png [m]", "M", type=number(0.001, 0.2, "m")),
    option("--scale", "metres per grey value of a .png", "M", type=number(1e-6, 1.0, "m")),
    option("--layer", "layer of a GridMap", "NAME", default="elevation"),
    option("--topic", "topic of a GridMap, if there are several", "NAME", default=""),
)
@flag("--around", "only go around gaps, and never cross one")
@options.out
@options.as_json
def plan(
    map_file: str,
    goal: tuple[float, float],
    start: tuple[float, float, float],
    robot: str,
    gait: "GaitName",
    of_map: _MapOptions,
    around: bool,
    out: str | None,
    as_json: bool,
) -> int:
    """Plan a walk on a map without a robot: plan.json and plan.png.

    Cell (0, 0) of a .npy or .png lies at 0,0 [m], and rows run along x. The plan is an upper bound: nothing sinks or slips.
    """
    from sextant.evaluation.map_plan.map_file import read_map
    from sextant.evaluation.map_plan.map_walk import plan_on_map
    from sextant.evaluation.map_plan.plan_picture import draw_plan
    from sextant.shared.files import whole_files
    from sextant.shared.robot.profiles import load_profile

    profile, ground = load_profile(robot), read_map(Path(map_file), **asdict(of_map))
    found = plan_on_map(
        profile, ground.heights, ground.resolution, goal, start=start, origin=ground.origin, gait=gait, cross_gaps=not around
    )
    folder = out_folder(out, "plan")
    summary = {"robot": profile.name, "gait": gait, "map": map_file, **found.summary()}
    text = json.dumps(summary, indent=1)
    whole_files.write_text(folder / "plan.json", text + "\n")
    draw_plan(folder / "plan.png", found)
    crossing = sum(move.crosses for move in found.moves)
    if as_json:
        say(text)
    else:
        say(f"{'goal reached' if found.reached else 'goal not reached'}: {found.reason}")
        say(f"{found.length:.2f} m in {len(found.moves)} moves, {crossing} of them across a gap")
        say(f"written to {folder}: plan.json, plan.png")
    return SUCCESS if found.reached else FAILED
