from typing import Any

from numpy.typing import NDArray

def parse(
    block: bytes,
    delimiter: str,
    slots: NDArray[Any],
    out: NDArray[Any],
    capacity: int,
    start: int = 0,
    stop: int = -1,
    row: int = 0,
) -> tuple[int, int, int]: ...
def choose(
    block: bytes,
    delimiter: str,
    out: bytearray,
    prefix: bytes,
    slots: NDArray[Any] | bytes,
    skip: bool,
    most_fields: int = 0,
    most_rows: int = -1,
) -> tuple[int, int, int, int]: ...
def line_ends(block: bytes) -> int: ...
def prepare(fives: bytes) -> None: ...
