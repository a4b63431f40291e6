"""The part of msgpack that the bridge uses: one array of integers, texts and raw bytes.

Source: the specification of msgpack (github.com/msgpack/msgpack). Every number has its shortest form, as in the package for
Python.
"""

MAX_FIELDS = 32  # in an array


def pack(values: list[object]) -> bytes:
    """Encode an array of integers from 0 to 2^64 - 1, texts and bytes up to 65535 bytes."""
    out = bytearray()
    if len(values) < 16:
        out.append(0x90 | len(values))
    else:
        out.append(0xDC)
        out += _big(len(values), 2)
    for value in values:
        if isinstance(value, int):
            _add_number(out, value)
        elif isinstance(value, str):
            text = value.encode()
            if len(text) < 32:
                out.append(0xA0 | len(text))
            else:
                out += b"\xd9" + _big(len(text), 1)
            out += text
        elif isinstance(value, bytes):
            out += b"\xc4" + _big(len(value), 1) if len(value) < 256 else b"\xc5" + _big(len(value), 2)
            out += value
        else:
            raise ValueError("integer, text or bytes expected")
    return bytes(out)


def _add_number(out: bytearray, value: int) -> None:
    if value < 0x80:
        out.append(value)
    elif value < 0x100:
        out += b"\xcc" + _big(value, 1)
    elif value < 0x10000:
        out += b"\xcd" + _big(value, 2)
    elif value < 0x1_0000_0000:
        out += b"\xce" + _big(value, 4)
    else:
        out += b"\xcf" + _big(value, 8)


def _big(value: int, size: int) -> bytes:
    return value.to_bytes(size, "big")


def unpack(data: bytes) -> list[int | bytes | str] | None:
    """Decode an array of integers, texts and bytes; None for anything else."""
    if not data:
        return None
    code, at = data[0], 1
    count = code & 0x0F
    if code == 0xDC and len(data) >= 3:
        count, at = data[1] << 8 | data[2], 3
    elif code >> 4 != 9:
        return None
    if count > MAX_FIELDS:
        return None
    values: list[int | bytes | str] = []
    for _ in range(count):
        if at >= len(data):
            return None
        code = data[at]
        at += 1
        if code < 0x80:
            values.append(code)
            continue
        if code >= 0xE0:
            values.append(code - 0x100)
            continue
        size = 1 << (code & 3)  # [bytes] of a number
        if 0xCC <= code <= 0xD3:
            raw = data[at : at + size]
            if len(raw) < size:
                return None
            value = int.from_bytes(raw, "big")
            if code >= 0xD0 and raw[0] & 0x80:
                value -= 1 << 8 * size
            values.append(value)
            at += size
            continue
        if code in (0xC4, 0xD9):
            head = 1
        elif code in (0xC5, 0xDA):
            head = 2
        elif code >> 5 == 5:
            head = 0
        else:
            return None
        if at + head > len(data):
            return None
        size = int.from_bytes(data[at : at + head], "big") if head else code & 0x1F
        at += head
        raw = data[at : at + size]
        if len(raw) < size:
            return None
        at += size
        if code in (0xC4, 0xC5):
            values.append(raw)
        else:
            try:
                values.append(raw.decode())
            except UnicodeError:
                return None
    return values if at == len(data) else None
