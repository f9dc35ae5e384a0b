"""Values in the lines of control: taken out of their keys, or refused in words."""

import math
from typing import Any, TypeGuard

from model.errors import InputError
from sim.plant.finger import Position


def window_of(request: dict[str, Any]) -> tuple[float, float]:
    """The window of time that is asked for: since_s before until_s [s]."""
    since = number_of(request, "since_s", "seconds")
    until = number_of(request, "until_s", "seconds")
    if since >= until:
        raise InputError(f"since_s {since} must come before until_s {until}")
    return since, until


def number_of(told: dict[str, Any], key: str, unit: str) -> float:
    """The finite number under a key; unit: for the error."""
    value = told.get(key)
    if not is_number(value):
        raise InputError(f"{key} is {str(value)[:40]!r}; it must be a number of {unit}")
    return float(value)


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether it is a finite number; JSON has NaN and truth values, too."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # JSON allows integers of any length
        return False


def finger_of(request: dict[str, Any]) -> str:
    """The id of a finger."""
    name = request.get("finger")
    if not isinstance(name, str) or not 0 < len(name) <= 40:
        raise InputError("finger must be the finger's id, a short text")
    return name


def place_of(place: object, *, what: str) -> Position:
    """A place [x, y] [m]; what: whose, for the error."""
    if not (isinstance(place, list) and len(place) == 2 and all(is_number(p) for p in place)):
        raise InputError(f"{what} needs a position [x, y] in metres")
    return float(place[0]), float(place[1])
