"""docs/keys.md and the pages of the messages describe the frames on the wire."""

import ast
import re
from pathlib import Path

import pytest

from sextant.shared.field_comments import comments
from sextant.shared.wire import codec, messages
from sextant.shared.wire.messages import Mode, ModeCommand, VelocityCommand
from sextant.shared.wire.topics import OF_TYPE, TOPICS

DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "keys.md").read_text(encoding="utf-8")
OF_MESSAGES = {path.name: path.read_text(encoding="utf-8") for path in DOCS.glob("keys_*.md")}
CLIENT = (DOCS / "walk_client.py").read_text(encoding="utf-8")


def section(key: str) -> str:
    """Return the section about a message."""
    (found,) = re.findall(rf"^## {key} \w+\n(.*?)(?=^##|\Z)", "\n".join(OF_MESSAGES.values()), re.DOTALL | re.MULTILINE)
    return str(found)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
def test_each_message_section_has_schema_and_ordered_fields(topic: messages.Message) -> None:
    kind = topic.type  # type: ignore[attr-defined]
    said = section(OF_TYPE[kind].key)
    assert f"`{codec.schema_id(kind)}`" in said
    assert re.findall(r"^\| `(\w+)`", said, re.MULTILINE) == [name for name, _, _ in messages.schema(kind)]
    link = re.search(rf"^\| `{topic.key}` \| \[\w+\]\((keys_\w+\.md)#([\w-]+)\)", PAGE, re.MULTILINE)  # type: ignore[attr-defined]
    assert link is not None
    title = f"{OF_TYPE[kind].key} {kind.__name__}"  # one section for the keys of all roles
    assert f"## {title}\n" in OF_MESSAGES[link[1]]
    assert link[2] == re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-"), "as pages make anchors of titles"


@pytest.mark.parametrize(
    ("key", "row"),
    [
        ("mapper/terrain", "| `variance` | float32 | nx × ny | m^2 |  | of elevation, NaN where never seen; may hold NaN, "),
        ("actuator/odometry", "| `T_odom_body` | float64 | 4 × 4 | m | odom | takes body coordinates to odom |"),
        ("operator/velocity", "| `velocity` | float64 | 2 | m/s | body | forward, left |"),
        ("operator/mode", "| `mode` | text |  |  |  | one of `off`, `stop`, `ready`, `stand`, `walk`, `sit` |"),
    ],
)
def test_field_descriptions_match_declarations(key: str, row: str) -> None:
    assert row in section(key)


def test_publishers_and_subscribers_match_services() -> None:
    cells = [row.split("|") for row in PAGE.splitlines()]
    rows = {row[1].strip(" `"): row[7:9] for row in cells if len(row) == 11}
    assert [text.strip() for text in rows["operator/mode"]] == [
        "console, `sextant run`, `sextant order`, `sextant camera calibrate`, `sextant topics ros2`",
        "actuator, stop",
    ]
    assert "perception" in rows["camera/color"][1]
    assert rows["perception/scan"][0].strip() == "perception"
    assert rows.keys() >= {topic.key for topic in TOPICS}
    over = {
        cells[1].strip(" `"): cells[9].strip() for cells in (row.split("|") for row in PAGE.splitlines()) if len(cells) == 11
    }
    assert (over["perception/scan"], over["planner/step"], over["camera/depth"]) == ("to the base", "to the robot", "")
    assert (over["machine/presence/robot"], over["machine/presence/base"]) == ("to the base", "both ways")
    assert over["machine/presence/viewer"] == ""
    assert all(f"| `{mode.value}` |" in PAGE for mode in Mode)


def test_example_frame_decodes() -> None:
    block = re.search(r"^```text\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert block is not None
    frame = bytes.fromhex("".join(line[:47] for line in block[1].splitlines()))
    command, _ = codec.decode(frame, VelocityCommand)
    assert (command.velocity.tolist(), command.body_height, command.gait) == ([0.06, 0.0], 0.11, "tripod")


def test_field_description_joins_comments_above_and_behind() -> None:
    said = comments(
        '''
class A:
    """Words."""

    # Of both feet
    # and both hands.
    a: int  # [m] length
    b: Annotated[
        int, 3
    ]  # {body} # of something
    c = 3  # a number

    # Above alone.
    d: int
    e: str
'''
    )
    assert said == {
        ("A", "a"): "[m] length; of both feet and both hands.",
        ("A", "b"): "{body} # of something",
        ("A", "c"): "a number",
        ("A", "d"): "Above alone.",
        ("A", "e"): "",
    }


def test_example_client_is_short_and_independent_of_sextant() -> None:
    assert len(CLIENT.splitlines()) <= 40
    imported = {name.name for node in ast.walk(ast.parse(CLIENT)) if isinstance(node, ast.Import) for name in node.names}
    assert imported == {"struct", "sys", "time", "msgpack", "zenoh"}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(ast.parse(CLIENT)))
    assert f"```python\n{CLIENT}```\n" in PAGE
    for kind in (ModeCommand, VelocityCommand):
        assert f'"{codec.schema_id(kind)}"' in CLIENT, "the declaration has changed, and the client must follow"
