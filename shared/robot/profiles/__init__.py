"""Robot profiles: the bundled ones, one TOML file each, and others by file path."""

from collections.abc import Iterator
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from sextant.shared.files import config
from sextant.shared.geometry import Array
from sextant.shared.robot.body import Foot, LegLinks
from sextant.shared.robot.kinematics import leg_inverse
from sextant.shared.robot.profile import Leg, RobotProfile, Stance
from sextant.shared.spelling import hint

_DESCRIPTIONS = (".urdf", ".xacro", ".xml", ".mjcf")  # suffixes of robot descriptions


def load_profile(name_or_path: str) -> RobotProfile:
    """Read a bundled profile by its name, or another one by the path of its TOML file.

    A file may extend another profile with `extends = "phantomx_mk2"`, or with a path relative to the file. It then contains
    only the values that differ.

    Raises:
        ConfigError: The profile does not exist, or is invalid; the text lists all errors.
    """
    if name_or_path.endswith(".toml"):
        return config.build(_table(Path(name_or_path)), RobotProfile, name_or_path, also=(_STANDS,))
    with resources.as_file(_shipped(name_or_path, "robot")) as path:
        return config.build(_table(path), RobotProfile, str(path))


def base_profile(name_or_path: str) -> str:
    """Return the name or path of the profile at the end of the chain that a profile extends; one that extends none is its own.

    Raises:
        ConfigError: A file does not exist, or is invalid.
    """
    if not name_or_path.endswith(".toml"):
        return name_or_path
    load_profile(name_or_path)  # the chain has an end
    base = config.read(Path(name_or_path)).get("extends")
    if base is None:
        return name_or_path
    return base_profile(str(Path(name_or_path).parent / base) if base.endswith(".toml") else base)


def _shipped(name: str, asked_by: str) -> Traversable:
    """Return the file of a bundled profile.

    The error for an unknown name mentions `asked_by`.
    """
    known = profile_names()
    if Path(name).suffix in _DESCRIPTIONS:
        ways = f"import it first: `sextant robot import {name} --out robot.toml`"
        raise config.ConfigError(asked_by, [f"a profile expected, found the robot description {name!r}; {ways}"])
    if name not in known:
        ways = f"{hint(name, known)}; or give a path that ends in .toml"
        raise config.ConfigError(asked_by, [f"no profile {name[:60]!r}; {ways}"])
    return resources.files("sextant.shared.robot.profiles") / f"{name}.toml"


def _table(path: Path, extended_by: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return the values of a profile, merged over those of its base profile."""
    table = config.read(path)
    base = table.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise config.ConfigError(str(path), [f"extends: the name or path of a profile expected, found {base!r}"])
    chain = (*extended_by, path.resolve())
    if not base.endswith(".toml"):
        with resources.as_file(_shipped(base, f"{path}: extends")) as shipped:
            return _over(_table(shipped, chain), table)
    if (path.parent / base).resolve() in chain:
        raise config.ConfigError(str(path), [f"extends: another profile expected, found {base!r}, which extends this one"])
    return _over(_table(path.parent / base, chain), table)


def _over(base: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    """Merge a table over a base table.

    Subtables are merged, and other values are replaced.
    """
    joined = {k: _over(base[k], v) for k, v in table.items() if isinstance(v, dict) and isinstance(base.get(k), dict)}
    return {**base, **table, **joined}


def profile_names() -> list[str]:
    """Return the names of the bundled profiles."""
    files = resources.files("sextant.shared.robot.profiles").iterdir()
    return sorted(p.name.removesuffix(".toml") for p in files if p.name.endswith(".toml"))


def _beyond_reach(
    links: LegLinks, legs: tuple[Leg, ...], horns_deg: tuple[float, float, float], foot: Foot, stance: Stance
) -> Iterator[config.Misfit]:
    """Yield an error if a leg cannot reach the ground in the resting stance, or at an end of the body's height range.

    Values that are missing or invalid are skipped, because other checks report them.
    """
    try:
        size = LegLinks(links.coxa, links.femur, links.tibia)
        down, (front, middle, rear) = foot.radius, stance.foot_radius_from_coxa
        height, bounds = stance.body_height, stance.body_height_range
    except AttributeError:  # already reported
        return
    if not all(isinstance(number, float) for number in (*horns_deg, *bounds)):  # already reported
        return
    whole = [all(hasattr(leg, name) for name in ("name", "mount_xyz", "servo_signs", "servo_limits_deg")) for leg in legs]
    feet = [
        (leg, np.array([out, 0.0, down - leg.mount_xyz[2]]))
        for leg, out, known in zip(legs, (front, front, middle, rear, rear, middle), whole, strict=False)
        if known
    ]

    def causes(body_height: float) -> list[str]:
        return _unreachable([(leg, foot - [0.0, 0.0, body_height]) for leg, foot in feet], size, horns_deg)

    where = f"feet {front:g}, {middle:g}, {rear:g} m from the coxa, the body"
    for cause in (at_rest := causes(height)):
        yield config.Misfit(
            "stance", "a resting stance that links and limits allow", f"one ({where} {height:g} m high) {cause}"
        )
    for i, bound in enumerate([] if at_rest else bounds):
        if found := causes(bound):
            heights = [height, *(h for h in np.arange(0.001, size.femur + size.tibia, 0.001).tolist() if not causes(h))]
            reached = f"{min(heights):.3f} to {max(heights):.3f} m"
            allowed = f"a height that links and limits allow with {where} level ({reached})"
            yield config.Misfit(f"stance.body_height_range[{i}]", allowed, f"{bound:g} m, {' and '.join(found)}")


def _unreachable(feet: list[tuple[Leg, Array]], links: LegLinks, horns_deg: tuple[float, float, float]) -> list[str]:
    """Return why legs cannot place their feet (3,) [m] {coxa}; an empty list if they can."""
    unreached, unturned = [], []
    for leg, foot in feet:
        q = np.degrees(leg_inverse(foot, links))
        servo = np.array(leg.servo_signs) * (q + horns_deg)
        low, high = np.array(leg.servo_limits_deg).T
        if not np.isfinite(q).all():
            unreached.append(leg.name)
        elif not ((low <= servo) & (servo <= high)).all():
            unturned.append(leg.name)
    both = ((unreached, "out of the legs' reach"), (unturned, "beyond the servos' limits"))
    return [f"{why} for {', '.join(names)}" for names, why in both if names]


_STANDS = config.Check(("links", "legs", "horn_offsets_deg", "foot", "stance"), _beyond_reach)
