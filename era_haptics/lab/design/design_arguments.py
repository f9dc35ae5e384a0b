"""Checks of the arguments of a design."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from model.errors import (
    MAX_VALUE,
    InputError,
    expect_between,
    expect_number,
    is_whole,
    shown,
)
from model.rig.rig import Rig
from model.structure.statics import MIN_RIGID_BODY_FREQUENCY

MAX_STIFFNESSES = 9
MAX_ERAS = 32


def expect_whole_numbers(numbers: Mapping[str, tuple[Any, int]], counts: Sequence[Any]) -> None:
    """Raise InputError unless numbers of ERAs, and others with a minimum, are whole numbers."""
    for count in (*counts, len(counts)):
        _expect_whole_number("eras", count, 1, MAX_ERAS)
    for name, (value, minimum) in numbers.items():
        _expect_whole_number(name, value, minimum, MAX_VALUE)


def _expect_whole_number(name: str, value: Any, minimum: int, maximum: float) -> None:
    if not is_whole(value):
        raise InputError(f"{name} must be a whole number, got {shown(value)}")
    expect_between(value, minimum, maximum, what=name)


def expect_real_numbers(apart: float, lowest: float, stiffness: Sequence[float]) -> None:
    """Raise InputError unless lengths, frequencies and stiffnesses are numbers."""
    expect_number(apart, what="apart", unit="metres")
    expect_number(lowest, what="lowest", unit="hertz")
    for value in stiffness:
        expect_number(value, what="stiffness", unit="newtons per meter")
    expect_between(lowest, MIN_RIGID_BODY_FREQUENCY, what="lowest")


def expect_kept(rig: Rig, keep: Sequence[str], max_count: int) -> None:
    """Raise InputError unless kept ERAs are different ERAs of the rig."""
    names = [era.name for era in rig.eras]
    unknown = [name for name in keep if name not in names]
    repeated = [name for name in keep if keep.count(name) > 1]
    if unknown or repeated or len(keep) > max_count:
        raise InputError(
            f"keep must be up to {max_count} different ERAs of the rig, {', '.join(names)}, got "
            f"{', '.join(map(str, keep))}"
        )


def checked_stiffnesses(stiffness: Sequence[float]) -> list[float | None]:
    """Return stiffnesses, ascending; raises InputError for values that repeat or are not above
    0."""
    positive = [float(value) for value in stiffness if 0 < value < math.inf]
    values = sorted(set(positive))
    if len(values) < len(stiffness) or len(values) > MAX_STIFFNESSES:
        given = ", ".join(f"{value:g}" for value in stiffness)
        raise InputError(
            f"stiffness must be at most {MAX_STIFFNESSES} different values above 0 N/m, got {given}"
        )
    return [*values]
