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
    """Raise InputError for a value of another class; made_by: code that makes an instance."""
    if not isinstance(value, cls):
        raise InputError(
            f"{what} must be a {cls.__name__}, got {shown(value)}; make one with {made_by}"
        )


MAX_VALUE = 1e18
"""Largest physical quantity in SI units: a million times diamond's modulus of elasticity."""


def expect_number(value: object, *, what: str, unit: str) -> None:
    """Raise InputError for a value that is not a real number, or too large for a float."""
    if (isinstance(value, int) and abs(value) > MAX_VALUE) or not isinstance(value, Real):
        raise InputError(f"{what} must be a number of {unit}, got {shown(value)}")


def expect_between(value: float, low: float, high: float = MAX_VALUE, *, what: str) -> None:
    """Raise InputError for a value beyond these bounds, and for NaN."""
    if not low <= value <= high:
        raise InputError(f"{what} must be from {low:g} to {high:g}, got {value}")


def expect_values(
    record: object, what: str, *, above: str = "", at_least: str = "", finite: str = ""
) -> None:
    """Raise InputError for attributes of a record that are out of bounds.

    Names of attributes, separated by spaces. above: must be above 0; at_least: must be 0 or more;
    finite: can be negative. All have at most the magnitude MAX_VALUE.
    """
    for name in f"{above} {at_least} {finite}".split():
        value = getattr(record, name)
        low = -MAX_VALUE if name in finite.split() else 0.0
        expect_between(value, low, what=f"{what}: {name}")
        if name in above.split() and value < 1 / MAX_VALUE:
            raise InputError(f"{what}: {name} must be above zero, got {value}")


def is_whole(value: object) -> bool:
    """Return whether a value is an integer of Python or numpy."""
    return isinstance(value, Integral)


def expect_path(value: object, *, what: str) -> Path:
    """Return a path from text or a path; raises InputError for other values."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{what} must be text or a Path, got {shown(value)}")
    return Path(value)


def shown(value: object) -> str:
    """Format text and numbers unchanged, other values as their class name."""
    if value is None or isinstance(value, str | Real):
        text = repr(value)
        return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]}..."
    return f"a {type(value).__name__}"
