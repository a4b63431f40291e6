"""Frames with another version's schema."""

from sextant.shared.wire import codec
from sextant.shared.wire.messages import Message


def of_another_version(message: Message) -> bytes:
    """Return the frame of a message whose type is declared differently elsewhere."""
    name = codec.schema_id(type(message))
    other = name.partition(":")[0] + ":00000000"
    assert len(other) == len(name)
    return codec.encode(message).replace(name.encode(), other.encode(), 1)
