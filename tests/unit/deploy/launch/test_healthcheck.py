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
from sextant.shared.wire.ports import free_port

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
def watchdog_environment() -> Iterator[dict[str, str]]:
    with tempfile.TemporaryDirectory() as folder:  # a socket's path must be short
        yield {"NOTIFY_SOCKET": f"{folder}/notify", "WATCHDOG_USEC": "1000000"}


@pytest.fixture
def pulsing_process(watchdog_environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    environment = {**os.environ, **watchdog_environment, "PYTHONPATH": os.pathsep.join(sys.path)}
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


def test_pulsing_process_is_healthy_and_socket_is_removed(
    watchdog_environment: dict[str, str], pulsing_process: subprocess.Popen[str]
) -> None:
    assert healthcheck.silence(watchdog_environment) == ""
    assert healthcheck.silence(watchdog_environment) == ""
    assert not Path(watchdog_environment["NOTIFY_SOCKET"]).exists()
    assert pulsing_process.poll() is None


def test_hung_process_is_reported_and_killed_on_request(
    watchdog_environment: dict[str, str], pulsing_process: subprocess.Popen[str]
) -> None:
    assert healthcheck.silence(watchdog_environment, end_hung=True) == ""
    hang(pulsing_process)
    assert healthcheck.silence(watchdog_environment) == f"process {pulsing_process.pid} hangs: no sign of life within 1 s"
    assert pulsing_process.poll() is None
    assert healthcheck.silence(watchdog_environment, end_hung=True).endswith("; killed")
    assert pulsing_process.wait(10.0) == -signal.SIGKILL


def test_process_without_first_pulse_is_starting_and_not_killed(
    watchdog_environment: dict[str, str], pulsing_process: subprocess.Popen[str]
) -> None:
    hang(pulsing_process)
    assert healthcheck.silence(watchdog_environment, end_hung=True) == "no sign of life within 1 s: still starting"
    assert pulsing_process.poll() is None


def test_process_with_reused_pid_is_not_killed(watchdog_environment: dict[str, str]) -> None:
    Path(f"{watchdog_environment['NOTIFY_SOCKET']}.heard").write_text(f"{os.getpid()}\n")
    assert (
        healthcheck.silence(watchdog_environment, end_hung=True) == f"process {os.getpid()} hangs: no sign of life within 1 s"
    )


def test_closed_port_is_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    port = free_port()
    assert healthcheck.main(["--port", str(port)]) == 1
    assert capsys.readouterr().err == f"no process listens on port {port}\n"
    with socket.create_server(("127.0.0.1", port)):
        assert healthcheck.main(["--port", str(port)]) == 0


def test_healthcheck_imports_no_heavy_packages() -> None:
    code = "import sys, sextant.deploy.launch.healthcheck; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert not set(done.stdout.split()) & {"numpy", "zenoh", "cv2", "numba"}
