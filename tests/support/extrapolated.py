"""Derivatives by Richardson's extrapolation of central differences: another route to them."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray

_Number = TypeVar("_Number", np.float64, np.complex128)


def extrapolated_slopes(
    function: Callable[[FloatArray], NDArray[_Number]], at: FloatArray, *, step: float
) -> NDArray[_Number]:
    """Derivatives (n, ...) of a function (...) by each of its arguments (n,), right to step⁴."""

    def difference(number: int, size: float) -> NDArray[_Number]:
        moved = size * np.eye(len(at))[number]
        return np.asarray((function(at + moved) - function(at - moved)) / (2 * size))

    pairs = [(difference(n, step / 2), difference(n, step)) for n in range(len(at))]
    return np.array([(4 * half - whole) / 3 for half, whole in pairs])
