"""Array types, lattice points, and choices among scores that are robust against rounding.

Scores that are equal in theory, for example at mirrored positions, differ by rounding, which
depends on the processor. Scores within a small distance of the best therefore count as equal to it,
and the first one is chosen.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
IntArray: TypeAlias = NDArray[np.int64]
Float32Array: TypeAlias = NDArray[np.float32]
Complex64Array: TypeAlias = NDArray[np.complex64]

Point: TypeAlias = tuple[float, float]
"""x, y [m]."""


def lattice(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return all points of a lattice, (len(x) * len(y), 2), row by row, x running first."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def least_gap(places: FloatArray) -> float:
    """Return the smallest distance between positions (n, 2), infinite for fewer than two."""
    gaps = np.linalg.norm(places[:, None] - places, axis=-1)
    return float(gaps[np.triu_indices(len(places), 1)].min(initial=np.inf))


def rms(values: ArrayLike) -> float:
    """Return the root mean square, 0 for an empty array."""
    squares = np.square(values)
    return float(np.sqrt(np.mean(squares))) if np.size(squares) else 0.0


def nullable(values: ArrayLike | None) -> Any:
    """Convert to JSON numbers, an array to lists; None for missing values and values that are not
    finite."""
    numbers = np.asarray(values, dtype=float)
    return np.where(np.isfinite(numbers), numbers, np.array(None)).tolist()


_Item = TypeVar("_Item")

NEARLY = 1e-5
"""Distance from the best, relative to it, within which scores count as equal."""


def best_of(scores: ArrayLike) -> int:
    """Return the index of the first of the highest scores (n,)."""
    return int(best_along(scores, axis=0))


def best_along(scores: ArrayLike, axis: int) -> IntArray:
    """Return the index of the first of the highest scores along an axis."""
    values = np.asarray(scores)
    return np.asarray(_are_near(values, values.max(axis=axis, keepdims=True)).argmax(axis=axis))


def best_first(scores: ArrayLike) -> IntArray:
    """Return the order of scores (n,), highest first; nearly equal scores keep their order.

    Neighbors in a run of nearly equal scores are close to each other, but not always to all
    others.
    """
    values = np.asarray(scores)
    order = np.argsort(-values, kind="stable")
    ordered = values[order]
    run = np.concatenate([[0], np.cumsum(~_are_near(ordered[1:], ordered[:-1]))])[: len(order)]
    return np.asarray(order[np.lexsort((order, run))])


def _are_near(values: NDArray[Any], better: NDArray[Any]) -> NDArray[np.bool_]:
    """Return whether values are nearly as high as better values; infinite values equal
    themselves."""
    with np.errstate(invalid="ignore"):
        return np.asarray((values == better) | (values >= better - NEARLY * np.abs(better)))


def best_few(scores: ArrayLike, count: int) -> IntArray:
    """Return the first indices of `best_first`, up to a count, without sorting all scores."""
    values = np.asarray(scores)
    if len(values) <= count:
        return best_first(values)
    threshold = np.partition(values, -count)[-count]
    among = np.flatnonzero(values >= threshold - 2 * NEARLY * np.abs(threshold))
    return np.asarray(among[best_first(values[among])[:count]])


def best_rows(scores: ArrayLike, count: int) -> IntArray:
    """Return indices (count, ...) of the highest scores along the first axis, highest first."""
    remaining = np.array(scores)
    rows = []
    for _ in range(count):
        best = best_along(remaining, axis=0)[None]
        np.put_along_axis(remaining, best, -np.inf, axis=0)
        rows.append(best)
    return np.concatenate(rows)


def best_by(items: Sequence[_Item], score: Callable[[_Item], float]) -> _Item:
    """Return the first of the items with the highest scores."""
    return items[best_of([score(item) for item in items])]


def ranked_by(items: Sequence[_Item], score: Callable[[_Item], float]) -> list[_Item]:
    """Return items in the order of `best_first`."""
    order = best_first([score(item) for item in items])
    return [items[number] for number in order]
