"""Recorder on the wire of a Pololu Maestro, which sends pulses to hobby servos."""

from benchmarks.faults.bus_log import SIDES, Role, Switch, WireLog
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo import maestro
from sextant.shared.servo.pwm import TICKS_PER_US


class PulseRecorder(WireLog):
    """Decodes the commands of a Maestro. A servo without pulses has no torque."""

    def __init__(self, profile: RobotProfile):
        """Start without data.

        Raises:
            ValueError: The robot has another board.
        """
        super().__init__(profile)
        pulses = profile.servo.pulses
        if pulses is None or pulses.board != "maestro":
            raise ValueError(f"hobby servos at a Maestro expected, found {profile.servo_model.protocol.NAME}")
        self._pulses = pulses
        self._parsers = {side: maestro.CommandParser(pulses.device or maestro.DEVICE) for side in SIDES}
        self._has_pulses = {side: dict.fromkeys(self._ids, True) for side in SIDES}

    def _hear(self, side: str, data: bytes, now_ns: int) -> None:
        for packet in self._parsers[side].feed(data):
            if targets := maestro.targets(packet):
                self._note(side, now_ns * 1e-9, {channel: targets[channel] for channel in self._ids if channel in targets})

    def _note(self, side: str, t_s: float, targets: dict[int, int]) -> None:
        """Store targets [quarter us] of channels: goals, ends of pulses, and their returns."""
        goals = {channel: self._pulses.ticks(target / TICKS_PER_US) for channel, target in targets.items() if target}
        if side == "sent" and goals:
            self._judge(t_s, goals, {})
        had = self._has_pulses[side]
        for value, switched in ((0, targets.keys() - goals.keys()), (1, {one for one in goals if not had[one]})):
            if switched:
                self.switches.append(Switch(t_s, side == "heard", Role.TORQUE, dict.fromkeys(sorted(switched), value)))
                had.update(dict.fromkeys(switched, bool(value)))
