from typing import Any

from numpy.typing import NDArray

def turns(
    rate: NDArray[Any],
    step: NDArray[Any],
    weights: NDArray[Any],
    start: NDArray[Any],
    stop: NDArray[Any],
    matrix: NDArray[Any],
    sums: NDArray[Any],
    squares: NDArray[Any],
) -> None: ...
def between(
    values: NDArray[Any],
    columns: int,
    kernels: NDArray[Any],
    start: NDArray[Any],
    stop: NDArray[Any],
    pieces: int,
    middle: NDArray[Any],
    half: NDArray[Any],
) -> None: ...
