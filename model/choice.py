"""Choices among scores that rounding cannot turn.

Scores that are equal in theory, as of two places that mirror each other, differ by rounding, which
is another one on another processor. So scores within a small distance of the best count as equal to
it, and the first of them is chosen.
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import IntArray

_Item = TypeVar("_Item")

NEARLY = 1e-5
"""Distance from the best, relative to it, within which scores count as equal."""


def best_of(scores: ArrayLike) -> int:
    """Index of the first of the highest scores (n,)."""
    return int(best_along(scores, axis=0))


def best_along(scores: ArrayLike, axis: int) -> IntArray:
    """Index of the first of the highest scores along an axis."""
    values = np.asarray(scores)
    best = values.max(axis=axis, keepdims=True)
    with np.errstate(invalid="ignore"):  # infinite: equal only to itself
        is_best = (values == best) | (values >= best - NEARLY * np.abs(best))
    return np.asarray(is_best.argmax(axis=axis))


def best_first(scores: ArrayLike) -> IntArray:
    """Order of scores (n,), the highest first; of those nearly equal the first one first.

    Each of a run of nearly equal scores is near its neighbours, not always near all others.
    """
    values = np.asarray(scores)
    order = np.argsort(-values, kind="stable")
    ordered = values[order]
    above, below = ordered[:-1], ordered[1:]
    with np.errstate(invalid="ignore"):  # infinite: equal only to itself
        is_near = (below == above) | (below >= above - NEARLY * np.abs(above))
    run = np.concatenate([[0], np.cumsum(~is_near)])[: len(order)]
    return np.asarray(order[np.lexsort((order, run))])


def best_few(scores: ArrayLike, count: int) -> IntArray:
    """The first of `best_first`, up to count, without an order of the rest."""
    values = np.asarray(scores)
    if len(values) <= count:
        return best_first(values)
    least = np.partition(values, -count)[-count]
    among = np.flatnonzero(values >= least - 2 * NEARLY * np.abs(least))
    return np.asarray(among[best_first(values[among])[:count]])


def best_rows(scores: ArrayLike, count: int) -> IntArray:
    """Indices (count, ...) along the first axis of the highest scores, the highest first."""
    left = np.array(scores)
    found = []
    for _ in range(count):
        best = best_along(left, axis=0)[None]
        np.put_along_axis(left, best, -np.inf, axis=0)
        found.append(best)
    return np.concatenate(found)


def best_by(items: Sequence[_Item], score: Callable[[_Item], float]) -> _Item:
    """The first of the items with the highest scores."""
    return items[best_of([score(each) for each in items])]


def ranked_by(items: Sequence[_Item], score: Callable[[_Item], float]) -> list[_Item]:
    """Items in the order of `best_first`."""
    return [items[each] for each in best_first([score(each) for each in items])]
