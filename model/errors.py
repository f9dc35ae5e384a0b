"""The one error the model raises on purpose, and the words of all errors."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # a command that checks nothing does not wait for it
    from pydantic import ValidationError


class InputError(ValueError):
    """Input that cannot be used; the message says what, where and what to do about it."""


def in_our_words(message: str) -> str:
    """What the libraries that check values say of one, in the words of all other errors."""
    for theirs, ours in _WORDS.items():
        message = message.replace(theirs, ours)
    return message


def first_problem(error: "ValidationError") -> tuple[str, str]:
    """Where the first of the values is that were refused, "" for the whole; and what is wrong."""
    first = error.errors()[0]
    return ".".join(str(part) for part in first["loc"]), in_our_words(first["msg"])


_WORDS = {
    "Value error, ": "",
    "Field required": "is missing",
    "Extra inputs are not permitted": "is unknown",
    "Input should be a valid string": "must be a text",
    "Input should be ": "must be ",
    "String should have ": "must have ",
    "List should have ": "must have ",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "Choose from:\n\t": "Choose from ",
    ",\n\t": ", ",
}
