"""The page's estimate of the cycle time counts the instructions of the firmware; they are counted here."""

import dis
import re
import sys
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from sextant.shared.servo.firmware import board
from sextant.shared.servo.models import AX_12A, LX_16A, STS3215, XL430_W250
from sextant.shared.servo.servo_model import ServoModel
from tests.support.firmware_rig import FirmwareRig

PAGE = (Path(__file__).parents[5] / "docs" / "firmware.md").read_text(encoding="utf-8")
BOOKKEEPING = {"RESUME", "PRECALL", "CACHE", "PUSH_NULL", "NOP", "COPY_FREE_VARS", "MAKE_CELL", "EXTENDED_ARG", "KW_NAMES"}
CYCLES = 20


def count(model: ServoModel, monkeypatch: pytest.MonkeyPatch) -> tuple[float, float]:
    """Return the bytecodes of a reading and of a cycle, of a board with 18 servos that forwards goals."""
    rig, turn, found = FirmwareRig(model, 18), board.turn, defaultdict[str, list[int]](list)
    rig.driver.setup()
    rig.cycle(4, 0.0)
    rig.driver.set_torque(True)
    rig.cycle(8, 0.0)
    counted = 0

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal counted
        frame.f_trace_opcodes = True
        if event == "opcode" and "firmware/" in frame.f_code.co_filename:
            counted += dis.opname[frame.f_code.co_code[frame.f_lasti]] not in BOOKKEEPING
        return trace

    def counted_turn(firmware: Any, clock: Any, host: Any, bus: Any) -> None:
        nonlocal counted
        counted = 0
        heard = bool(bus._uart.received)
        before, debugger = len(bus._uart.sent), sys.gettrace()
        sys.settrace(trace)
        try:
            turn(firmware, clock, host, bus)
        finally:
            sys.settrace(debugger)
        asks = heard and 0 < len(bus._uart.sent) - before < 40 and not host._uart.sent
        found["reading" if asks else "other"].append(counted)

    uart = type(rig.board.firmware._servos)
    monkeypatch.setattr(uart, "write", lambda self, data: setattr(self, "sent", self.sent + data) or len(data))
    monkeypatch.setattr(uart, "txdone", lambda self: True)
    monkeypatch.setattr(board, "turn", counted_turn)
    began_ns = rig.now_ns
    for k in range(CYCLES):
        rig.cycle(1, 0.02 * k)
    cycles = (rig.now_ns - began_ns) / 20e6
    return sum(found["reading"]) / len(found["reading"]), sum(map(sum, found.values())) / cycles


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="the page counts the bytecodes of CPython 3.11")
@pytest.mark.parametrize("model", [AX_12A, STS3215, XL430_W250, LX_16A], ids=lambda model: model.name)
def test_page_states_instruction_counts(model: ServoModel, monkeypatch: pytest.MonkeyPatch) -> None:
    row = re.search(rf"^\| {model.name} \| ([\d,]+) \| ([\d,]+) \|", PAGE, re.MULTILINE)
    assert row is not None
    stated = [int(number.replace(",", "")) for number in row.groups()]
    assert count(model, monkeypatch) == pytest.approx(stated, rel=0.1)
