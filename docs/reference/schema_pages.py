"""Generators of docs/scenarios.md and docs/scenarios_*.md, docs/profiles.md and docs/profiles_*.md, and docs/report.md."""

import inspect
from typing import get_type_hints

from docs.reference.parts import Part, split
from docs.reference.schema_tables import Layout, kind_of, tables, tables_of
from docs.reference.terrain_pictures import EXAMPLES
from sextant.evaluation.report import Report
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.scenario.course import Course
from sextant.shared.scenario.scenario import Scenario

_SCENARIO = """# Scenario format

*`python -m docs.reference scenarios` makes this page, the pages of its parts and their pictures from the schema
(`shared/scenario/scenario.py` and `terrain.py`); a test checks that they are up to date.*

A scenario is a TOML file with a course and the parameters to walk it. `sextant run FILE.toml`, `trials` and
`up --scenario` take its path. {world} has its origin on the ground below the robot's start; x is its heading at yaw 0, z is up.
All lengths are in metres. The seed of a run draws everything that is random: spreads, jitter, positions of rubble and
pillars. The smallest complete file is

```toml
name = "my_course"

[goal]
distance = 2.0

[[terrain]]
kind = "plane"
```

The [scenarios of the program](../shared/scenario/scenarios/mixed.toml) are files of this kind. Their names stand for them:
`sextant run mixed`. Unknown keys, wrong types and values outside their range are errors. Faults, movers, camera options and a
mismatch may be in a separate file, a trouble, which is laid over any course by a plus sign: `sextant run steps+legs`. The
program has `sun`, `legs` and `sparse`, and robots that differ from their profile: `mild`, `usual` and `harsh`. A number after
an x is a scale of all lengths and speeds: `sextant run steps+x0.85` ([simulation.md](simulation.md)). The name or path of a
[family](trials.md#difficulty-curves) with a value of its parameter is a scenario, too: `sextant run riser@0.05`.
"""
_PICTURE = "Each picture shows the example below it with seed 1000; the robot stands at the origin."
_PARTS = {
    "scenarios_ground": Part(
        "Terrain: ground", _PICTURE, ("plane", "hole", "slope", "relief", "height_map", "puddle", "puddles", "patches")
    ),
    "scenarios_blocks": Part(
        "Terrain: blocks, stairs, pillars", _PICTURE, ("box", "stairs", "pillars", "pillar_field", "rubble")
    ),
    "scenarios_course": Part("Terrain: courses of stretches", _PICTURE, ("course",)),
    "scenarios_faults": Part(
        "Faults, movers, link and mismatch of a scenario",
        "[Scenario format](scenarios.md) describes the file and its other tables.",
        ("[[faults]]", "[[bus_faults]]", "[[movers]]", "[link]", "[mismatch]"),
    ),
}
_PROFILE = """# Profile format

*`python -m docs.reference profiles` makes this page and that of its servos from the schema (`shared/robot/profile.py` and
`servo.py`); a test checks that they are up to date.*

A profile is a TOML file that describes a robot. [your_robot.md](your_robot.md) has a complete one. `--robot` takes its path,
or a name: `phantomx_mk2`, `lotriet_rx64`, `printed_sts3215`, the smaller `small_sts3215` and `jethexa_hx35h`
([servos.md](servos.md)), `printed_ds3218` ([hobby_servos.md](hobby_servos.md)), `phantomx_mk2` with other servos,
`phantomx_mk2_ax18`, with an inertial sensor, `phantomx_mk2_imu`, and with other cameras: `phantomx_mk2_rgbd`,
`phantomx_mk2_scanner`, `phantomx_mk2_d435`, `phantomx_mk2_d405`, `phantomx_mk2_oak`, `phantomx_mk2_gemini2` and
`phantomx_mk2_gemini305`
([cameras.md](cameras.md#in-the-simulator)). A file with `extends = "phantomx_mk2"` contains only the differences; a list
such as `[[legs]]` is replaced as a whole. The order of the legs is left front, right front, right middle, right rear,
left rear, left middle.
"""
_PROFILE_PARTS = {
    "profiles_servos": Part(
        "Servos and buses of a profile",
        "[Profile format](profiles.md) describes the file and its other tables; [servos.md](servos.md) explains these.",
        ("[servo]", "[[servo_groups]]", "[[buses]]"),
    ),
}
_REPORT = """# Fields of report.json

*`python -m docs.reference report` makes this page from the schema (`evaluation/report.py`); a test checks that it is up to
date.*

Every run writes `report.json`, and `sextant run --json` prints it. The scorer evaluates the run by ground truth, which no
service reads. One seed in lockstep gives one report, byte for byte, except `real_time_factor`, `stages_ms`, `planning_ms` and
`too_slow`. Floats are rounded to six digits. `null` means that there was nothing to measure. The unit 1 is that of counts and
shares; texts, truth values and tables have none. Keys are in the order of this page.
"""


def scenarios() -> dict[str, str]:
    """Return the pages of the scenario format in Markdown by their names."""
    notes = {
        "terrain": "The ground is all of these together. A `course` has stretches of the last six kinds below.",
        "terrain.stretches": "In each picture level ground is before and behind the stretch.",
        "bus_faults": "[The servo bus under faults](actuator.md) lists what each kind does, and which parameters it takes.",
    }
    for kind, example in EXAMPLES.items():
        notes[f"{example.place}.{kind}"] = f"![{kind}](terrain/{kind}.webp)\n\n```toml\n{example.toml}\n```"
    layout = Layout(toml=True, leave_out=frozenset(("plugins", "folder")), before=notes)
    hints = get_type_hints(Scenario)["terrain"], get_type_hints(Course)["stretches"]
    kinds = [kind for hint in hints for kind in tables_of(hint)[0]]
    index = {kind_of(kind): (inspect.getdoc(kind) or "").partition("\n")[0].rstrip(".") for kind in kinds}
    return split("scenarios", "\n".join((_SCENARIO, *tables(Scenario, layout))), _PARTS, index)


def profiles() -> dict[str, str]:
    """Return the pages of the profile format in Markdown by their names."""
    return split("profiles", "\n".join((_PROFILE, *tables(RobotProfile, Layout(toml=True)))), _PROFILE_PARTS, {})


def report() -> str:
    """Return the page of the fields of `report.json` in Markdown."""
    return "\n".join((_REPORT, *tables(Report, Layout(toml=False))))
