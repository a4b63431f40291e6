"""Typical mistakes on the command line.

Each ends with status 1 or 2 and one sentence, never with a traceback.
"""

import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import cli as benchmarks
from sextant.deploy import cli
from sextant.shared.wire import transport

SCENARIO = """name = "mine"
[goal]
distance = 1.0
[[terrain]]
kind = "plane"
"""
MAP = '[[terrain]]\nkind = "height_map"\nresolution = 0.02\nxy = [0, 0]\n'
CAMERA = "width = 8\nheight = 8\nfx = 9.0\nfy = 9.0\ncx = 4.0\ncy = 4.0\ndepth_scale = 1000.0\n"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a folder with all files that the mistakes below name."""
    monkeypatch.chdir(tmp_path)
    for display in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(display, raising=False)
    texts = {
        "typo.toml": SCENARIO.replace("distance", "distanse"),
        "gait.toml": SCENARIO + '[walk]\ngait = "tripode"\n',
        "kind.toml": SCENARIO + '[[terrain]]\nkind = "stiars"\n',
        "twice.toml": SCENARIO + 'name = "again"\n[goal]\n',
        "crowded.toml": SCENARIO
        + '[[terrain]]\nkind = "rubble"\nx = [0.5, 0.6]\ny = [-0.1, 0.1]\ncount = 10\nsize = [0.08, 0.1]\ntop = [0.01, 0.04]\n',
        "servo.toml": SCENARIO + '[[bus_faults]]\ntarget = "servo"\nkind = "silent"\nservo = 77\nat_s = 1.0\nfor_s = 1.0\n',
        "text.toml": "This is not TOML.\n",
        "none.toml": SCENARIO + MAP + 'file = "gone.npy"\n',
        "words.toml": SCENARIO + MAP + 'file = "words.npy"\n',
        "grid.toml": SCENARIO + '[[terrain]]\nkind = "height_map"\nfile = "recording.mcap"\n',
        "size.toml": SCENARIO + '[[terrain]]\nkind = "height_map"\nfile = "words.npy"\n',
        "grey.toml": SCENARIO + MAP + 'file = "grey.png"\n',
        "robot.toml": 'extends = "phantomx_mk3"\n',
        "loop.toml": 'extends = "loop.toml"\n',
        "legs.toml": 'extends = "phantomx_mk2"\n[links]\nfemure = 0.1\n',
        "fleet.toml": '[robots.alpha]\nconect = ["tcp/127.0.0.1:7447"]\n',
        "empty.toml": "",
        "words.npy": "0.1 0.2\n",
        "notes.txt": "notes\n",
        "recording.mcap": "no recording\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "utf16.toml").write_bytes(SCENARIO.encode("utf-16"))
    (tmp_path / "latin1.toml").write_bytes(SCENARIO.replace("mine", "Übung").encode("latin-1"))
    (tmp_path / "deep.toml").write_text("a = " + "[" * 5000)
    cv2.imwrite(str(tmp_path / "grey.png"), np.zeros((4, 4), dtype=np.uint8))
    os.mkfifo(tmp_path / "pipe.toml")
    for name, camera, frames in (
        ("depth", CAMERA, "0.0 gone.png\n"),
        ("bent", CAMERA + "k1 = -0.28\n", "0.0 a.png\n"),
        ("unsorted", CAMERA, "1.0 a.png\n0.5 b.png\n"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "camera.toml").write_text(camera)
        (tmp_path / name / "depth.txt").write_text(frames)
    for name, report in (("run", "[" * 9000), ("half", json.dumps({"seed": 1}))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.json").write_text(report)
    (tmp_path / "keys").mkdir()
    return tmp_path


MISTAKES = [
    # Commands, options and values.
    ("", "a command expected, found none"),
    ("walk", "see `sextant --help`"),
    ("rnu flat", "unknown command 'rnu'; did you mean 'run'?"),
    ("Run flat", "unknown command 'Run'; did you mean 'run'?"),
    ("trial flat --seeds 0:2", "did you mean 'trials'?"),
    ("--version=3", "option '--version' does not take a value"),
    ("plan map.npy --goal 1", "--goal: two lengths X,Y in metres expected, found '1'"),
    ("plan gone.npy --goal 1,1 --resolution 0.01", "gone.npy"),
    ("topics lst", "unknown command 'lst'; did you mean 'list'?"),
    ("servos calibarte", "unknown command 'calibarte'; did you mean 'calibrate'?"),
    ("camera calibrat", "unknown command 'calibrat'; did you mean 'calibrate'?"),
    ("camera calibrate --out robot.txt", "--out: a file that ends in .toml expected, found robot.txt"),
    ("camera calibrate --rehearse flt", "did you mean 'flat'?"),
    ("camera calibrate --robot printed_ds3218", "a robot with measured joint angles expected, found printed_ds3218"),
    ("camera calibrate --robot printed_ds3218 --rehearse flat", "measure the mount with a ruler"),
    ("keys shwo here", "did you mean 'show'?"),
    ("demo step", "did you mean 'steps'?"),
    ("up onbord", "did you mean 'onboard'?"),
    ("order sitt", "did you mean 'sit'?"),
    ("run flat --gait tripode", "--gait: unknown 'tripode'; did you mean 'tripod'?"),
    ("run flat --sed 3", "unknown option '--sed'; did you mean '--seed'?"),
    ("run flat --lockstepp", "unknown option '--lockstepp'; did you mean '--lockstep'?"),
    ("servos emulate --port 7555", "unknown option '--port'; see"),
    ("run flat stairs", "unexpected extra argument (stairs)"),
    ("run", "SCENARIO expected, found none"),
    ("run flat --seed", "option '--seed' requires an argument"),
    ("run flat --seed -1", "--seed"),
    ("run flat --seed 1.5", "--seed: a whole number of at least 0 expected, found '1.5'"),
    ("run flat --seed " + "9" * 5000, "--seed: a whole number of at least 0 expected"),
    ("trials flat --seeds 5", "--seeds: A:B with A < B expected"),
    ("trials flat --seeds 0:1000000000000", "--seeds: at most 1000000 seeds expected"),
    ("trials flat --seeds 0:2 --jobs 100000", "--jobs: a whole number of 1 to 256 expected"),
    (
        "trials flat --seeds 0:2 --cluster 10.0.0.1",
        "--cluster: local:N or a scheduler's address such as tcp://10.0.0.1:8786 expected",
    ),
    ("trials flat --seeds 0:2 --cluster local:2 --jobs 2", "one of --jobs and --cluster expected, found both"),
    (
        "trials riser --curve --scaled --seeds 0:2",
        "--curve finds the lengths that a robot passes as they are; leave --scaled out",
    ),
    ("trials risr --curve --seeds 0:2", "no family of scenarios 'risr'; did you mean 'riser'?"),
    ("trials riser --seeds 0:2 --at 0.02,0.03", "--at: values for --curve expected, found none; add --curve"),
    ("trials riser --curve --seeds 0:2 --at 0.03,x", "--at: rising or falling numbers A,B,... expected, found '0.03,x'"),
    ("trials riser --curve --seeds 0:2 --at 0.03,0.01,0.02", "--at: rising or falling numbers A,B,... expected"),
    ("topics foxglove --port 99999", "--port: a whole number of 0 to 65535 expected"),
    ("servos calibrate --pose 0 0 nan", "--pose: degrees from -180 to 180 expected, found 'nan'"),
    ("servos test --leg front", "--leg: unknown 'front'; did you mean 'left front'?"),
    ("video run --size huge", "--size: WxH expected"),
    ("video run --speed inf", "--speed: a number from 0.05 to 100 expected"),
    ("run flat --lockstep --link fast", "--link: MS,MBIT,LOSS expected"),
    ("run flat --lockstep --link 1e9,1,0", "delay_ms from 0 to 1000 expected"),
    ("figures run run --what hieght", "did you mean"),
    ("up offboard --with plannar", "did you mean 'planner'?"),
    ("up onboard --set actuator.rate=50", "rate"),
    ("run flat --viewer", "--viewer: a display expected, found none"),
    ("run flat --lockstep --viewer", "leave --lockstep and --connect out"),
    ("run flat --lockstep --page", "leave --lockstep and --connect out"),
    ("run flat --lockstep --foothold level", "package.module:Object or the name of an entry point expected, found 'level'"),
    ("run flat --connect tcp/127.0.0.1:1", "nothing listens on port 1 of 127.0.0.1; is the robot up"),
    ("servos set-id --port /dev/nosuch", "servo port /dev/nosuch: No such file or directory; is the adapter plugged in?"),
    ("servos scan --port COM3", "--port: a serial device such as /dev/ttyUSB0, or socket://HOST:PORT, expected, found 'COM3'"),
    ("servos scan --port /dev/null", "/dev/null: Inappropriate ioctl for device; a serial device such as /dev/ttyUSB0"),
    (
        "servos set-id --port socket://127.0.0.1:1",
        "Connection refused; is the simulator, or `sextant servos emulate`, running?",
    ),
    ("trials flat", "--seeds expected, found none"),
    ("trials flat --seeds commit:0", "--seeds: A:B with A < B expected, B not included, found 'commit:0'"),
    ("trials flat --seeds 0:1 --planner unknown:X", "there is no module unknown; expected in this environment"),
    ("run flat --lockstep --planner tests.support.plugins:not_callable", "a class or a function expected, found int"),
    ("run flat --lockstep --set planner.costmap.max_step_m=abc", "planner.costmap.max_step_m: a number expected, found 'abc'"),
    ("run flat --record-depth frames", "add --lockstep"),
    ("run flat --bridge --connect tcp/127.0.0.1:1", "--bridge is for services that this command starts"),
    ("demo --set a=b", "--set: a: unknown key; known keys: actuator, mapper, perception, planner"),
    ("up", "ROLE expected, found none"),
    ("up all --set planner.costmap.max_step_m=99", "costmap.max_step_m: 0.005 to 0.3 expected, found 99.0"),
    ("up all --set planner.costmap.max_step_m", "--set: SERVICE.KEY=VALUE expected"),
    ("order", "WHAT expected, found none"),
    ("order walk fast", "got unexpected extra argument (fast)"),
    ("order stand --connect tcp/127.0.0.1:99999", "PROTOCOL/HOST:PORT expected"),
    ("record --connect localhost:7447", "PROTOCOL/HOST:PORT expected, e.g. tls/robot.local:7448, found 'localhost:7447'"),
    ("record --connect tcp/127.0.0.1:1", "nothing listens on port 1 of 127.0.0.1"),
    ("topics hz planner/stpe", "no topic 'planner/stpe'; did you mean 'planner/step'?"),
    ("topics ros2 --connect tcp/127.0.0.1:1", "nothing listens on port 1 of 127.0.0.1"),
    ("service install onbord --dry-run", "ROLE: unknown 'onbord'; did you mean 'onboard'?"),
    ("up onboard --port /dev/ttyUSB0", "unknown option '--port'; the setting is --set actuator.port=DEVICE"),
    ("doctor --bridge", "--bridge: --port DEVICE expected, the port of the microcontroller"),
    ("doctor --stranger nowhere", "--stranger: PROTOCOL/HOST:PORT expected"),
    ("robot export phantomx_mk2", "one of --urdf and --mjcf expected, found none"),
    ("recording export notes.txt --map map.png", "--map: a file that ends in .npy expected, found map.png"),
    ("recording export notes.txt --grid-map map.npy", "--grid-map: a file that ends in .mcap expected, found map.npy"),
    ("figures run run --width 3px", "--width: 1in to 40in expected, found '3px'"),
    ("servos scan --ids 0:999", "--ids: ids of servos expected, 0 to 253, found '0:999'"),
    ("servos emulate --listen 70000", "--listen: a whole number of 0 to 65535 expected"),
    ("servos calibrate --out robot.txt", "--out: a file that ends in .toml expected, found robot.txt"),
    # Names of scenarios and profiles.
    ("robot check phantomx", "no profile 'phantomx'; did you mean 'phantomx_mk2'?"),
    ("robot check robot.toml", "did you mean 'phantomx_mk2'?"),
    ("robot export phantomx --urdf", "no profile 'phantomx'; did you mean 'phantomx_mk2'?"),
    ("servos scan --robot phantomx", "no profile 'phantomx'; did you mean 'phantomx_mk2'?"),
    ("up all --scenario stiars", "no scenario 'stiars'; did you mean 'stairs'?"),
    ("run stiars --lockstep", "no scenario 'stiars'; did you mean 'stairs'?"),
    ("run flat.tmol --lockstep", "no scenario 'flat.tmol'; did you mean 'flat'?"),
    ("run nowhere.toml --lockstep", "nowhere.toml: no such file"),
    ("run flat --lockstep --robot fantomx_mk2", "no profile 'fantomx_mk2'; did you mean 'phantomx_mk2'?"),
    ("run steps+x0 --lockstep", "a scale from x0.1 to x10 expected, found 'x0'"),
    ("run steps+half --lockstep", "no trouble 'half'; known: harsh, legs, mild, sparse, sun, usual; or a scale such as x0.85"),
    ("run flat --lockstep --scaled 0.5", "unexpected extra argument (0.5)"),
    ("service compose --scenario rubbel", "did you mean 'rubble'?"),
    # Files.
    ("run typo.toml --lockstep", "goal.distanse: unknown key; did you mean 'distance'?"),
    ("run gait.toml --lockstep", "did you mean 'tripod'?"),
    ("run kind.toml --lockstep", "terrain[1].kind: found 'stiars'; did you mean 'stairs'?"),
    ("run crowded.toml", "terrain[1]: room for 10 blocks of rubble expected, found room for about"),
    ("up all --scenario crowded.toml", "terrain[1]: room for 10 blocks of rubble expected, found room for about"),
    ("up sim --scenario servo.toml", "one of the servos 1, 2, 3"),
    ("run servo.toml", "one of the servos 1, 2, 3"),
    ("run twice.toml --lockstep", "twice.toml: no valid TOML: "),
    ("run text.toml --lockstep", "text.toml: no valid TOML: "),
    ("run utf16.toml --lockstep", "utf16.toml: UTF-8 text expected, found UTF-16"),
    ("run latin1.toml --lockstep", "latin1.toml:1: UTF-8 text expected, found byte 0xdc"),
    ("run deep.toml --lockstep", "deep.toml: TOML expected, found lists or tables more than 32 deep"),
    ("run empty.toml --lockstep", "name: missing; a text is needed"),
    ("run pipe.toml --lockstep", "pipe.toml: a file expected, found a pipe"),
    ("run . --lockstep", "no scenario '.'"),
    ("run none.toml --lockstep", "gone.npy"),
    ("run words.toml --lockstep", "words.npy: a .npy array expected, found something else"),
    ("run grey.toml --lockstep", "grey.png: scale expected"),
    ("run flat --lockstep --robot robot.toml", "did you mean 'phantomx_mk2'?"),
    ("run flat --lockstep --robot loop.toml", "which extends this one"),
    ("run flat --lockstep --robot legs.toml", "links.femure: unknown key; did you mean 'femur'?"),
    ("run flat --lockstep --robot .", "no profile '.'"),
    ("run flat --lockstep --out notes.txt", "cannot create the folder notes.txt"),
    ("fleet fleet.toml", "robots.alpha.conect: unknown key; did you mean 'connect'?"),
    ("fleet fleat.toml", "fleat.toml: no such file"),
    ("recording replay depth", "gone.png: no such file"),
    ("recording replay bent", "camera.toml: k1: 0 (distortion"),
    ("recording replay unsorted", "depth.txt:2: ascending times expected"),
    ("recording replay notes.txt", "notes.txt"),
    ("recording replay recording.mcap", "recording.mcap"),
    ("recording info notes.txt", "notes.txt"),
    ("recording export notes.txt --grid-map map.mcap", "notes.txt: not an MCAP file"),
    ("robot export phantomx_mk2 --urdf --out nowhere/x.urdf", "nowhere/x.urdf cannot be written: its folder does not exist"),
    ("run grid.toml --lockstep", "recording.mcap: not an MCAP file"),
    ("run size.toml --lockstep", "resolution of the map expected, found none"),
    ("trials table run/report.json --json --format csv", "one of --json and --format csv expected, found both"),
    ("recording info gone.mcap", "gone.mcap"),
    ("recording recover notes.txt", "notes.txt"),
    ("video gone", "gone: no such run"),
    ("figures run gone", "gone"),
    ("figures run run", "run"),
    ("figures run half", "half"),
    ("trials table notes.txt", "notes.txt"),
    ("trials table run/report.json", "no finished run in run/report.json"),
    ("keys show keys", "no certificate.pem in keys"),
    ("keys new notes.txt", "notes.txt"),
    ("topics ros2 --depth-frm /depth", "unknown option '--depth-frm'; did you mean '--depth-from'?"),
    ("drive", "a terminal in the foreground expected on standard input; over SSH start it with `ssh -t"),
    ("drive --gamepad gone", "gone cannot be opened: No such file or directory; plug the gamepad in"),
    ("drive --gait trott", "--gait: unknown 'trott'"),
    ("order stand --keys keys", "keys in keys: ca.pem, certificate.pem, key.pem, role.toml expected"),
]


OF_BENCHMARKS = [
    ("", "a command expected, found none"),
    ("acuracy", "did you mean 'accuracy'?"),
    ("accuracy --jobs 0", "--jobs: a whole number of 1 to 256 expected, found '0'"),
    ("accuracy --registration odometry", "package.module:Object or the name of an entry point expected, found 'odometry'"),
    ("accuracy --set planner.step.handover_s=0.6", "a parameter of perception or mapper expected, found one of planner"),
    ("speed --seeds 5", "--seeds: A:B with A < B expected"),
    ("stages --foothold unknown:x", "there is no module unknown"),
    ("passage --planner nearest", "unknown option '--planner'"),
    ("fleet --course stiars", "no scenario 'stiars'; did you mean 'stairs'?"),
    ("link --scenario stiars", "no scenario 'stiars'; did you mean 'stairs'?"),
    ("roles --only unknown", "--only: one of the roles"),
    ("soak --minutes 0", "--minutes: minutes from 0.5 to 1440 expected, found '0'"),
    ("size --out notes.txt", "cannot create the folder notes.txt"),
    ("fuzz --give gone --only camera/depth", "cannot read gone: No such file or directory"),
    ("faults limp_servo", "limp_servo"),
    ("fuzz --only camera/dept", "did you mean 'camera/depth'?"),
]
MAINS = {"sextant": cli.main, benchmarks.PROGRAM: benchmarks.main}
CASES = [*(("sextant", *case) for case in MISTAKES), *((benchmarks.PROGRAM, *case) for case in OF_BENCHMARKS)]


def test_mistakes_cover_every_command() -> None:
    groups = {"topics", "servos", "camera", "keys", "recording", "service"}
    made = {line.split()[0] for line, _ in MISTAKES if line}
    shown = {name for name, one in cli.sextant.commands.items() if not one.hidden}
    assert shown <= made
    assert groups <= made


@pytest.mark.parametrize(("program", "line", "message"), CASES, ids=lambda value: value[:60])
def test_usage_error_prints_one_sentence_without_traceback(
    program: str,
    line: str,
    message: str,
    here: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(transport, "_CONNECT_MS", 500)
    status = MAINS[program](line.split())
    printed = capsys.readouterr()
    assert status in (1, 2)
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert all(line.startswith("  - ") for line in printed.err.splitlines()[1:]), "one sentence, or a list of problems"
    assert re.match(rf"{program}\b", printed.err)
