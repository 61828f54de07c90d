from typing import Any

from numpy.typing import NDArray

def fill_squares(sums: NDArray[Any], integral: NDArray[Any], lags: NDArray[Any]) -> None: ...
