"""Numbers that the page's scripts and the console share have one value.

The scripts have them as constants, because they make the colour tables before the first message.
"""

import re
from pathlib import Path

import pytest

from sextant.services.console.web import frames
from sextant.services.console.web.control_arbiter import AWAY_NS, DEAD_MAN_NS, VELOCITY_NS
from sextant.services.console.web.origin_policy import PROTOCOL
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE, MAX_SECTION

SCRIPTS = Path(frames.__file__).parents[1] / "page" / "js"


def constant(script: str, name: str) -> str:
    """Return the text of a constant of a script."""
    text = (SCRIPTS / script).read_text(encoding="utf-8")
    (value,) = re.findall(rf"^(?:export )?const {name} = ([^;]+);", text, re.MULTILINE)
    return str(value)


def stops(layer: str) -> dict[str, int]:
    """Return name of a colour -> first byte of a layer's table that has it."""
    (table,) = re.findall(rf"^  {layer}: ramp\(\[(.+)\]\),", constant("colors.js", "TABLES"), re.MULTILINE)
    found: dict[str, int] = {}
    for place, color in re.findall(r"\[(\d+), (\w+)\]", table):
        found.setdefault(color, int(place))
    return found


def test_score_table_shows_no_foothold_from_the_limit_of_the_score() -> None:
    assert stops("score")["NONE"] == frames.SCORE_STEPS * MAX_FOOTHOLD_SCORE
    assert stops("score")["POOR"] == stops("score")["NONE"] - 1


def test_evaluation_table_shows_no_foothold_from_zero() -> None:
    assert stops("evaluation")["NONE"] == frames.MAX_EVALUATION_CELLS
    assert stops("evaluation")["FAIR"] == frames.MAX_EVALUATION_CELLS - 1


def test_legend_of_variance_names_the_largest_deviation() -> None:
    assert f'"± {100 * frames.MAX_SIGMA_M:.0f} cm"' in constant("colors.js", "LEGENDS")


@pytest.mark.parametrize(
    ("script", "name", "value"),
    [
        ("terrain.js", "NO_HEIGHT", frames.NO_HEIGHT),
        ("robot.js", "MOST_FOOTHOLDS", MAX_SECTION),
        ("link.js", "PROTOCOL", PROTOCOL),
    ],
)
def test_constant_of_script_equals_constant_of_console(script: str, name: str, value: object) -> None:
    assert constant(script, name).strip('"') == str(value)


def test_page_repeats_its_messages_several_times_within_the_limits_of_the_console() -> None:
    """Check that a late message neither ends a press nor takes a page's control."""
    assert VELOCITY_NS < 1e6 * float(constant("pad.js", "SAY_MS")) < DEAD_MAN_NS / 3
    assert 1e6 * float(constant("main.js", "HERE_MS")) < AWAY_NS / 3
