"""Reword errors of pydantic and typer like all other errors."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # slow to import
    from pydantic import ValidationError


def reworded(message: str) -> str:
    """Reword a message of pydantic or typer like all other errors."""
    for theirs, ours in _WORDS.items():
        message = message.replace(theirs, ours)
    return message


def first_problem(error: "ValidationError") -> tuple[str, str]:
    """Return the position of the first invalid value, "" for the whole, and its error."""
    first = error.errors()[0]
    return ".".join(str(part) for part in first["loc"]), reworded(first["msg"])


_WORDS = {
    "Value error, ": "",
    "Field required": "missing",
    "Extra inputs are not permitted": "unknown key",
    "Input should be a valid string": "must be text",
    "Input should be ": "must be ",
    "String should have ": "must have ",
    "List should have ": "must have ",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "Choose from:\n\t": "Choose from ",
    ",\n\t": ", ",
}
