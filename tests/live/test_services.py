"""The units that `sextant service install` writes, with the test as systemd.

The test runs their commands, and nothing else.
"""

import os
import re
import signal
import socket
import subprocess
import tempfile
import threading
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.deploy.launch.units import TARGET
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints
from tests.support.commands import PATIENCE_S, Ear, environment, eventually, write_course
from tests.support.unit_files import read_unit, words_of

pytestmark = pytest.mark.live

_ENDS_WITHIN_S = 5.0  # [s] TimeoutStopSec= of the units
# As systemd does: the process finds its own number in WATCHDOG_PID.
_START = 'export WATCHDOG_PID=$$ && exec "$@"'


class Started:
    """The process of a unit, and its notifications."""

    def __init__(self, unit: dict[str, dict[str, list[str]]], folder: Path, name: str):
        service = unit["Service"]
        self.after = set(" ".join(unit["Unit"]["After"]).split())
        self.heard: list[str] = []
        self._mail = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._mail.bind(str(folder / name))
        self._mail.settimeout(0.1)
        told = dict(words_of(word)[0].split("=", 1) for word in service["Environment"])
        told["NOTIFY_SOCKET"] = str(folder / name)
        self.watched = "WatchdogSec" in service
        if self.watched:
            told["WATCHDOG_USEC"] = str(int(service["WatchdogSec"][0].removesuffix("ms")) * 1000)
        words = ["sh", "-c", _START, "sh", *words_of(service["ExecStart"][0])]
        self.log = folder / f"{name}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                words, env={**os.environ, **environment(), **told}, cwd=folder, stdout=log, stderr=log
            )
        self._over = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def running(self) -> bool:
        return self.process.poll() is None

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._over.set()
        self._reader.join()
        self._mail.close()

    def _read(self) -> None:
        while not self._over.is_set():
            try:
                self.heard += self._mail.recv(4096).decode("ascii").split("\n")
            except TimeoutError:
                continue


def test_systemd_units_start_in_order_pulse_and_stop(tmp_path: Path) -> None:
    course, folder = str(write_course(tmp_path, "unit", 0.3)), tmp_path / "units"
    bus, near = free_port(), f"tcp/127.0.0.1:{free_port()}"
    settings = ("--set", f"simulator.bus_port={bus}", "--set", f"actuator.port=socket://127.0.0.1:{bus}")
    words = ("--scenario", course, "--listen", near, "--namespace", "units", *settings)
    assert cli.main(["service", "install", "onboard", *words, "--folder", str(folder)]) == 0
    found = {path.name: read_unit(path.read_text()) for path in folder.iterdir() if path.name != TARGET}
    assert set(found) == {f"sextant-{name}.service" for name in ("router", "simulator", "actuator", "stop", "perception")}
    started: dict[str, Started] = {}
    with tempfile.TemporaryDirectory() as short:  # a socket's path must be short
        try:
            while len(started) < len(found):
                name = next(n for n, u in found.items() if n not in started and _after(u, found) <= set(started))
                one = started[name] = Started(found[name], Path(short), name)
                eventually(lambda one=one: "READY=1" in one.heard, f"{name} being ready", alive=one.running)
            with Ear.at(Endpoints((near,), namespace="units")) as ear:
                eventually(lambda: ear.mode is not None, "the actuator's state on the wire")
            for name, one in started.items():
                eventually(lambda one=one: one.heard.count("WATCHDOG=1") > 3 or not one.watched, f"signs of life of {name}")
                assert one.running(), one.log.read_text()
            for name in reversed(started):
                started[name].process.send_signal(signal.SIGTERM)
                assert started[name].process.wait(_ENDS_WITHIN_S) == 0, started[name].log.read_text()
        finally:
            for one in started.values():
                one.close()


def test_invalid_unit_setting_exits_with_no_restart_status(tmp_path: Path) -> None:
    words = ("service", "install", "onboard", "--camera", "none", "--folder", str(tmp_path), "--set")
    assert cli.main([*words, "actuator.arc=nonsense"]) == 2, "refused before a unit is written"
    assert cli.main([*words, "actuator.arc=flow"]) == 0
    service = read_unit((tmp_path / "sextant-actuator.service").read_text())["Service"]
    command = [word.replace("arc=flow", "arc=nonsense") for word in words_of(service["ExecStart"][0])]  # edited later
    assert any(word.endswith("arc=nonsense") for word in command)
    around = {**os.environ, **environment()}
    done = subprocess.run(command, env=around, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert [str(done.returncode)] == service["RestartPreventExitStatus"], done.stderr
    assert re.search(r"arc", done.stderr)


def _after(unit: dict[str, dict[str, list[str]]], found: dict[str, dict[str, dict[str, list[str]]]]) -> set[str]:
    return set(" ".join(unit["Unit"]["After"]).split()) & set(found)
