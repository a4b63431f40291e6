"""`sextant robot`: new profiles, and their check, export and import."""

import io
import json
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from sextant.deploy import cli
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.urdf import urdf

PAGE = (Path(__file__).parents[3] / "docs" / "your_robot.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("kind", "root"), [("urdf", "robot"), ("mjcf", "mujoco")])
def test_export_writes_file_or_prints(kind: str, root: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "robot.xml"
    assert cli.main(["robot", "export", "phantomx_mk2", f"--{kind}", "--out", str(target)]) == 0
    assert capsys.readouterr().out.startswith(f"{target}: {kind.upper()} of phantomx_mk2, ")
    assert cli.main(["robot", "export", "phantomx_mk2", f"--{kind}"]) == 0
    assert ET.fromstring(capsys.readouterr().out).tag == ET.parse(target).getroot().tag == root


def test_profile_of_a_file_is_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = tmp_path / "mine.toml"
    own.write_text('extends = "phantomx_mk2"\nname = "mine"\n[links]\ntibia = 0.134\n', encoding="utf-8")
    assert cli.main(["robot", "export", str(own), "--urdf"]) == 0
    assert capsys.readouterr().out == urdf(load_profile(str(own)))


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["mine.urdf", "--mjcf"], 2, "import it first: `sextant robot import mine.urdf --out robot.toml`"),
        (["phantomx_mk2"], 2, "one of --urdf and --mjcf expected, found none"),
        (["phantomx_mk2", "--urdf", "--mjcf"], 2, "one of --urdf and --mjcf expected, found both"),
        (["fantomx_mk2", "--urdf"], 2, "did you mean 'phantomx_mk2'?"),
        (["nowhere.toml", "--mjcf"], 2, "nowhere.toml: no such file"),
        (["phantomx_mk2", "--urdf", "--out", "nowhere/robot.urdf"], 1, "its folder does not exist"),
    ],
)
def test_invalid_input_is_reported_in_one_sentence(
    words: list[str],
    status: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["robot", "export", *words]) == status
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
    assert printed.out == ""


@pytest.mark.slow
def test_check_prints_limits_and_fails_if_one_is_not_met(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["robot", "check", "phantomx_mk2"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("phantomx_mk2: passes\n")
    (shown,) = re.findall(r"^```text\n(phantomx_mk2: passes\n.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    for part in shown.split("...\n"):
        assert part in printed, "docs/your_robot.md shows another output"
    weak = tmp_path / "weak.toml"
    weak.write_text('extends = "phantomx_mk2"\nname = "weak"\n[servo]\nstall_torque = 0.5\n', encoding="utf-8")
    assert cli.main(["robot", "check", str(weak)]) == 1
    assert "FAIL  torque, tripod" in capsys.readouterr().out
    assert cli.main(["robot", "check", str(weak), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["passes"] is False


@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
def test_import_writes_a_profile_that_later_commands_read(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exported, imported = tmp_path / "robot.xml", tmp_path / "robot.toml"
    assert cli.main(["robot", "export", "phantomx_mk2", f"--{kind}", "--out", str(exported)]) == 0
    capsys.readouterr()
    assert cli.main(["robot", "import", str(exported), "--out", str(imported)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"{imported}: phantomx_mk2, whose feet agree with {exported} within 0.000 mm\n")
    assert "left middle" in printed
    assert load_profile(str(imported)).links == load_profile("phantomx_mk2").links
    assert imported.read_text(encoding="utf-8").startswith("# Imported from robot.xml.\n# ")
    assert cli.main(["robot", "import", str(exported), "--out", str(imported)]) == 2
    assert "it exists; give another file with --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["robot.urdf"], "--out expected, found none"),
        (["nowhere.urdf", "--out", "x.toml"], "nowhere.urdf: no such file"),
        (["robot.urdf", "--out", "robot.txt"], "a file that ends in .toml expected, found robot.txt"),
        (
            ["robot.urdf", "--out", "x.toml", "--foot", "1,2"],
            "--foot: three lengths X,Y,Z of at most 10 m expected, found '1,2'",
        ),
        (["robot.urdf", "--out", "x.toml", "--foot", "1 2 3"], "--foot: three lengths X,Y,Z of at most 10 m expected"),
        (["robot.urdf", "--out", "x.toml", "--forward", "z"], "--forward: unknown 'z'"),
        (["robot.urdf", "--out", "x.toml", "--servo", "RX64"], "no servo model 'RX64'; did you mean 'RX-64'?"),
        (["robot.urdf", "--out", "x.toml", "--servo", "MG996R"], "for hobby servos maestro or pca9685, their board"),
        (["robot.urdf", "--out", "x.toml", "--servo", "DS3218"], "no servo model 'DS3218'; known: AX-12A, "),
        (["robot.xacro", "--out", "x.toml"], "robot.xacro: URDF expected, found Xacro; expand it first"),
        (["robot.urdf", "--out", "x.toml", "--joints", "none.toml"], "none.toml: no such file"),
        (["empty.urdf", "--out", "x.toml"], "six legs of three joints at the trunk expected, found 0"),
    ],
)
def test_invalid_import_is_reported_in_one_sentence(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("robot.urdf").write_text(urdf(load_profile("phantomx_mk2")), encoding="utf-8")
    Path("robot.xacro").write_text('<robot><xacro:leg name="left_front"/></robot>', encoding="utf-8")
    Path("empty.urdf").write_text('<robot name="empty"><link name="base"/></robot>', encoding="utf-8")
    assert cli.main(["robot", "import", *words]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
    assert not Path("x.toml").exists()


def test_import_takes_hobby_servos_and_prints_how_to_mount_their_horns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exported, imported = tmp_path / "robot.urdf", tmp_path / "my robot.toml"
    exported.write_text(urdf(load_profile("phantomx_mk2")), encoding="utf-8")
    assert cli.main(["robot", "import", str(exported), "--servo", "pca9685", "--out", str(imported)]) == 0
    words = "screw the horns on with each servo at its centre and its joint at: coxa 0, femur 0, tibia -70 deg (bent down)"
    printed = capsys.readouterr().out
    assert words in printed
    assert f"`sextant robot check '{imported}'`" in printed
    assert words in imported.read_text(encoding="utf-8")
    assert load_profile(str(imported)).servo_names[17] == "left middle tibia"


MEASURES = {"coxa": 0.045, "femur": 0.06, "tibia": 0.11, "front": 0.085, "side": 0.045, "middle": 0.07, "mass": 1.6}


@pytest.mark.slow
def test_new_asks_for_measures_and_writes_a_profile_that_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked, given = tmp_path / "asked.toml", tmp_path / "given.toml"
    answers = [str(measure) for measure in MEASURES.values()]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(["AX12A", "", "sixty", *answers]) + "\n"))
    assert cli.main(["robot", "new", "--out", str(asked)]) == 0
    printed = capsys.readouterr().out
    assert "no servo model 'AX12A'; did you mean 'AX-12A'?" in printed
    assert "a length in metres (45 mm are 0.045) from 0.005 to 0.5 expected, found 'sixty'" in printed
    assert f"{asked}: passes the check; its servos are AX-12A\n" in printed
    assert f"Next: `sextant robot check {asked}`" in printed
    options = [word for name, measure in MEASURES.items() for word in (f"--{name}", str(measure))]
    assert cli.main(["robot", "new", "--out", str(given), *options]) == 0
    assert "its servos are AX-12A, assumed: --servo NAME for another" in capsys.readouterr().out
    first, second = load_profile(str(asked)), load_profile(str(given))
    assert (first.links, first.stance, first.legs, first.body) == (second.links, second.stance, second.legs, second.body)
    assert (first.links.coxa, first.links.femur, first.links.tibia) == (0.045, 0.06, 0.11)
    assert first.body.total_mass == pytest.approx(1.6)


@pytest.mark.slow
def test_new_robot_that_is_too_heavy_fails_the_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = [word for name, measure in (MEASURES | {"mass": 12.0}).items() for word in (f"--{name}", str(measure))]
    assert cli.main(["robot", "new", "--out", str(tmp_path / "heavy.toml"), *options]) == 1
    assert "FAIL  torque, tripod" in capsys.readouterr().out


OPTIONS = [word for name, measure in MEASURES.items() for word in (f"--{name}", str(measure))]
NUMBERS = """
[servo]
model = "XM430-W210"
stall_torque = 3.0
[servo.numbers]
like = "XM430-W350"
number = 1030
no_load_rpm = 77.0
"""


@pytest.mark.slow
def test_new_takes_servos_by_numbers_from_a_profile_or_for_a_voltage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("numbers.toml").write_text(NUMBERS, encoding="utf-8")
    for out, words in {
        "numbered": ["--servo", "numbers.toml"],
        "again": ["--servo", "numbered.toml"],
        "hobby": ["--servo", "printed_ds3218"],
        "low": ["--servo", "STS3215", "--volts", "7.4"],
    }.items():
        assert cli.main(["robot", "new", "--out", f"{out}.toml", *OPTIONS, *words]) == 0
    numbered, again, hobby, low = (load_profile(f"{name}.toml") for name in ("numbered", "again", "hobby", "low"))
    assert (numbered.servo.servo_model.number, numbered.servo.no_load_speed) == (1030, pytest.approx(8.063, abs=1e-3))
    assert numbered.servo.stiffness == pytest.approx(numbered.servo.nominal_stiffness, rel=1e-3)
    assert again.servo == numbered.servo
    assert hobby.servo == load_profile("printed_ds3218").servo
    assert sorted(hobby.servo_names) == list(range(18))
    assert (low.servo.stall_torque, low.battery.empty_voltage) == (1.91, 6.6)


@pytest.mark.slow
@pytest.mark.parametrize("servo", ["LX-16A", "pca9685"])
def test_new_states_the_angles_at_which_horns_are_mounted(
    servo: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "new.toml"
    assert cli.main(["robot", "new", "--out", str(path), *OPTIONS, "--servo", servo]) == 0
    words = "each servo at its centre and its joint at: coxa 0, femur 0, tibia -57.5 deg (bent down)"
    printed = capsys.readouterr().out
    assert words in printed
    assert words in path.read_text(encoding="utf-8")
    pulses = load_profile(str(path)).servo.pulses
    assert (pulses.board if pulses else "LX-16A") == servo
    assert ("those of a DS3218" in printed) == bool(pulses)


@pytest.mark.slow
def test_settings_that_servos_do_not_have_are_not_written(tmp_path: Path) -> None:
    for servo, has in {"AX-12A": "compliance_slope", "STS3215": "position_gain", "XL430-W250": "position_gain"}.items():
        path = tmp_path / f"{servo}.toml".lower()
        assert cli.main(["robot", "new", "--out", str(path), *OPTIONS, "--servo", servo]) == 0
        text = path.read_text(encoding="utf-8")
        assert [key for key in ("compliance_slope", "position_gain") if key in text] == [has]
        assert ("lock_eeprom" in text) is (servo != "XL430-W250")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "new.toml"], "an answer expected, found the end of the input; in a script, give --servo"),
        (
            ["--out", "new.toml", "--servo", "LX-16A"],
            "an answer expected, found the end of the input; in a script, give --coxa",
        ),
        (
            ["--out", "new.toml", "--servo", "MG996R"],
            "for hobby servos maestro or pca9685, their board, see docs/hobby_servos.md",
        ),
        (
            ["--out", "new.toml", "--coxa", "52"],
            "--coxa: a length in metres (45 mm are 0.045) from 0.005 to 0.5 expected, found '52'",
        ),
        (["--out", "new.toml", "--servo", "AX12A"], "--servo: no servo model 'AX12A'; did you mean 'AX-12A'?"),
        (["--out", "new.toml", "--servo", "XM430-W210"], "state the numbers that differ: docs/servos.md"),
        (["--out", "new.toml", "--servo", "none.toml"], "none.toml: no such file"),
        (["--out", "new.toml", "--servo", "STS3215", "--volts", "6"], "a voltage of the STS3215 (12, 7.4) expected, found 6"),
        (["--out", "new.toml", "--servo", "AX-12A", "--volts", "12"], "no voltage for the AX-12A expected, found 12"),
        (["--out", "new.toml", "--servo", "printed_ds3218", "--volts", "6"], "a model with --servo expected"),
        ([], "--out expected, found none"),
    ],
)
def test_invalid_measures_are_reported_in_one_sentence(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert cli.main(["robot", "new", *words]) == 2
    assert message in capsys.readouterr().err
