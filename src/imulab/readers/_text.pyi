from typing import Any

from numpy.typing import NDArray

def parse(
    block: bytes, delimiter: str, slots: NDArray[Any], out: NDArray[Any], capacity: int
) -> tuple[int, int, int]: ...
