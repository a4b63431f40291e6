"""The firmware under MicroPython itself: recorded sessions give the same bytes as under CPython.

MicroPython is the npm package of its port to WebAssembly, which runs under node. The tests use no network: without node or the
package they are skipped, and the reason names the command that installs it.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from sextant.shared.servo import firmware, pwm
from sextant.shared.servo.models import AX_12A, LX_16A, SCS0009, STS3215, XL430_W250
from sextant.shared.servo.servo_model import ServoModel
from tests.support.firmware_rig import STAND_INS, exchange, exchange_pulses

PACKAGE = "@micropython/micropython-webassembly-pyscript"
VERSION = "1.27.0"
FOLDER = Path(os.environ.get("SEXTANT_MICROPYTHON", Path(__file__).parents[5] / "node_modules" / PACKAGE))
NODE = shutil.which("node")
FILES = Path(firmware.__file__).parent
MISSING = "" if NODE and (FOLDER / "micropython.mjs").exists() else (
    f"no {'node' if not NODE else FOLDER}: install node, then `npm install --no-save {PACKAGE}@{VERSION}` in the checkout, "
    "or set SEXTANT_MICROPYTHON to the folder of the package"
)  # fmt: skip

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(MISSING), reason=MISSING)]


def run(script: Path, **files: Path) -> str:
    """Run a script under MicroPython, with the firmware and further files; return what it prints."""
    copied = {f"firmware/{path.name}": path for path in FILES.glob("*.py")} | {"machine.py": STAND_INS / "machine.py"}
    copied |= {name.replace("__", "."): path for name, path in files.items()}
    command = [NODE, STAND_INS / "run.mjs", FOLDER, script, *(f"{target}={source}" for target, source in copied.items())]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("echo", [False, True], ids=["direction pin", "echo"])
@pytest.mark.parametrize("model", [AX_12A, STS3215, XL430_W250, LX_16A, SCS0009], ids=lambda model: model.name)
def test_session_with_faults_gives_same_bytes(model: ServoModel, echo: bool, tmp_path: Path) -> None:
    rig = exchange(model, echo)
    record = tmp_path / "record.csv"
    record.write_text("\n".join(rig.board.record), encoding="utf-8")
    name, boots, turns, count = run(STAND_INS / "replay.py", record__csv=record).split()
    assert name == "micropython"
    assert int(boots) == sum(line.startswith("B") for line in rig.board.record)
    assert int(turns) == sum(line.startswith("T") for line in rig.board.record)
    assert int(count) > 20_000


@pytest.mark.parametrize("board", ["pca9685", "maestro"])
def test_session_with_pulses_gives_same_bytes(board: pwm.Board, tmp_path: Path) -> None:
    made, record = exchange_pulses(board), tmp_path / "record.csv"
    record.write_text("\n".join(made.record), encoding="utf-8")
    name, boots, turns, count = run(STAND_INS / "replay.py", record__csv=record).split()
    assert name == "micropython"
    assert (int(boots), int(turns)) == tuple(sum(line.startswith(kind) for line in made.record) for kind in "BT")
    assert int(count) > 20_000


def test_every_file_is_imported_by_micropython(tmp_path: Path) -> None:
    script = tmp_path / "imports.py"
    names = sorted(path.stem for path in FILES.glob("*.py") if path.stem not in ("__init__", "main"))
    lines = [f"from firmware import {name}" for name in names]
    # main.py needs modules that this port lacks.
    lines += ["compile(open('firmware/main.py').read(), 'main.py', 'exec')", f"print({len(names)})"]
    script.write_text("\n".join(lines), encoding="utf-8")
    assert int(run(script)) == len(names)
