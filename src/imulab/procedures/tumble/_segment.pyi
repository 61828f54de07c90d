from typing import Any

from numpy.typing import NDArray

def blocks(
    x: NDArray[Any],
    y: NDArray[Any],
    z: NDArray[Any],
    time: NDArray[Any],
    length: int,
    mean: NDArray[Any],
    scatter: NDArray[Any],
    longest: NDArray[Any],
) -> None: ...
def windows(
    mean: NDArray[Any], scatter: NDArray[Any], broken: NDArray[Any], width: int, variance: NDArray[Any]
) -> None: ...
def stretches(
    variance: NDArray[Any], limit: float, width: int, trim: int, fewest: int, start: NDArray[Any], stop: NDArray[Any]
) -> int: ...
def attitudes(
    block_mean: NDArray[Any],
    start: NDArray[Any],
    stop: NDArray[Any],
    same: float,
    attitude: NDArray[Any],
    mean: NDArray[Any],
) -> int: ...
def ellipsoid_error(mean: NDArray[Any]) -> float: ...
def batches(
    block_mean: NDArray[Any],
    start: NDArray[Any],
    stop: NDArray[Any],
    attitude: NDArray[Any],
    centre: NDArray[Any],
    size: int,
    first: NDArray[Any],
    mean: NDArray[Any],
    number: NDArray[Any],
    scatter: NDArray[Any],
) -> None: ...
def motion(
    x: NDArray[Any],
    y: NDArray[Any],
    z: NDArray[Any],
    length: int,
    block_mean: NDArray[Any],
    start: NDArray[Any],
    stop: NDArray[Any],
    attitude: NDArray[Any],
    centre: NDArray[Any],
    noise: NDArray[Any],
    spread: NDArray[Any],
    slope: NDArray[Any],
) -> None: ...
