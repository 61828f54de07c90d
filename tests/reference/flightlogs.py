"""Writers of PX4 ULog and ArduPilot DataFlash files, from their published formats; nothing of imulab.

ULog: PX4 user guide, "ULog File Format" (version 1). DataFlash: ArduPilot AP_Logger/LogStructure.h.
"""

import struct
from collections.abc import Iterable, Sequence

ULOG_CODES = {"uint64_t": "Q", "uint32_t": "I", "int32_t": "i", "float": "f", "uint8_t": "B", "int16_t": "h"}


def ulog(
    formats: dict[str, str],
    subscriptions: Sequence[tuple[int, int, str]],
    data: Iterable[tuple[int, tuple]],
    info: dict[str, str] | None = None,
    flags: bytes | None = None,
) -> bytes:
    """A ULog: message formats, (instance, id, name) subscriptions, (id, values) messages in order."""

    def message(kind: bytes, payload: bytes) -> bytes:
        return struct.pack("<HB", len(payload), kind[0]) + payload

    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 112_233_445)]
    if flags is not None:
        out.append(message(b"B", flags))
    out += [message(b"F", f"{name}:{fields}".encode()) for name, fields in formats.items()]
    for key, value in (info or {}).items():
        head = f"char[{len(value)}] {key}".encode()
        out.append(message(b"I", bytes([len(head)]) + head + value.encode()))
    out += [
        message(b"A", struct.pack("<BH", instance, number) + name.encode()) for instance, number, name in subscriptions
    ]
    codes = {}
    for _, number, name in subscriptions:
        code = "<"
        for entry in formats[name].split(";"):
            if entry and not entry.split(" ")[1].startswith("_padding"):
                kind, _, count = entry.split(" ")[0].rstrip("]").partition("[")
                code += f"{count}{ULOG_CODES[kind]}"
        codes[number] = struct.Struct(code)
    for number, values in data:
        out.append(message(b"D", struct.pack("<H", number) + codes[number].pack(*values)))
    return b"".join(out)


DATAFLASH_CODES = {"Q": "Q", "B": "B", "f": "f", "I": "I", "H": "H", "h": "h", "c": "h", "e": "i", "Z": "64s", "d": "d"}


def dataflash(messages: dict[str, tuple[int, str, str]], data: Iterable[tuple[str, tuple]]) -> bytes:
    """A DataFlash log: name to (type, field types, field names), then (name, raw values) in order."""
    head = b"\xa3\x95"
    packers = {
        n: struct.Struct("<" + "".join(DATAFLASH_CODES[c] for c in types)) for n, (_, types, _) in messages.items()
    }

    def describe(kind: int, length: int, name: str, types: str, fields: str) -> bytes:
        return (
            head
            + bytes([128])
            + struct.pack("<BB4s16s64s", kind, length, name.encode(), types.encode(), fields.encode())
        )

    out = [describe(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    out += [describe(kind, packers[n].size + 3, n, types, fields) for n, (kind, types, fields) in messages.items()]
    out += [head + bytes([messages[name][0]]) + packers[name].pack(*values) for name, values in data]
    return b"".join(out)
