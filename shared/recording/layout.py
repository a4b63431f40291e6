"""Layout of recordings: MCAP files with one channel per topic.

The frames are unchanged, and the schema of a channel declares its message.
"""

import json
from typing import Any, Literal

import numpy as np

from sextant.shared.errors import SextantError
from sextant.shared.wire import codec, messages
from sextant.shared.wire.messages import Message

ENCODING = "sextant"  # of Sextant's own schemas and messages
METADATA = "run"  # name of the metadata record about the run
SCENARIO = "scenario.json"  # its key for the scenario that was walked; see `sextant.evaluation.walked_scenario`
FOR_PROGRAMS = frozenset({"frame_layout", SCENARIO})  # its keys that are not shown

FRAME_LAYOUT = (
    "uint32 little-endian header length | header | padding to 8 bytes | arrays, each padded to 8 bytes. "
    "The header is msgpack [schema, began_ns, sent_ns, [field, ...]] with the fields in the order of the channel's schema; "
    "an array field is [dtype, [length, ...], offset into the arrays], dtype in NumPy's notation. "
    "A packed one has the number of its bytes behind that: a Zstandard frame of its differences along the first axis, column "
    "by column, zigzag coded, the lowest bytes of all of them first."
)


class RecordingError(SextantError, ValueError):
    """A file is not a recording that this version can read.

    The text gives the file and what to do.
    """


def describe(kind: type[Message]) -> str:
    """Return a message's declaration as JSON text.

    It has the schema id, and name, type and shape of each field in order.
    """
    fields = [{"name": name, **_described(base, detail)} for name, base, detail in messages.schema(kind)]
    return json.dumps({"schema": codec.schema_id(kind), "doc": kind.__doc__, "fields": fields}, indent=1)


def _described(base: Any, detail: Any) -> dict[str, Any]:
    if base is np.ndarray:
        dtype, dims = detail
        return {"type": "array", "dtype": dtype.str, "shape": list(dims.shape), "finite": dims.finite, "packed": dims.packed}
    if base is Literal:
        return {"type": "str", "one_of": list(detail)}
    if base is tuple:
        return {"type": "list of str"}
    if issubclass(base, str) and base is not str:
        return {"type": "str", "one_of": [str(member) for member in base]}
    return {"type": base.__name__}
