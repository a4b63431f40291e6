"""Robot profiles: those that come with Sextant, one TOML file each, and any other by the path of its file."""

from collections.abc import Iterator
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from sextant.shared.files import config
from sextant.shared.robot.kinematics import leg_inverse
from sextant.shared.robot.profile import Foot, Leg, LegLinks, RobotProfile, Stance
from sextant.shared.spelling import hint


def load_profile(name_or_path: str) -> RobotProfile:
    """Read a profile that comes with Sextant by its name, or any other by the path of its TOML file.

    A file may say `extends = "phantomx_mk2"`, or a path beside it, and give only what is different.

    Raises:
        ConfigError: No such profile, or what is wrong in it, all at once.
    """
    if name_or_path.endswith(".toml"):
        return config.build(_table(Path(name_or_path)), RobotProfile, name_or_path, also=(_STANDS,))
    with resources.as_file(_shipped(name_or_path, "robot")) as path:
        return config.load(path, RobotProfile)


def _shipped(name: str, asked_by: str) -> Traversable:
    """Where a profile that comes with Sextant is kept; what asked for it is named where there is none."""
    known = profile_names()
    if name not in known:
        ways = f"{hint(name, known)}; or give a path that ends in .toml"
        raise config.ConfigError(asked_by, [f"no profile {name[:60]!r}; {ways}"])
    return resources.files("sextant.shared.robot.profiles") / f"{name}.toml"


def _table(path: Path, extended_by: tuple[Path, ...] = ()) -> dict[str, Any]:
    """A profile's plain values: its own, over those of the profile that it extends."""
    table = config.read(path)
    base = table.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise config.ConfigError(str(path), [f"extends: the name or path of a profile expected, found {base!r}"])
    chain = (*extended_by, path.resolve())
    if not base.endswith(".toml"):
        with resources.as_file(_shipped(base, f"{path}: extends")) as shipped:
            return _over(config.read(shipped), table)
    if (path.parent / base).resolve() in chain:
        raise config.ConfigError(str(path), [f"extends: another profile expected, found {base!r}, which extends this one"])
    return _over(_table(path.parent / base, chain), table)


def _over(base: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    """The values of a table over those of another; tables are joined, all else is replaced."""
    joined = {k: _over(base[k], v) for k, v in table.items() if isinstance(v, dict) and isinstance(base.get(k), dict)}
    return {**base, **table, **joined}


def profile_names() -> list[str]:
    """Names of the profiles that come with Sextant."""
    files = resources.files("sextant.shared.robot.profiles").iterdir()
    return sorted(p.name.removesuffix(".toml") for p in files if p.name.endswith(".toml"))


def _beyond_reach(
    links: LegLinks, legs: tuple[Leg, ...], horns_deg: tuple[float, float, float], foot: Foot, stance: Stance
) -> Iterator[config.Misfit]:
    """Whether a leg does not reach the ground in the resting stance, where all that decides about it is known."""
    try:
        size = LegLinks(links.coxa, links.femur, links.tibia)
        down, (front, middle, rear) = foot.radius - stance.body_height, stance.foot_radius_from_coxa
    except AttributeError:  # told already
        return
    if not all(isinstance(horn, float) for horn in horns_deg):  # told already
        return
    unreached, unturned = [], []
    for leg, out in zip(legs, (front, front, middle, rear, rear, middle), strict=False):
        if not all(hasattr(leg, name) for name in ("name", "mount_xyz", "servo_signs", "servo_limits_deg")):
            continue
        q = np.degrees(leg_inverse(np.array([out, 0.0, down - leg.mount_xyz[2]]), size))
        servo = np.array(leg.servo_signs) * (q + horns_deg)
        low, high = np.array(leg.servo_limits_deg).T
        if not np.isfinite(q).all():
            unreached.append(leg.name)
        elif not ((low <= servo) & (servo <= high)).all():
            unturned.append(leg.name)
    where = f"feet {front:g}, {middle:g}, {rear:g} m from the coxa, the body {stance.body_height:g} m high"
    for names, why in ((unreached, "out of the legs' reach"), (unturned, "beyond the servos' limits")):
        if names:
            yield config.Misfit(
                "stance", "a resting stance that links and limits allow", f"one ({where}) {why} for {', '.join(names)}"
            )


_STANDS = config.Check(("links", "legs", "horn_offsets_deg", "foot", "stance"), _beyond_reach)
