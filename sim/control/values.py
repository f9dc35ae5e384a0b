"""Types of control operations, and checks of the values in their requests."""

import math
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias, TypeGuard

from model.errors import InputError
from sim.control.context import SimulationContext
from sim.plant.fingers import Position

Request: TypeAlias = dict[str, Any]
Response: TypeAlias = dict[str, Any]
Operation: TypeAlias = Callable[[SimulationContext, Request, float], Awaitable[Response]]
"""Executes a request at a time [s], or raises InputError and changes nothing."""


def parse_window(request: Request) -> tuple[float, float]:
    """The time window since_s to until_s [s]."""
    since = parse_number(request, "since_s", "seconds")
    until = parse_number(request, "until_s", "seconds")
    if since >= until:
        raise InputError(f"since_s must be less than until_s, got {since} and {until}")
    return since, until


def parse_number(given: Request, key: str, unit: str) -> float:
    """The finite number under a key; unit: for the error."""
    value = given.get(key)
    if not is_number(value):
        raise InputError(f"{key} must be a number of {unit}, got {str(value)[:40]!r}")
    return float(value)


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a JSON value is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # JSON allows integers of any length
        return False


def parse_finger(request: Request) -> str:
    """The id of a finger."""
    name = request.get("finger")
    if not isinstance(name, str) or not 0 < len(name) <= 40:
        raise InputError("finger must be an id of 1 to 40 characters")
    return name


def parse_position(given: object, *, what: str) -> Position:
    """A position [x, y] [m]; what: for the error."""
    if not (isinstance(given, list) and len(given) == 2 and all(map(is_number, given))):
        raise InputError(f"{what} must have a position [x, y] in metres")
    return float(given[0]), float(given[1])
