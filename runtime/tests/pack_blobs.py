"""Tables of every kind as blobs, packed by hand in both widths, for vectors.h and for the fuzzer."""

import struct
import zlib


def section(kind, *parts):
    payload = b"".join(parts)
    return struct.pack("<II", kind, len(payload)) + payload


def blob(width, *sections, version=1):
    body = b"".join(sections)
    head = b"\x89IMULAB\n" + struct.pack("<HHI", version, width, 20 + len(body))
    return head + body + struct.pack("<I", zlib.crc32(head + body))


def words(*values):
    return struct.pack(f"<{len(values)}I", *values)


def reals(width, *values):
    return struct.pack(f"<{len(values)}{'d' if width == 8 else 'f'}", *values)


def counted(width, n, start):
    """n numbers that say where they stand, all exact in float."""
    return reals(width, *(start + i / 8 for i in range(n)))


def make_sections(w):
    tumble_of = [
        section(1, words(order), counted(w, 15, order), counted(w, 3 * (order - 1), 50)) for order in range(1, 6)
    ]
    gyro_of = [section(2, words(0), counted(w, 15, 1)), section(2, words(1), counted(w, 24, 1))]
    drift = section(3, words(1, 0), counted(w, 11, 2))
    warm = []
    for model in range(4):
        terms, rows = (4, 2 if model == 0 else 3) if model < 3 else (2, 3)
        head = words(model, model % 3, 3, 2, terms) + reals(w, 300, 60, 20, 15, 90, 200) + reals(w, -40, 0, 60)
        tables = counted(w, rows * 2 * terms, 1) + (counted(w, rows * 2 * terms, 100) if model == 3 else b"")
        warm.append(section(4, head, tables))
    sensors = []
    for method in range(7):
        n, axes = 3, 3 if method == 4 else 1
        mask = [1, 2, 4, 8, 7, 8, 16][method]
        size = axes * n * (mask & 1) + n * axes * axes * (mask >> 1 & 1) + axes * n * (mask >> 2 & 1)
        size += axes * n * (mask >> 3 & 1) + axes * (n + 1) * n * (mask >> 4 & 1)
        head = words(method, n, axes, 2 if mask & 4 else 0, 1, 1, 100, 20, 10, 5, mask)
        sensors.append(section(5, head, reals(w, 0.25, 6, 4, 0.0078125, 0.5, 0.0625), counted(w, size, 1)))
    return tumble_of, gyro_of, drift, warm, sensors


def imus_reals(w):
    """Gate, output point, and of three IMUs positions, matrices, biases, noises, limits: each its counted numbers."""
    sizes = (9, 27, 9, 3, 3, 27, 9, 3, 3, 27)
    return counted(w, 4, 30) + b"".join(counted(w, n, 1 + i) for i, n in enumerate(sizes))


def make_blobs(w):
    tumble_of, gyro_of, drift, warm, sensors = make_sections(w)
    text = section(0, b'{"format": "imulab.blob"}')
    made = [blob(w), blob(w, text), blob(w, text, tumble_of[1], gyro_of[1], drift, warm[3], sensors[4])]
    field = [section(6, words(1), counted(w, 15, 3)), section(6, words(2), counted(w, 18, 3))]
    crossed = section(1, words(256 + 2), counted(w, 15, 2), counted(w, 6, 50))  # with cross terms
    laws = [
        section(7, words(pieces, terms), counted(w, pieces + 1, -20), counted(w, 9 * pieces * terms, 30))
        for pieces, terms in ((1, 4), (3, 2))
    ]
    rates = [
        section(8, words(g, pieces, terms), counted(w, 9 + 9 * g, 1), counted(w, pieces + 1, -20),
                counted(w, 6 * pieces * terms, 30))
        for g, pieces, terms in ((0, 1, 4), (1, 3, 2))
    ]  # fmt: skip
    bent = section(2, words(1, 3), counted(w, 24, 1), counted(w, 12, 60))  # of order 3: version 2
    made += [blob(w, s) for s in (*tumble_of, *gyro_of, drift, crossed, *warm, *sensors, *field, *laws)]
    board = section(9, words(3, 20, 16), imus_reals(w))  # three whole IMUs: version 3
    return [*made, blob(w, bent, version=2), *(blob(w, s) for s in rates), blob(w, board, version=3)]


def write_seeds(folder):
    """The blobs for the fuzzer, whose first byte says what it mends: once nothing, once size and CRC."""
    folder.mkdir(parents=True, exist_ok=True)
    for w in (4, 8):
        for i, data in enumerate(make_blobs(w)):
            for choice in (2, 3 + (w & 8) // 2):
                (folder / f"{w}-{i}-{choice}").write_bytes(bytes([choice]) + data)
