"""The one error the model raises on purpose, and what helps whoever has mistyped a name."""

from collections.abc import Iterable


class InputError(ValueError):
    """Input that cannot be used; the message says what, where and what to do about it."""


_NEAR = 0.65
"""So alike are two names of which one may be meant by the other; `unobtainium` is no aluminium."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`did you mean SW? ` for a name that is nearly a known one, in whatever case; else nothing."""
    from difflib import get_close_matches  # not loaded for --help

    by_lower = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), by_lower, n=1, cutoff=_NEAR)
    return f"did you mean {by_lower[close[0]]}? " if close else ""


def in_our_words(message: str) -> str:
    """What the libraries that check values say of one, in the words of all other errors."""
    for theirs, ours in _WORDS.items():
        message = message.replace(theirs, ours)
    return message


_WORDS = {
    "Value error, ": "",
    "Field required": "is missing",
    "Extra inputs are not permitted": "is unknown",
    "Input should be ": "must be ",
    "String should have ": "must have ",
    "List should have ": "must have ",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
}
