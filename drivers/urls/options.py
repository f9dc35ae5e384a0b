"""Options of an amplifier URL: the name=value pairs after its question mark."""

import re
from collections.abc import Collection
from urllib.parse import SplitResult, parse_qsl, urlsplit

from drivers.errors import CommandError

_DIGITS_MAX = 9  # more are out of every range, and int() refuses thousands of them


def split_url(url: str, *, kind: str, forms: str, has_port: bool = True) -> SplitResult:
    """Split a URL; CommandError for an invalid one or, if it may have a port, an invalid port.

    kind: of the URL, with its article; forms: valid ones, for the message.
    """
    try:
        parts = urlsplit(url)
        _ = has_port and parts.port
    except ValueError as error:
        raise CommandError(f"{url!r} must be {kind} URL: {error}; use {forms}") from None
    return parts


def options_of(query: str, *, known: Collection[str], url: str, kind: str) -> dict[str, str]:
    """Return the options by name; CommandError for an unknown or repeated one.

    kind: of the URL, with its article, for the message.
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
        raise CommandError(f"{url!r}: option must not be repeated")
    return options


def whole_number(text: str, name: str, *, low: int = 1, high: int, url: str) -> int:
    """Parse an integer within a range; CommandError names it."""
    is_number = text.isascii() and text.isdigit() and len(text) <= _DIGITS_MAX
    if not (is_number and low <= int(text) <= high):
        raise CommandError(f"{url!r}: {name} must be an integer of {low} to {high}, got {text!r}")
    return int(text)


def device_of(path: str) -> str:
    """Return the device of a URL's path: /dev/ttyUSB0, or COM3 of /COM3."""
    return path[1:] if re.fullmatch(r"/COM\d+", path, re.IGNORECASE) else path
