"""Which of the names that there are somebody meant."""

from collections.abc import Iterable

_NEAR = 0.65
"""So alike are two names of which one may be meant by the other; `unobtainium` is no aluminium."""


def did_you_mean(name: str, known: Iterable[str], *, ending: str = "") -> str:
    """`did you mean SW? ` for a name that is nearly a known one, in whatever case; else nothing.

    ending: what stands behind a name where people write it; it makes no two of them more alike.
    """
    from difflib import get_close_matches  # not loaded for --help

    by_lower = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), by_lower, n=1, cutoff=_NEAR)
    return f"did you mean {by_lower[close[0]]}{ending}? " if close else ""
