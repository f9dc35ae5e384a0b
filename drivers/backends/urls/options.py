"""The options of an amplifier URL: the name=value pairs after its question mark."""

from collections.abc import Collection
from urllib.parse import parse_qsl

from drivers.errors import CommandError

_DIGITS_MAX = 9  # more are out of any range, and a number of thousands is no int to Python


def options_of(query: str, *, known: Collection[str], url: str, kind: str) -> dict[str, str]:
    """The options by name; CommandError for one that is not known, or given twice.

    kind: of URL, with its article, for the message.
    """
    pairs = parse_qsl(query, keep_blank_values=True)
    options = dict(pairs)
    unknown = sorted(options.keys() - set(known))
    if unknown:
        raise CommandError(
            f"{url!r}: unknown option {', '.join(unknown)}; {kind} URL has "
            f"{', '.join(known) or 'no options'}"
        )
    if len(pairs) > len(options):
        raise CommandError(f"{url!r}: an option is given twice; give each once, at most")
    return options


def whole_number(text: str, name: str, *, low: int = 1, high: int, url: str) -> int:
    """A whole number within a range; CommandError names it."""
    is_number = text.isascii() and text.isdigit() and len(text) <= _DIGITS_MAX
    if not (is_number and low <= int(text) <= high):
        raise CommandError(
            f"{url!r}: {name} is {text!r}; it must be a whole number from {low} to {high}"
        )
    return int(text)
