"""Checks of arguments that several functions take: positions of fingers, loads, frequencies."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from model.arguments import expect, is_whole, shown
from model.arrays import FloatArray, Point
from model.errors import InputError
from model.rig.rig import Rig

Positions: TypeAlias = Sequence[float] | Sequence[Sequence[float]]
"""One position x, y [m], or several; also an array of shape (2,) or (n, 2)."""


def expect_rig(value: object) -> None:
    """Raise InputError for anything but a rig, such as the name of its file."""
    expect(value, Rig, what="rig", made_by='era.load_rig("rig.yaml")')


def as_frequencies(given: object) -> FloatArray:
    """Frequencies (f,) [Hz] in the order given."""
    return _row(
        given, "frequencies must be a sequence of numbers in hertz, such as range(60, 321, 10)"
    )


def as_loads(given: object) -> tuple[float, ...]:
    """Loads for a question; raises InputError for anything but a sequence of numbers."""
    rule = (
        "loads must be a sequence with one number per finger, relative to the rig's fingertip, "
        "such as [1, 1.5]"
    )
    return tuple(_row(given, rule).tolist())


def as_points(positions: Positions, *, what: str) -> tuple[Point, ...]:
    """Positions for a question; what: the argument, for the InputError."""
    found = _numbers(positions)
    if found.size == 0:
        return ()
    if found.ndim > 2 or found.shape[-1:] != (2,):
        raise InputError(
            f"{what} must be x, y in metres from the corner SW, such as (0.08, 0.06), or a list of "
            f"these, got {positions!r}"
        )
    return tuple((float(x), float(y)) for x, y in found.reshape(-1, 2))


def as_pair(given: object, *, what: str, such_as: str) -> tuple[int, int]:
    """Two whole numbers, also of an array; raises InputError for anything else."""
    pair = tuple(given) if isinstance(given, Sequence | np.ndarray) else ()
    if len(pair) != 2 or not all(is_whole(count) for count in pair):
        raise InputError(f"{what} must be two whole numbers, {such_as}, got {shown(given)}")
    return int(pair[0]), int(pair[1])


def _row(given: object, rule: str) -> FloatArray:
    """A sequence of numbers as an array (n,); raises InputError, which says the rule."""
    found = _numbers(given)
    if found.ndim != 1:
        raise InputError(f"{rule}, got {shown(given)}")
    return found


def _numbers(given: Any) -> FloatArray:
    """Numbers as an array; of three dimensions, which no argument has, for anything else."""
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.full((1, 1, 1), np.nan)
