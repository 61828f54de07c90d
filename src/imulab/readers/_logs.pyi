from typing import Any

from numpy.typing import NDArray

def walk(
    kind: int,
    block: bytes | bytearray | memoryview,
    start: int,
    lengths: NDArray[Any],
    offsets: NDArray[Any],
    sizes: NDArray[Any],
    keys: NDArray[Any],
) -> tuple[int, int, int]: ...
