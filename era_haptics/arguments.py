"""Checks of arguments that several functions take."""

from collections.abc import Sequence

import numpy as np

from model.arguments import expect, is_whole, shown
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig


def expect_rig(value: object) -> None:
    """Raise InputError for anything but a rig, such as the name of its file."""
    expect(value, Rig, what="rig", made_by='era.load_rig("rig.yaml")')


def as_frequencies(given: object) -> FloatArray:
    """Frequencies (f,) [Hz] in the order given."""
    try:
        found = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        found = np.empty(())
    if found.ndim != 1:
        raise InputError(
            f"frequencies must be a sequence of numbers in hertz, such as range(60, 321, 10), got "
            f"{shown(given)}"
        )
    return found


def as_pair(given: object, *, what: str, such_as: str) -> tuple[int, int]:
    """Two whole numbers, also of an array; raises InputError for anything else."""
    pair = tuple(given) if isinstance(given, Sequence | np.ndarray) else ()
    if len(pair) != 2 or not all(is_whole(count) for count in pair):
        raise InputError(f"{what} must be two whole numbers, {such_as}, got {shown(given)}")
    return int(pair[0]), int(pair[1])
