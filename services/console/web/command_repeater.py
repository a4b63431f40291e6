"""Numbering and repetition of the pages' mode commands."""

from dataclasses import dataclass, replace

from sextant.shared.wire.messages import ActuatorState, Mode, ModeCommand, StopOrder

_REPEAT_NS = 500_000_000  # [ns] period of a command, which keeps the lease
_URGENT_NS = 100_000_000  # [ns] period of a torque-off command until torque is off
_RECEIVED_NS = 2_000_000_000  # [ns] age at which a command was received or is too old to be executed


@dataclass(slots=True)
class _Repeated:
    command: ModeCommand
    sent_ns: int


class CommandRepeater:
    """Repeats the newest command of each page until it needs no more repetition."""

    def __init__(self) -> None:
        """Start without commands."""
        self._repeated: dict[int, _Repeated] = {}  # page number -> its newest command
        self._new: list[ModeCommand] = []  # commands to publish
        self._sequence = 0
        self._off_ns = -1  # last time at which torque was off

    def order(self, page: int, holder: str, mode: str, now_ns: int, take: bool = False) -> None:
        """Publish a command of a page, in place of its earlier one.

        Args:
            page: Number of the page.
            holder: Lease holder of its commands.
            mode: Ordered mode.
            now_ns: Current time [ns].
            take: Whether the command takes over the lease.
        """
        ahead = self._sequence - now_ns > _RECEIVED_NS  # the clock was set back, e.g. by a restart of simulated time
        self._sequence = now_ns if ahead else max(self._sequence + 1, now_ns)
        command = ModeCommand(now_ns, mode, self._sequence, holder, take)  # type: ignore[arg-type]
        self._repeated[page] = _Repeated(command, now_ns)
        self._new.append(command)

    def end(self, page: int) -> None:
        """End the repetition of a page's command; its lease expires."""
        self._repeated.pop(page, None)

    def drain(self, now_ns: int, state: ActuatorState | None) -> list[ModeCommand]:
        """Return the commands to publish now, new and repeated ones.

        Args:
            now_ns: Current time [ns].
            state: Newest state of the actuator, None if it is outdated.
        """
        for page, repeated in list(self._repeated.items()):
            command = repeated.command
            if self._is_over(command, now_ns, state):
                self.end(page)
                continue
            pending = command.mode == "off" and (state is None or state.mode is not Mode.OFF)
            if now_ns - repeated.sent_ns >= (_URGENT_NS if pending else _REPEAT_NS):
                repeated.sent_ns = now_ns
                self._new.append(replace(command, stamp_ns=now_ns))
        new, self._new = self._new, []
        return new

    def _is_over(self, command: ModeCommand, now_ns: int, state: ActuatorState | None) -> bool:
        """Return whether a command needs no more repetition.

        Repetition ends 2 s after the command if torque is off. It also ends for a torque-off command when another client has
        turned torque on again, and for a stop command after 2 s if another client holds the lease.
        """
        received = now_ns - command.sequence > _RECEIVED_NS
        if state is None or state.stamp_ns < command.sequence:
            return False
        if state.mode is Mode.OFF:
            self._off_ns = state.stamp_ns
            return received
        if command.mode == "off" and self._off_ns >= command.sequence:  # another client has turned torque on again
            return True
        return command.mode == "stop" and received and state.lease != command.holder


def stop_order_of(command: ModeCommand) -> StopOrder | None:
    """Return an off or stop command as a `StopOrder`, None for any other command.

    A machine without the right to drive can publish only `StopOrder`. Taking over the lease needs the right to drive.
    """
    if command.take_over or command.mode not in ("off", "stop"):
        return None
    return StopOrder(command.stamp_ns, "off" if command.mode == "off" else "stop", command.sequence, command.holder)
