"""Powers of ten to 128 bits, which the C modules read and print numbers with; made when the first is needed."""

from __future__ import annotations

import struct
from functools import cache

_LOWEST, _HIGHEST = -342, 308


@cache
def powers_of_five() -> bytes:
    """Return 5^q for q = -342 .. 308, each scaled by a power of two to 128 bits: high half, low half (uint64).

    Rounded as D. Lemire, "Number parsing at a gigabyte per second", 2021, prescribes: up for -27 <= q < 0, else down.
    """
    words = []
    for q in range(_LOWEST, _HIGHEST + 1):
        power = 5 ** abs(q)
        size = power.bit_length()
        if q >= 0:
            number = power << 128 - size if size <= 128 else power >> size - 128
        elif q >= -27:
            number = (1 << size + 127) // power + 1
        else:
            number = (1 << 2 * size + 128) // power + 1
            number >>= number.bit_length() - 128
        words += [number >> 64, number & (1 << 64) - 1]
    return struct.pack(f"={len(words)}Q", *words)


@cache
def powers_of_ten() -> bytes:
    """Return 10^k for k = -292 .. 324, each scaled by a power of two to 128 bits, rounded up: high half, low half."""
    words = []
    for k in range(-292, 325):
        power = 5 ** abs(k)
        size = power.bit_length()
        if k >= 0:
            number = power << 128 - size if size <= 128 else -(-power >> size - 128)
        else:
            number = -(-(1 << size + 127) // power)
        words += [number >> 64, number & (1 << 64) - 1]
    return struct.pack(f"={len(words)}Q", *words)
