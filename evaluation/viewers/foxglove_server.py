"""Live topics for Foxglove and Lichtblick, translated like a recording."""

from types import TracebackType
from typing import Self

import foxglove
from google.protobuf.message import Message

from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.recording.writer import LEFT_OUT, declaration
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic


class FoxgloveServer:
    """A WebSocket server as a sink of a `LiveRecorder`; a context manager.

    Messages that a slow viewer does not receive in time are dropped by its queue, the oldest first.
    """

    skipped: frozenset[AnyTopic] = LEFT_OUT

    def __init__(self, profile: RobotProfile, host: str, port: int):
        """Start the server for a robot.

        Raises:
            OSError: The server cannot listen on the address.
        """
        self.size = 0  # [bytes] sent so far
        self._translator = Foxglove(profile)
        self._channels: dict[str, foxglove.Channel] = {}
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name=f"sextant {profile.name}", host=host, port=port, context=self._context)
        except RuntimeError as error:
            raise OSError(f"cannot listen on {host}:{port}: {error}; give another port with --port") from None
        self.target = f"ws://{host}:{self._server.port}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Send a frame's messages to all subscribed viewers."""
        for name, message in self._translator.translate(topic, frame, at_ns):
            data = message.SerializeToString()
            self._channel(name, message).log(data, log_time=at_ns)
            self.size += len(data)

    def flush(self) -> None:
        """Do nothing: no data is buffered."""

    def sync(self) -> None:
        """Do nothing: no data is on a disk."""

    def close(self) -> None:
        """Disconnect all viewers; safe to call twice."""
        self._server.stop()

    def abandon(self) -> None:
        """Disconnect all viewers."""
        self.close()

    def _channel(self, name: str, message: Message) -> foxglove.Channel:
        if name not in self._channels:
            kind = message.DESCRIPTOR
            schema = foxglove.Schema(name=kind.full_name, encoding="protobuf", data=declaration(kind.file).SerializeToString())
            self._channels[name] = foxglove.Channel(name, schema=schema, message_encoding="protobuf", context=self._context)
        return self._channels[name]
