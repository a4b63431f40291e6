"""Fuzz targets: parsers of files, each with valid examples.

A valid refusal is one sentence that names the file.
"""

import json
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields
from importlib import resources
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np

from benchmarks.fuzz.mutators import broken, odd_table
from benchmarks.fuzz.target import Folder, Target
from sextant.deploy.launch import fleet
from sextant.deploy.security.authority import Authority, held
from sextant.evaluation import report as reports
from sextant.evaluation.trials import results_store
from sextant.services.actuator import config as actuator
from sextant.services.perception import tum
from sextant.services.simulator.physics import mjcf_description, model
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files import array_file, config, input_file, picture_file
from sextant.shared.robot import urdf
from sextant.shared.robot.description.profile_import import import_profile
from sextant.shared.robot.description.robot_description import DescriptionError, RobotDescription, read_urdf
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime import process
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import access

_NESTED = 0.8  # probability that the mutation goes into a nested table
_FLEET = """[robots.alpha]
connect = ["tcp/127.0.0.1:7447"]
without = ["mapper"]
set = ["planner.blind=true"]
[page]
port = 8080
"""
_CAMERA = """width = 4
height = 3
fx = 9.0
fy = 9.0
cx = 2.0
cy = 1.5
depth_scale = 5000
gravity_world = [0, 0, -1]
k1 = 0
"""
_CALIBRATED = """extends = "phantomx_mk2"
[links]
femur = 0.07
[[calibration]]
leg = "left rear"
date = 2026-07-30
trims_deg = [1, 0, -2.5]
"""
_FRAMES = "# timestamp filename\n0.0 depth/0.png\n1700000000.033333 depth/1.png\n"
_POSES = "# timestamp tx ty tz qx qy qz qw\n0.0 0 0 0.5 0 0 0 1\n0.033333 0.1 0 0.5 0.0 0.6 0.0 0.8\n"
_OWN_ERRORS = (config.ConfigError, input_file.FileError, results_store.ResultsError, access.AccessError)


def file_targets() -> tuple[Target, ...]:
    """Return the targets for files.

    They are scenarios, profiles, robot descriptions, settings, text files of recordings, pictures, arrays, keys, and results of
    earlier runs.
    """
    folder = Folder()
    place = folder.path
    grey = np.arange(12, dtype=np.uint16).reshape(3, 4) * 4000
    pictures = [cv2.imencode(".png", picture)[1].tobytes() for picture in (grey, cv2.merge([grey.astype(np.uint8)] * 3))]
    scenarios = _shipped("scenario.scenarios", "steps", "mixed", "rubble")
    profiles = [*_shipped("robot.profiles", "phantomx_mk2"), _CALIBRATED.encode()]
    robot = load_profile("phantomx_mk2")
    described = [text.encode() for text in (urdf.urdf(robot), model.mjcf(robot))]
    Authority(days=30).issue(place / "keys", "base")

    def target(name: str, file: str, examples: Sequence[bytes], twisted: Callable[[bytes, Random], bytes], read: Any) -> Target:
        path = place / file

        def take(data: bytes, _: Any = folder) -> bool:  # the default keeps the folder alive as long as the target
            path.write_bytes(data)
            try:
                read(path)
            except _OWN_ERRORS as error:
                _check_refusal(str(error), path.name)
                return False
            return True

        return Target(name, tuple(examples), twisted, take)

    return (
        target("file, scenario", "scenario.toml", scenarios, _odd_toml, _read_scenario),
        target("file, profile", "robot.toml", profiles, _odd_toml, _read_profile),
        target("file, URDF", "robot.urdf", described[:1], _odd_attributes, _imported(_read_urdf)),
        target("file, MJCF", "robot.xml", described[1:], _odd_attributes, _imported(mjcf_description.read_mjcf)),
        target("file, settings", "settings.toml", [b"rate_hz = 100.0\narc = 'flow'\n"], _odd_toml, _read_settings),
        target("file, fleet", "fleet.toml", [_FLEET.encode()], _odd_toml, fleet.load),
        target("file, camera.toml", "camera.toml", [_CAMERA.encode()], _odd_toml, tum.read_camera),
        target("file, depth.txt", "depth.txt", [_FRAMES.encode()], _odd_words, tum.read_images),
        target("file, groundtruth.txt", "groundtruth.txt", [_POSES.encode()], _odd_words, tum.read_trajectory),
        target("file, kept runs", "campaign.jsonl", [_kept()], _odd_json, results_store.read),
        target("file, report", "report.json", [reports.to_json(_report()).encode()], _odd_json, _read_report),
        target("file, heights", "heights.npy", list(_arrays(place / "array.npy")), _odd_array, array_file.read_numbers),
        target("file, picture", "picture.png", pictures, _odd_picture, _read_picture),
        target("file, role", f"keys/{access.ROLE}", [(place / "keys" / access.ROLE).read_bytes()], _odd_toml, _read_keys),
        target(
            "file, certificate", f"keys/{access.CERTIFICATE}", [(place / "keys" / access.CERTIFICATE).read_bytes()], _odd_words,
            lambda path: list(held(path.parent)),
        ),
    )  # fmt: skip


def _check_refusal(words: str, name: str) -> None:
    """Raise if a refusal has the wrong form.

    It must be one sentence or a list of sentences, and name its file.
    """
    first, *listed = words.split("\n")
    if name not in first or not all(line.startswith("  - ") for line in listed) or len(words) > 20_000:
        raise AssertionError(f"no error message about {name}: {words:.200}")


# ---------------------------------------------------------------------------------------------------------- parsers


def _read_scenario(path: Path) -> None:
    scenario = load_scenario(str(path))
    with suppress(config.ConfigError):  # the error names the scenario
        build_terrain(scenario, np.random.default_rng(1))


def _read_profile(path: Path) -> None:
    load_profile(str(path))


def _read_urdf(path: Path) -> RobotDescription:
    return read_urdf(input_file.read_text(path))


def _imported(read: Callable[[Path], RobotDescription]) -> Callable[[Path], None]:
    """Return the import of a robot description, whose errors name the file as the command does."""

    def read_robot(path: Path) -> None:
        try:
            import_profile(read(path))
        except DescriptionError as error:
            raise input_file.FileError(path, str(error)) from None

    return read_robot


def _read_settings(path: Path) -> None:
    process.load_settings(actuator.Settings, str(path), ())


def _read_report(path: Path) -> None:
    problems = reports.check(input_file.read_json(path))
    if problems:
        raise input_file.FileError(path, f"not a report: {problems[0]}")


def _read_picture(path: Path) -> None:
    try:
        picture_file.read_grey(path, bits=(8, 16))
    except input_file.FileError:
        picture_file.read_color(path, (4, 3))


def _read_keys(path: Path) -> None:
    access.Keys.load(path.parent)


# ------------------------------------------------------------------------------------------------------------ examples


def _shipped(package: str, *names: str) -> list[bytes]:
    return [(resources.files(f"sextant.shared.{package}") / f"{name}.toml").read_bytes() for name in names]


def _report() -> reports.Report:
    values: dict[str, Any] = {"str": "flat", "int": 1, "bool": True, "float": 1.0}
    needed = {f.name: values[str(getattr(f.type, "__name__", f.type))] for f in fields(reports.Report)[:13]}
    return reports.Report(**needed)


def _kept() -> bytes:
    run = results_store.Run.of(reports.as_table(_report()), "fingerprint", "commit", "2026-01-01T00:00:00Z")
    return (json.dumps(run.line()) + "\n").encode()


def _arrays(path: Path) -> Sequence[bytes]:
    found = []
    for array in (np.eye(4), np.array([[1, 2, 3]], dtype=np.int16), np.array([[np.nan, 0.1]], dtype=np.float32)):
        np.save(path, array)
        found.append(path.read_bytes())
    return found


# --------------------------------------------------------------------------------- valid structures with odd values


def _odd_toml(data: bytes, rng: Random) -> bytes:
    table = _odd_below(input_file.parse_toml(Path(), data), rng)
    return "".join(f"{process.toml_value(str(key))} = {process.toml_value(value)}\n" for key, value in table.items()).encode(
        errors="replace"
    )


def _odd_json(data: bytes, rng: Random) -> bytes:
    table = _odd_below(input_file.parse_json(Path(), data), rng)
    return (json.dumps(table, default=repr) + "\n").encode(errors="replace")


def _odd_below(table: dict[str, Any], rng: Random) -> dict[str, Any]:
    """Mutate a table at its top level or deeper."""
    inner = [key for key, value in table.items() if isinstance(value, dict)]
    lists = [key for key, value in table.items() if isinstance(value, list) and value and isinstance(value[0], dict)]
    if not inner + lists or rng.random() > _NESTED:
        return odd_table(table, rng)
    key = rng.choice(inner + lists)
    if key in inner:
        return {**table, key: _odd_below(table[key], rng)}
    at = rng.randrange(len(table[key]))
    return {**table, key: [_odd_below(one, rng) if k == at else one for k, one in enumerate(table[key])]}


_ODD_WORDS = (
    "nan",
    "-inf",
    "1e999",
    "0x10",
    "1_000",
    "9" * 5000,
    "#",
    "-1",
    "0.5",
    "\N{ARABIC-INDIC DIGIT THREE}",
    "",
    "..",
    "/dev/zero",
)


def _odd_words(data: bytes, rng: Random) -> bytes:
    """Replace one word of a text."""
    words = re.split(rb"(\s+)", data)
    at = rng.randrange(len(words))
    return b"".join([*words[:at], rng.choice(_ODD_WORDS).encode(), *words[at + 1 :]])


def _odd_attributes(data: bytes, rng: Random) -> bytes:
    """Replace some attribute values of XML."""
    parts = re.split(rb"(\"[^\"]*\")", data)
    for _ in range(rng.randint(1, 3)):
        at = 2 * rng.randrange(len(parts) // 2) + 1
        parts[at] = rng.choice(
            (rng.choice(_ODD_WORDS).encode().join((b'"', b'"')), parts[2 * rng.randrange(len(parts) // 2) + 1])
        )
    return b"".join(parts)


def _odd_array(data: bytes, rng: Random) -> bytes:
    """Mutate an array's header, with a correct length."""
    end = 10 + int.from_bytes(data[8:10], "little")
    header = broken(data[10:end], (data[10:end],), rng)
    if rng.random() < 0.5:
        shape = rng.choice(
            (b"(1000000, 1000000)", b"()", b"(0, 4)", b"(16,)", b"(2, 8)", b"(-4, -4)", b"(" + b"9" * 5000 + b",)")
        )
        header = re.sub(rb"\([0-9, ]*\)", shape, data[10:end])
    return data[:8] + len(header[:65535]).to_bytes(2, "little") + header[:65535] + data[end:]


def _odd_picture(data: bytes, rng: Random) -> bytes:
    """Mutate one chunk of a PNG, with correct checksums."""
    at, chunks = 8, []
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append(data[at + 4 : at + 8 + length])
        at += 12 + length
    k = rng.randrange(len(chunks))
    change = rng.random()
    if change < 0.2:
        chunks.insert(k, rng.choice(chunks))
    elif change < 0.4 and len(chunks) > 1:
        del chunks[k]
    elif change < 0.6:
        numbers = [rng.choice((0, 1, 4, 3, 100_000, 2**31 - 1)) for _ in range(2)]
        chunks[0] = b"IHDR" + struct.pack(
            ">II5B", *numbers, rng.choice((1, 2, 8, 16, 64)), rng.randrange(8), 0, 0, rng.randrange(3)
        )
    else:
        chunks[k] = chunks[k][:4] + broken(chunks[k][4:], (chunks[k],), rng)
    return data[:8] + b"".join(struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
