"""What code hands over where no type checker looks: another kind of value is told in words."""

import os
from numbers import Integral, Real
from pathlib import Path

from model.errors import InputError

_LONGEST = 40


def expect(value: object, kind: type, *, what: str, made_by: str) -> None:
    """Raise InputError for a value of another kind; made_by: code that makes one."""
    if not isinstance(value, kind):
        raise InputError(f"{what} is {shown(value)}, not a {kind.__name__}; {made_by} makes one")


def expect_number(value: object, *, what: str, unit: str) -> None:
    """Raise InputError for what is no plain number."""
    if not isinstance(value, Real):
        raise InputError(f"{what} is {shown(value)}, not a number; give plain {unit}")


def is_whole(value: object) -> bool:
    """Whether it is a whole number, Python's or numpy's."""
    return isinstance(value, Integral)


def expect_path(value: object, *, what: str) -> Path:
    """The path that text or a path means; InputError for anything else."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{what} is {shown(value)}, not the name of a file; give text or a Path")
    return Path(value)


def shown(value: object) -> str:
    """Text and numbers as they are, anything else by its kind."""
    if value is None or isinstance(value, str | Real):
        text = repr(value)
        return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
    return f"a {type(value).__name__}"
