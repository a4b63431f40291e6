import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from sextant.deploy.launch import healthcheck
from sextant.deploy.launch.launcher import free_port

# Sends watchdog pulses as a service does until it reads a line; then it hangs.
_LIVING = """
import os, sys, threading, time
from sextant.shared.runtime.watchdog import Watchdog
hung = threading.Event()
threading.Thread(target=lambda: (sys.stdin.readline(), hung.set()), daemon=True).start()
with Watchdog(os.environ) as watchdog:
    print("living", flush=True)
    while not hung.wait(0.02):
        watchdog.beat(time.monotonic_ns())
    print("hanging", flush=True)
    threading.Event().wait()
"""


@pytest.fixture
def around() -> Iterator[dict[str, str]]:
    with tempfile.TemporaryDirectory() as folder:  # a socket's path must be short
        yield {"NOTIFY_SOCKET": f"{folder}/notify", "WATCHDOG_USEC": "1000000"}


@pytest.fixture
def living(around: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    environment = {**os.environ, **around, "PYTHONPATH": os.pathsep.join(sys.path)}
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", _LIVING], env=environment, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "living\n"
        yield process
        process.kill()


def hang(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    assert process.stdout.readline() == "hanging\n"


def test_what_gives_signs_of_life_is_healthy_and_leaves_no_socket_behind(
    around: dict[str, str], living: subprocess.Popen[str]
) -> None:
    assert healthcheck.silence(around) == ""
    assert healthcheck.silence(around) == ""
    assert not Path(around["NOTIFY_SOCKET"]).exists()
    assert living.poll() is None


def test_what_hangs_is_named_and_killed_where_that_is_asked_for(around: dict[str, str], living: subprocess.Popen[str]) -> None:
    assert healthcheck.silence(around, end_hung=True) == ""
    hang(living)
    assert healthcheck.silence(around) == f"process {living.pid} hangs: no sign of life within 1 s"
    assert living.poll() is None
    assert healthcheck.silence(around, end_hung=True).endswith("; killed")
    assert living.wait(10.0) == -signal.SIGKILL


def test_what_has_not_begun_is_starting_and_left_alone(around: dict[str, str], living: subprocess.Popen[str]) -> None:
    hang(living)
    assert healthcheck.silence(around, end_hung=True) == "no sign of life within 1 s: still starting"
    assert living.poll() is None


def test_who_has_another_processes_number_by_now_is_not_killed(around: dict[str, str]) -> None:
    Path(f"{around['NOTIFY_SOCKET']}.heard").write_text(f"{os.getpid()}\n")
    assert healthcheck.silence(around, end_hung=True) == f"process {os.getpid()} hangs: no sign of life within 1 s"


def test_a_port_that_nobody_listens_on_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    port = free_port()
    assert healthcheck.main(["--port", str(port)]) == 1
    assert capsys.readouterr().err == f"no process listens on port {port}\n"
    with socket.create_server(("127.0.0.1", port)):
        assert healthcheck.main(["--port", str(port)]) == 0


def test_it_is_cheap_to_ask() -> None:
    code = "import sys, sextant.deploy.launch.healthcheck; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert not set(done.stdout.split()) & {"numpy", "zenoh", "cv2", "numba"}
