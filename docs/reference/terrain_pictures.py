"""Examples of the kinds of terrain, drawn for the pages of docs/scenarios.md."""

import tomllib
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.video.ground import of_terrain
from sextant.evaluation.video.renderer import Figure, Renderer, View
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files import config, whole_files
from sextant.shared.geometry import Array, transform
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Scenario

SIZE = (480, 270)  # [px]
SEED = 1000
_QUALITY = 80  # of the files, 0 to 100
_ASIDE, _UP = np.radians(-42.0), np.radians(32.0)  # [rad] of the camera, from behind and above the horizon
_LOW, _HIGH = -0.05, 0.16  # [m] heights of the lowest and the highest colour
_FOCAL, _DISTANCE, _TARGET = 1.75, 2.7, (0.45, 0.0)  # [1], [m], [m] {world}


_PLANE = '[[terrain]]\nkind = "plane"'
_ABYSS = f"{_PLANE}\nheight = -0.4"


class Example(NamedTuple):
    """TOML of a terrain, and the ground around it in the picture."""

    toml: str
    around: str = _PLANE
    place: str = "terrain"  # table in a scenario
    behind: str = ""  # further ground in the picture


def _stretch(toml: str) -> Example:
    """Return an example of a stretch, with level ground before and behind it in the picture."""
    level = '[[terrain.stretches]]\nkind = "level"\nlength = {}'
    course = f'{_ABYSS}\n\n[[terrain]]\nkind = "course"\nwidth = 0.9\n\n{level.format(0.9)}'
    return Example(toml, course, "terrain.stretches", level.format(0.6))


_PLATFORMS = f"""{_ABYSS}
[[terrain]]
kind = "box"
xy = [0.0, 0.0]
size = [0.6, 1.0]
top = 0.0
[[terrain]]
kind = "box"
xy = [1.4, 0.0]
size = [0.6, 1.0]
top = 0.0"""

EXAMPLES = {
    "plane": Example(_PLANE, ""),
    "box": Example(
        '[[terrain]]\nkind = "box"\nxy = [0.6, 0.1]\nsize = [0.3, 0.4]\ntop = 0.06\nyaw_deg = 20.0\nxy_spread = [0.05, 0.05]'
    ),
    "hole": Example('[[terrain]]\nkind = "hole"\nxy = [0.7, 0.0]\nsize = [0.4, 0.6]\ndepth = 0.2'),
    "stairs": Example(
        '[[terrain]]\nkind = "stairs"\nxy = [0.4, 0.0]\nriser = 0.04\ntread = 0.22\ncount = 3\nwidth = 1.0\nriser_spread = 0.01'
    ),
    "pillars": Example(
        '[[terrain]]\nkind = "pillars"\nxy = [[0.42, -0.2], [0.42, 0.2], [0.7, -0.15], [0.7, 0.15], [1.0, 0.0]]\n'
        "size = 0.14\ntop = 0.0\njitter = 0.01",
        _PLATFORMS,
    ),
    "pillar_field": Example(
        '[[terrain]]\nkind = "pillar_field"\nx = [0.32, 1.08]\ny = [-0.5, 0.5]\ndensity = [0.3, 0.4]\nsize = 0.1\ntop = 0.0',
        _PLATFORMS,
    ),
    "slope": Example('[[terrain]]\nkind = "slope"\nxy = [0.4, 0.0]\nangle_deg = 12.0\nlength = 0.7\nwidth = 1.0'),
    "rubble": Example(
        '[[terrain]]\nkind = "rubble"\nx = [0.3, 1.4]\ny = [-0.5, 0.5]\ncount = 28\nsize = [0.08, 0.18]\ntop = [0.01, 0.05]'
    ),
    "height_map": Example(
        '[[terrain]]\nkind = "height_map"\nfile = "lotriet_scoring.png"\nresolution = 0.02\nxy = [-0.8, -1.2]\n'
        "scale = 0.0001\nbase = -0.1",
        "",
    ),
    "relief": Example(
        '[[terrain]]\nkind = "relief"\nx = [-0.5, 1.6]\ny = [-0.6, 0.6]\nshape = "sine"\namplitude = 0.03\nwavelength = 0.4\n'
        "begin = 0.25",
        "",
    ),
    "puddle": Example('[[terrain]]\nkind = "puddle"\nxy = [0.7, 0.1]\nsize = [0.5, 0.4]'),
    "puddles": Example('[[terrain]]\nkind = "puddles"\nx = [0.3, 1.4]\ny = [-0.5, 0.5]\ncount = 5\nsize = [0.12, 0.3]'),
    "patches": Example(
        '[[terrain]]\nkind = "patches"\nx = [0.3, 1.4]\ny = [-0.5, 0.5]\ncount = 5\nsize = [0.2, 0.5]\nfrictions = [0.15, 0.35]'
    ),
    "course": Example(
        '[[terrain]]\nkind = "course"\nwidth = 0.9\nshuffled = true\nrest = 0.1\n\n'
        '[[terrain.stretches]]\nkind = "level"\nlength = 0.9\n\n'
        '[[terrain.stretches]]\nkind = "blocks"\nlength = 0.4\ncount = 12\nsize = [0.08, 0.14]\ntop = [0.01, 0.04]\n\n'
        '[[terrain.stretches]]\nkind = "flight"\nriser = 0.03\ntread = 0.2\ncount = 2\n\n'
        '[[terrain.stretches]]\nkind = "level"\nlength = 0.6',
        _ABYSS,
    ),
    "level": _stretch('[[terrain.stretches]]\nkind = "level"\nlength = 0.4'),
    "ramp": _stretch('[[terrain.stretches]]\nkind = "ramp"\nlength = 0.5\nangle_deg = 10.0\nangle_spread_deg = 2.0'),
    "flight": _stretch('[[terrain.stretches]]\nkind = "flight"\nriser = 0.035\ntread = 0.2\ncount = 3'),
    "blocks": _stretch(
        '[[terrain.stretches]]\nkind = "blocks"\nlength = 0.8\ncount = 24\nsize = [0.08, 0.16]\ntop = [0.01, 0.05]'
    ),
    "stones": _stretch('[[terrain.stretches]]\nkind = "stones"\nlength = 0.75\nsize = 0.13\ngap = 0.05\njitter = 0.01'),
    "gap": _stretch('[[terrain.stretches]]\nkind = "gap"\nlength = 0.12'),
}  # kind -> example


def scenario(kind: str) -> Scenario:
    """Return the scenario of an example with the ground around it."""
    example = EXAMPLES[kind]
    table: dict[str, Any] = tomllib.loads(f"{example.around}\n\n{example.toml}\n\n{example.behind}")
    made = config.build({"name": kind, "goal": {"distance": 1.0}, **table}, Scenario, kind)
    return replace(made, folder=str(resources.files("sextant.shared.scenario.scenarios")))


def draw(kind: str) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) R, G, B of a kind of terrain, with a robot that stands in front of it."""
    terrain = build_terrain(scenario(kind), np.random.default_rng(SEED))
    profile = load_profile("phantomx_mk2")
    feet = profile.rest_feet()
    p = np.array([0.0, 0.0, profile.stance.body_height + float(terrain.height_at(feet[:, :2]).max())])
    figure = Figure(transform(np.eye(3), p), body_inverse(profile, feet), np.ones(6, dtype=bool))
    renderer = Renderer(profile, SIZE)
    ground = of_terrain(terrain, np.array([[-0.5, 0.0], [1.5, 0.0]]))
    renderer.stand_on(replace(ground, low=_LOW, high=_HIGH))
    return renderer.paint(figure, _view(p))


def _view(p: Array) -> View:
    look = np.array([np.cos(_ASIDE) * np.cos(_UP), -np.sin(_ASIDE) * np.cos(_UP), -np.sin(_UP)])
    x = np.cross(look, np.array([0.0, 0.0, 1.0]))
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(look, x), look])
    return View(transform(R, np.array([*_TARGET, 0.0]) - _DISTANCE * look), _FOCAL, _DISTANCE)


def write(folder: Path) -> None:
    """Write the picture of each kind into a folder, which is created if missing."""
    whole_files.make_folder(folder)
    for kind in EXAMPLES:
        done, data = cv2.imencode(".webp", draw(kind)[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
        assert done
        whole_files.write_bytes(folder / f"{kind}.webp", data.tobytes())
