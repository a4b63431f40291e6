"""Walks with a simulated microcontroller on the servo bus.

They run in lockstep, with a restart of the board, and over a real socket.
"""

import json
import time
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError, open_port
from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.servo.bridge_protocol import Mode
from tests.support.walks import LockstepRun, flat, walk

PATIENCE_S, ANEW_S = 180.0, 3.0  # [s] limit for an order to take effect; time until a new session repeats it

COURSE = """
name = "level"
time_limit_s = 60.0
goal = { distance = 0.2 }
terrain = [{ kind = "plane" }]
"""


@pytest.mark.parametrize("robot", ["phantomx_mk2", "printed_sts3215"])
def test_walk_through_mcu_bridge_matches_walk_on_bus(robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = tmp_path / "level.toml"
    course.write_text(COURSE, encoding="utf-8")
    reports = []
    for ways in ([], ["--bridge"]):
        command = ["run", str(course), "--lockstep", "--seed", "1001", "--json", "--out", str(tmp_path / f"out{len(ways)}")]
        assert cli.main([*command, "--robot", robot, *ways]) == 0
        reports.append(json.loads(capsys.readouterr().out))
    direct, bridged = reports
    assert direct != bridged, "it went another way"
    assert bridged["success"] is True
    assert (bridged["falls"], bridged["shutdowns"], bridged["missteps"]) == (0, 0, 0)
    assert bridged["steps"] == pytest.approx(direct["steps"], abs=1)
    assert bridged["speed_mps"] == pytest.approx(direct["speed_mps"], rel=0.05)
    assert bridged["tilt_deg"]["p95"] <= direct["tilt_deg"]["p95"] + 0.1
    assert bridged["min_stability_margin_m"] >= direct["min_stability_margin_m"] - 0.005
    assert bridged["torque_nm"]["rms_worst_joint"] <= 1.1 * direct["torque_nm"]["rms_worst_joint"]


def test_mcu_restart_during_walk_causes_no_fall_or_lunge() -> None:
    at_ns, done = 6_050_000_000, []

    def restart(run: LockstepRun) -> None:
        simulator = run.service("simulator")
        assert isinstance(simulator, Simulator)
        assert isinstance(simulator.device, Board)
        if run.now_ns() >= at_ns and not done:
            simulator.device.restart(run.now_ns())
            done.append(run.now_ns())

    found = walk(flat(0.35, bridge=True), 1001, look=restart)
    assert done
    assert found.report.success, found.report.reason
    assert (found.report.falls, found.report.shutdowns) == (0, 0)
    assert found.report.min_stability_margin_m > 0.03
    assert found.report.tilt_deg.max < 1.5
    reasons = {state.reason for state in found.states(done[0] * 1e-9, done[0] * 1e-9 + 1.0)}
    assert any(reason.startswith("the bridge has been silent for") for reason in reasons), reasons
    assert any(reason.startswith("the bridge is catching up") for reason in reasons), reasons
    after = found.states(done[0] * 1e-9)
    told = next(state for state in after if state.reason.startswith("the bridge has been silent for"))
    assert told.stamp_ns - done[0] < 250_000_000
    again = next(state for state in after if state.reason == "walking" and state.stamp_ns > told.stamp_ns)
    assert again.stamp_ns - done[0] < 3_000_000_000, "the step goes on where it stood"


def test_bridge_reconnects_over_tcp_socket() -> None:
    """Use a live board behind a TCP port that sends by itself.

    A pulled cable is a new connection.
    """
    bank = ServoBank((1, 2, 3))
    board = Board(ServoBusEmulator(bank, BusTiming(usb_transaction_ns=0)))
    with TcpBusServer(board) as server:

        def set_up(driver: Bridge, limit_s: float) -> None:
            while True:
                try:
                    return driver.setup()
                except BusSetupError:  # a busy machine leaves a servo no time to answer
                    if time.monotonic() > limit_s:
                        raise

        def cycles(driver: Bridge, mode: Mode) -> int:
            """Run cycles until the board is in a mode; return the number of readings."""
            readings, limit_s = 0, time.monotonic() + PATIENCE_S
            while time.monotonic() < limit_s:
                driver.sync_write_goals([513, 514, 515])  # first: without fresh goals the board refuses torque
                driver.set_torque(mode is Mode.ON)
                anew_s = time.monotonic() + ANEW_S
                while time.monotonic() < anew_s:
                    readings += len(driver.poll(1_000_000))
                    driver.sync_write_goals([513, 514, 515])
                    with server.lock:
                        board.advance(time.monotonic_ns())
                    if driver.state and driver.state.mode is mode:
                        return readings
                set_up(driver, limit_s)  # a starved board turns torque on only in a new session
            pytest.fail(f"not {mode} within {PATIENCE_S} s: {driver.trouble}, {driver.lost}")

        for _ in range(2):
            driver = Bridge(open_port(server.url, timeout_ns=READ_NS), (1, 2, 3), time.monotonic_ns)
            set_up(driver, time.monotonic() + PATIENCE_S)
            assert cycles(driver, Mode.OFF) >= 0
            assert cycles(driver, Mode.ON) > 0
            cycles(driver, Mode.OFF)
            driver.close()
