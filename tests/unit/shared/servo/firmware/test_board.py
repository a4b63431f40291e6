"""The firmware with its ports, clock and main program, against stand-ins of the board's hardware and the emulated servos."""

import sys
import time
from types import ModuleType, SimpleNamespace

import pytest

from sextant.shared.servo import dynamixel, pca9685, pwm
from sextant.shared.servo import firmware as package
from sextant.shared.servo.bridge_protocol import TO_HOST, Mode, Receiver, Torque, Welcome, encode
from sextant.shared.servo.firmware import board, config
from sextant.shared.servo.models import AX_12A, LX_16A, SCS0009, STS3215, XL430_W250
from sextant.shared.servo.servo_model import ServoModel
from tests.support.firmware_rig import TICKS, exchange, exchange_pulses, imported, stand_in, ticks_diff

FAMILIES = pytest.mark.parametrize("model", [AX_12A, STS3215, XL430_W250, LX_16A, SCS0009], ids=lambda model: model.name)


@pytest.mark.slow
@FAMILIES
@pytest.mark.parametrize("echo", [False, True], ids=["direction pin", "echo"])
def test_session_with_faults_through_ports(model: ServoModel, echo: bool) -> None:
    rig = exchange(model, echo)
    state, units = rig.driver.state, model.units
    assert state is not None
    assert (state.mode, rig.driver.restarts) == (Mode.OFF, 1)
    assert rig.registers("torque_enable") == [0] * rig.count
    assert rig.registers("goal_position") == [units.ticks(-0.4) + k for k in range(rig.count)]
    assert rig.registers("torque_limit") == [700 if model.has(model.table.torque_limit) else 1000] * rig.count
    assert rig.driver.lost["bridge: no answer"] == 0, "counted since the restart"
    assert rig.driver.lost["frame with a wrong CRC"] > 0
    assert not rig.driver.trouble or "torque off" in rig.driver.trouble


@pytest.mark.slow
@FAMILIES
def test_record_of_session_is_replayed_byte_for_byte(model: ServoModel, tmp_path) -> None:  # type: ignore[no-untyped-def]
    rig = exchange(model)
    (tmp_path / "record.csv").write_text("\n".join(rig.board.record), encoding="utf-8")
    machine = stand_in("machine")
    with imported(machine=machine, firmware=package):
        boots, turns, count = stand_in("replay").replay(str(tmp_path / "record.csv"))
    assert boots >= 2
    assert turns > 1000
    assert count > 20_000
    spoilt = list(rig.board.record)
    last = max(k for k, line in enumerate(spoilt) if not line.endswith(","))
    spoilt[last] = spoilt[last][:-1] + ("1" if spoilt[last][-1] != "1" else "0")
    (tmp_path / "record.csv").write_text("\n".join(spoilt), encoding="utf-8")
    with imported(machine=stand_in("machine"), firmware=package), pytest.raises(AssertionError, match="expected, found"):
        stand_in("replay").replay(str(tmp_path / "record.csv"))


@pytest.mark.slow
@pytest.mark.parametrize("of_pulses", ["pca9685", "maestro"])
def test_record_of_session_with_pulses_is_replayed_byte_for_byte(of_pulses: pwm.Board, tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "record.csv").write_text("\n".join(exchange_pulses(of_pulses).record), encoding="utf-8")
    with imported(machine=stand_in("machine"), firmware=package):
        boots, turns, count = stand_in("replay").replay(str(tmp_path / "record.csv"))
    assert boots >= 2
    assert turns > 1000
    assert count > 20_000


def test_transfers_go_to_the_i2c_bus() -> None:
    machine = stand_in("machine")
    i2c = machine.I2C(0)
    port = board.I2cPort(i2c)
    i2c.answer = b"\1"
    port.write(pca9685.frame(pca9685.write(0x40, 6, (0, 0, 7, 1))))
    i2c.answer = b"\1\2\3\4\5"
    port.write(pca9685.frame(pca9685.read(0x41, 6, 4)))
    assert port.read() == b"\1\1\2\3\4\5"
    i2c.answer = bytes(5)
    port.write(pca9685.frame(pca9685.read(0x41, 6, 4)))
    assert port.read() == bytes(5), "not acknowledged"
    assert port.read() == b""
    assert i2c.take() == b"".join(
        pca9685.frame(one) for one in (pca9685.write(0x40, 6, (0, 0, 7, 1)), pca9685.read(0x41, 6, 4), pca9685.read(0x41, 6, 4))
    )


def test_maestro_is_at_the_uart_of_the_servos_with_both_lines_in_use() -> None:
    pulses = ("Maestro", 424_400, 1500, 1000, 50, 0)
    settings = SimpleNamespace(**{**vars(config), "SERVO": "PWM", "PULSES": pulses, "BAUD_RATE": 115_200, "ECHO": True})
    assert settings.DIRECTION is not None
    port = board.open_bus(stand_in("machine"), settings)
    assert isinstance(port, board.UartPort)
    assert (port._uart.number, port._uart.options["baudrate"]) == (config.BUS_UART, 115_200)
    port.write(b"\xa1")
    port._uart.received += b"\0\0"
    assert (port._uart.take(), port.read()) == (b"\xa1", b"\0\0"), "no direction pin, and no echo to drop"
    for rate in (38_400, 1_000_000):
        settings.BAUD_RATE = rate
        with pytest.raises(ValueError, match=f"BAUD_RATE of 57600 to 200000 expected for a Maestro, found {rate}"):
            board.start(settings, 1, 0)
    settings.PULSES = (424_400, 1500, 1000, 50, 0)
    with pytest.raises(ValueError, match="PCA9685 or Maestro expected in PULSES, found 424400"):
        board.start(settings, 1, 0)


def test_clock_continues_when_the_counter_wraps() -> None:
    ticks = [TICKS - 5]
    clock = board.Clock(lambda: ticks[0], ticks_diff)
    for step in (3, 4, 1000, TICKS // 2 - 1):
        before = clock.now_us()
        ticks[0] = (ticks[0] + step) % TICKS
        assert clock.now_us() - before == step


def test_echo_is_dropped_exactly() -> None:
    machine = stand_in("machine")
    port = board.UartPort(machine.UART(1), echo=True)
    port.write(b"request")
    port._uart.received += b"requ"
    assert port.read() == b""
    port._uart.received += b"estanswer"
    assert port.read() == b"answer"
    port._uart.received += b"more"
    assert port.read() == b"more"


def test_main_program_serves_host_over_usb(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run main.py itself: it announces itself, obeys torque off, and feeds the watchdog."""
    machine, now = stand_in("machine"), [TICKS - 100]
    received, sent, uarts = bytearray(encode(Torque(9, 1, 0, 0))), bytearray(), []
    make = machine.UART

    def passes() -> None:
        now[0] = (now[0] + 1000) % TICKS

    class Stream:
        def read(self, count: int) -> bytes:
            data = bytes(received[:count])
            del received[:count]
            return data

        def write(self, data: bytes) -> None:
            sent.extend(data)

    class Poller:
        POLLIN = 1

        def register(self, stream: object, events: int) -> None:
            assert events == self.POLLIN

        def poll(self, wait_ms: int) -> list[int]:
            assert wait_ms == 0
            return [1] if received else []

    machine.UART = lambda number, **options: uarts.append(make(number, **options)) or uarts[-1]
    machine.WDT.left, machine.WDT.before_feed = 150, passes
    select, micropython, streams = ModuleType("select"), ModuleType("micropython"), ModuleType("sys")
    select.poll, select.POLLIN = Poller, Poller.POLLIN  # type: ignore[attr-defined]
    micropython.kbd_intr = lambda byte: None  # type: ignore[attr-defined]
    streams.stdin = ModuleType("stdin")  # type: ignore[attr-defined]
    streams.stdout = ModuleType("stdout")  # type: ignore[attr-defined]
    streams.stdin.buffer = streams.stdout.buffer = Stream()  # type: ignore[attr-defined]
    monkeypatch.setattr(time, "ticks_us", lambda: now[0], raising=False)
    monkeypatch.setattr(time, "ticks_diff", ticks_diff, raising=False)
    with imported(machine=machine, select=select, micropython=micropython):
        from sextant.shared.servo.firmware import main

        monkeypatch.setattr(main, "sys", streams)
        with pytest.raises(KeyboardInterrupt):
            main.run()
    del sys.modules[main.__name__]
    (bus,) = uarts
    assert bus.number == config.BUS_UART
    assert bus.options["baudrate"] == 1_000_000
    off = dynamixel.write(dynamixel.BROADCAST_ID, dynamixel.TORQUE_ENABLE.address, b"\0")
    assert bus.sent.startswith(off)
    assert set(bus.sent.split(off)) == {b""}, "nothing else"
    welcomes = Receiver(TO_HOST).feed(bytes(sent))
    assert len(welcomes) >= 1
    assert {(type(found), found.session, found.servo) for found in welcomes if isinstance(found, Welcome)} == {
        (Welcome, 0, "AX-12A")
    }
