"""Libraries that only an extra of the package brings, and what to do without one."""

import json
import os
import sys
from collections.abc import Sequence
from importlib.metadata import distribution
from pathlib import Path

_ALL = "all"  # brings what a simulated robot needs, from several extras
# Module -> name of its library, and the extra that brings it, the smallest where there are several.
EXTRAS = {
    "cryptography": ("cryptography", "access"),
    "cv2": ("opencv-python-headless", _ALL),
    "distributed": ("distributed", "cluster"),
    "foxglove": ("foxglove-sdk", "foxglove"),
    "foxglove_schemas_protobuf": ("foxglove-schemas-protobuf", "recording"),
    "google": ("protobuf", "recording"),
    "gymnasium": ("gymnasium", "gym"),
    "kiss_icp": ("kiss-icp", "perception"),
    "lz4": ("lz4", "recording"),
    "matplotlib": ("matplotlib", "recording"),
    "mcap": ("mcap", "recording"),
    "mujoco": ("mujoco", _ALL),
    "numba": ("numba", _ALL),
    "PIL": ("pillow", "recording"),
    "rerun": ("rerun-sdk", "rerun"),
    "rich": ("rich", _ALL),
    "rosbags": ("rosbags", "ros2"),
    "serial": ("pyserial", "actuator"),
    "websockets": ("websockets", "console"),
    "xxhash": ("xxhash", "ros2"),
}


def remedy(error: ModuleNotFoundError) -> str:
    """Return which library is missing and how to install it, or "" if no extra brings it."""
    found = EXTRAS.get((error.name or "").partition(".")[0])
    if found is None:
        return ""
    library, extra = found
    return (
        f"{library} is not installed; the extra {extra} brings it: pip install 'sextant[{extra}]', in a checkout '.[{extra}]'"
    )


def uvx_command(argv: Sequence[str]) -> list[str]:
    """Return the command with the extra `all`, if `uvx --from SOURCE sextant` runs this one; else an empty list."""
    uv, temporary = os.environ.get("UV"), "archive-v0" in Path(sys.prefix).parts  # uv's folder of temporary environments
    if not (uv and temporary):
        return []
    source = json.loads(distribution("sextant").read_text("direct_url.json") or "{}").get("url")
    wanted = f"sextant[{_ALL}]" + (f" @ {source}" if source else "")
    return [uv, "tool", "run", "--python", sys.executable, "--from", wanted, "sextant", *argv]
