"""Client of the recorder: sends record commands and logs the recorder's state.

It repeats a command until the recorder acknowledges it.
"""

from collections.abc import Iterator
from typing import Any

from sextant.shared.recording.event_log import EventLog
from sextant.shared.wire.messages import RecordCommand, RecorderState

_REPEAT_NS = 1_000_000_000  # [ns] period of a command that is not acknowledged yet


class RecorderClient:
    """Sends record commands to the recorder, again after a restart of the recorder."""

    def __init__(self, event_log: EventLog):
        """Start without a command; events are written to the event log `event_log`."""
        self._event_log = event_log
        self._order: RecordCommand | None = None  # newest command; None after the recorder reports failure
        self._due_ns = 0
        self._state: RecorderState | None = None  # None if the recorder is silent
        self._was_heard = False
        self._told = ""

    def want(self, record: bool, now_ns: int) -> str:
        """Start or end a recording; return why that is not possible, "" if it is."""
        if self._state is None:
            return "no recorder is running; `sextant up` starts one"
        sequence = now_ns if self._order is None else max(now_ns, self._order.sequence + 1)
        self._order = RecordCommand(now_ns, record, sequence)  # a time, so it exceeds the sequences of a previous console
        self._due_ns = now_ns
        return ""

    def beat(self, now_ns: int, state: RecorderState | None) -> Iterator[RecordCommand]:
        """Process the recorder's state, and yield the command if it is due.

        The state is None if the recorder is silent.
        """
        self._see(now_ns, state)
        order = self._order
        if order is None or state is None or state.sequence == order.sequence or now_ns < self._due_ns:
            return
        self._due_ns = now_ns + _REPEAT_NS
        yield order

    def view(self) -> dict[str, Any] | None:
        """Return the recorder's state for pages, None without a recorder."""
        state = self._state
        if state is None:
            return None
        return {
            "recording": state.recording,
            "file": state.file,
            "duration_s": round(state.duration),
            "size_mb": round(state.size / 1e6, 1),
            "disk_free_gb": None if state.disk_free < 0 else round(state.disk_free / 1e9, 1),
            "dropped": state.dropped,
            "reason": state.reason,
        }

    def _see(self, now_ns: int, state: RecorderState | None) -> None:
        before, self._state = self._state, state
        if state is None:
            if self._was_heard and before is not None:
                wanted = self._order is not None and self._order.record
                lost = "; messages are not recorded now" if wanted or before.recording else ""
                self._note(now_ns, f"no message from the recorder{lost}", bool(lost))
            return
        self._was_heard = True
        if before is not None and before.recording and state.sequence < 0:
            self._note(now_ns, "the recorder has restarted; messages in the meantime were not recorded", True)
        if state.reason:
            if self._order is not None and state.sequence == self._order.sequence:
                self._order = None  # the recorder failed; the operator must repeat the request after a repair
            self._note(now_ns, state.reason, True)
        elif state.recording:
            self._note(now_ns, f"recording to {state.file}")
        elif state.file:
            self._note(now_ns, f"recorded {state.file}")
        if before is not None and state.recording and state.dropped > before.dropped:
            self._event_log.note(
                now_ns, "recorder", f"{state.dropped} messages were not recorded: the disk is too slow", bad=True
            )

    def _note(self, now_ns: int, words: str, bad: bool = False) -> None:
        if words != self._told:
            self._told = words
            self._event_log.note(now_ns, "recorder", words, bad)
