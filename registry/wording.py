"""Error messages of pydantic and typer in the wording of this project."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # slow to import
    from pydantic import ValidationError


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
"""Phrases of the libraries, and their replacements."""


def reworded(message: str) -> str:
    """Return a message of pydantic or typer in the wording of this project."""
    for phrase, replacement in _WORDS.items():
        message = message.replace(phrase, replacement)
    return message


def first_problem(error: "ValidationError") -> tuple[str, str]:
    """Return the location and the message of the first invalid value.

    The location is a path such as `plate.thickness`, or "" for the document as a whole.
    """
    problem = error.errors()[0]
    location = ".".join(str(key) for key in problem["loc"])
    return location, reworded(problem["msg"])
