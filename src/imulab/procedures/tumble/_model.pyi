from typing import Any

from numpy.typing import NDArray

def lengths(
    theta: NDArray[Any],
    reading: NDArray[Any],
    order: int,
    norm: NDArray[Any],
    jacobian: NDArray[Any],
    force: NDArray[Any],
) -> None: ...
def noise(
    theta: NDArray[Any],
    jacobian: NDArray[Any],
    covariance: NDArray[Any],
    lengthening: NDArray[Any],
    variance: NDArray[Any],
) -> None: ...
def fit(
    theta: NDArray[Any],
    reading: NDArray[Any],
    weights: NDArray[Any],
    lengthening: NDArray[Any],
    order: int,
    tolerance: float,
    most: int,
    residuals: NDArray[Any],
    jacobian: NDArray[Any],
    iterations: NDArray[Any],
    converged: NDArray[Any],
) -> None: ...
def left_out(
    theta: NDArray[Any],
    reading: NDArray[Any],
    weights: NDArray[Any],
    lengthening: NDArray[Any],
    order: int,
    tolerance: float,
    most: int,
    errors: NDArray[Any],
) -> None: ...
def best_subset(
    residual: NDArray[Any],
    matrix: NDArray[Any],
    least: float,
    best: NDArray[Any],
) -> float: ...
