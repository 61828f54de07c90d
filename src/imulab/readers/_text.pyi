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
def prepare(fives: bytes) -> None: ...
