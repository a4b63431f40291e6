"""Emulated board with the hobby servos of a robot, on a workbench: no physics, a joint follows its pulses."""

import numpy as np

from sextant.services.simulator.servo_bus.host_link import AdapterPort, AnswersOnly, Reply
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profile import RobotProfile

_ALL_NS = 1 << 62  # [ns] by which the board has sent all pulses


class PulseBench(AnswersOnly):
    """Board at a port, whose channels have no pulses at first."""

    commands = "list, quit"  # that `execute` accepts

    def __init__(self, profile: RobotProfile) -> None:
        """Connect the servos of a robot; raises ValueError if they are not hobby servos."""
        if profile.servo.pulses is None:
            raise ValueError(f"a robot with hobby servos expected, found {profile.name}")
        self._profile = profile
        self._servos = make_servo_bank(profile.servo, list(profile.servo_names), np.zeros(18))
        self._board = make_board(self._servos, profile.servo.pulses)

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes that the host sends at a time [ns], and return the answers."""
        self._board.advance(now_ns)
        return self._board.receive(data, now_ns)

    def adapter_port(self, now_ns: int) -> AdapterPort | None:
        """Return the identity of the port, which never changes."""
        return AdapterPort()

    def execute(self, line: str) -> str:
        """Execute a command that the operator typed, and return the state as text; raises ValueError for an unknown one."""
        if line.split() != ["list"]:
            raise ValueError(f"one of {self.commands} expected, found {line.strip()!r}")
        self._board.advance(_ALL_NS)  # no host asks meanwhile, and pulses begin within a period
        table = self._servos.table
        torque = self._servos.column(table.torque_enable).tolist()
        with_pulses = [joint for joint, on in zip(self._profile.servo_names.values(), torque, strict=True) if on]
        return f"{len(with_pulses)} of {len(torque)} servos have pulses: {', '.join(with_pulses) or 'none'}"
