"""Checks of arguments that several functions take."""

import numpy as np

from model.arguments import expect, shown
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
