"""Checks of arguments that several functions take: positions of fingers, loads, frequencies."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias, cast

import numpy as np

from model.answer.stimulus import Finger
from model.arrays import FloatArray, Point
from model.errors import InputError, expect, expect_number, is_whole, shown
from model.rig.rig import Rig

Positions: TypeAlias = Sequence[float] | Sequence[Sequence[float]]
"""One position x, y [m], or several; also an array of shape (2,) or (n, 2)."""

Fingers: TypeAlias = Positions | Sequence[Finger]
"""Positions [m] of fingers, or fingers with their loads and bounds."""


MAX_LEVEL = 1 + 1e-9
"""Full stroke, with the rounding of weights that were divided by the largest."""


def expect_rig(value: object) -> None:
    """Raise InputError for anything but a rig, such as the name of its file."""
    expect(value, Rig, what="rig", made_by='era.load_rig("rig.yaml")')


def as_frequencies(given: object) -> FloatArray:
    """Frequencies (f,) [Hz] in the order given, one at least."""
    rule = "frequencies must be a sequence of numbers in hertz, such as range(60, 321, 10)"
    return _row(given, rule, least=1)


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


def as_fingers(given: object, *, what: str) -> tuple[Finger, ...]:
    """Fingers, of positions as such without a stimulus; what: the argument, for the InputError."""
    if isinstance(given, Sequence) and any(isinstance(each, Finger) for each in given):
        return tuple(
            each if isinstance(each, Finger) else Finger(cast(Point, each)) for each in given
        )
    return tuple(map(Finger, as_points(cast(Positions, given), what=what)))


def as_signals(given: object, rig: Rig, sample_rate: object) -> FloatArray:
    """Signals of all ERAs (eras, n) in full strokes; raises InputError for what no ERA plays."""
    expect_number(sample_rate, what="sample_rate", unit="hertz")
    least = 2 * rig.limits.frequency_max
    if not least < cast(float, sample_rate) < math.inf:
        raise InputError(
            f"sample_rate must be above {least:g} Hz, twice the rig's highest frequency, got "
            f"{sample_rate} Hz"
        )
    found = _numbers(given)
    if found.ndim != 2 or len(found) != len(rig.eras) or not found.size:
        got = f"shape {np.shape(given)}" if isinstance(given, np.ndarray) else shown(given)
        raise InputError(
            f"signals must be real numbers ({len(rig.eras)}, samples), a row for each ERA, "
            f"{', '.join(each.name for each in rig.eras)}, got {got}"
        )
    beyond = np.argwhere(~(np.abs(found) <= MAX_LEVEL))  # NaN, too
    if len(beyond):
        row, sample = beyond[0].tolist()
        raise InputError(
            f"signals must be within full stroke, -1 to 1, got {found[row, sample]} of "
            f"{rig.eras[row].name} at sample {sample}"
        )
    return np.clip(found, -1, 1)


def as_pair(given: object, *, what: str, such_as: str) -> tuple[int, int]:
    """Two whole numbers, also of an array; raises InputError for anything else."""
    pair = tuple(given) if isinstance(given, Sequence | np.ndarray) else ()
    if len(pair) != 2 or not all(is_whole(count) for count in pair):
        raise InputError(f"{what} must be two whole numbers, {such_as}, got {shown(given)}")
    return int(pair[0]), int(pair[1])


def _row(given: object, rule: str, *, least: int = 0) -> FloatArray:
    """A sequence of numbers as an array (n,); raises InputError, which says the rule."""
    found = _numbers(given)
    if found.ndim != 1 or len(found) < least:
        raise InputError(f"{rule}, got {shown(given)}")
    return found


def _numbers(given: Any) -> FloatArray:
    """Numbers as an array; of three dimensions, which no argument has, for anything else."""
    try:
        if np.iscomplexobj(given):
            raise TypeError
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.full((1, 1, 1), np.nan)
