"""Suggestions for mistyped names."""

import re
from collections.abc import Iterable

_NEAR = 0.65
"""Least similarity of a suggestion; `unobtainium` is not similar to `aluminium`."""


def did_you_mean(name: str, known: Iterable[str], *, ending: str = "") -> str:
    """Return `did you mean SW? ` for a name similar to a known one, ignoring case, else "".

    Also for a word of known names: glass of soda-lime-glass, level of level_db_sl. ending: appended
    to suggestions.
    """
    from difflib import get_close_matches  # not loaded for --help

    by_lower = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), by_lower, n=1, cutoff=_NEAR)
    close = close or [each for each in by_lower if name.lower() in re.split("[-_]", each)]
    return (
        f"did you mean {' or '.join(by_lower[each] + ending for each in close)}? " if close else ""
    )
