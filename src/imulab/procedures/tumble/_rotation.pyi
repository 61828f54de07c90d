from typing import Any

from numpy.typing import NDArray

def turns(
    angle: NDArray[Any],
    weights: NDArray[Any],
    start: NDArray[Any],
    stop: NDArray[Any],
    matrix: NDArray[Any],
    sums: NDArray[Any],
    squares: NDArray[Any],
) -> None: ...
