"""The error class of the model, and checks of arguments by callers without a type checker."""

import os
from numbers import Integral, Real
from pathlib import Path

from registry.streams import printable


class InputError(ValueError):
    """Invalid input; the message states the rule, the value, its location and the remedy.

    Control characters in quoted values are escaped.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(str(message)))


_MAX_LENGTH = 40


def expect_instance(value: object, cls: type, *, what: str, made_by: str) -> None:
    """Raise InputError for a value of another class; made_by: code that makes one."""
    if not isinstance(value, cls):
        raise InputError(
            f"{what} must be a {cls.__name__}, got {shown(value)}; make one with {made_by}"
        )


MAX_VALUE = 1e18
"""Of a physical quantity in SI units: a million times diamond's modulus of elasticity."""


def expect_number(value: object, *, what: str, unit: str) -> None:
    """Raise InputError for anything but a real number that a float holds."""
    if (isinstance(value, int) and abs(value) > MAX_VALUE) or not isinstance(value, Real):
        raise InputError(f"{what} must be a number of {unit}, got {shown(value)}")


def expect_between(value: float, low: float, high: float = MAX_VALUE, *, what: str) -> None:
    """Raise InputError for a value beyond these bounds, and for NaN."""
    if not low <= value <= high:
        raise InputError(f"{what} must be from {low:g} to {high:g}, got {value}")


def expect_values(
    of: object, what: str, *, above: str = "", at_least: str = "", finite: str = ""
) -> None:
    """Raise InputError for attributes beyond MAX_VALUE, negative ones, or 0 where above it.

    above, at_least, finite: names of attributes with spaces between.
    """
    for name in f"{above} {at_least} {finite}".split():
        value, is_above = getattr(of, name), name in above.split()
        least = -MAX_VALUE if name in finite.split() else 0.0
        expect_between(value, least, what=f"{what}: {name}")
        if is_above and value < 1 / MAX_VALUE:
            raise InputError(f"{what}: {name} must be above zero, got {value}")


def is_whole(value: object) -> bool:
    """Whether it is a whole number, Python's or numpy's."""
    return isinstance(value, Integral)


def expect_path(value: object, *, what: str) -> Path:
    """A path from text or a path; raises InputError for anything else."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{what} must be text or a Path, got {shown(value)}")
    return Path(value)


def shown(value: object) -> str:
    """Format text and numbers unchanged, other values as their class name."""
    if value is None or isinstance(value, str | Real):
        text = repr(value)
        return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]}..."
    return f"a {type(value).__name__}"
