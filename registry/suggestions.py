"""Which of the names that there are somebody meant."""

from collections.abc import Iterable

_NEAR = 0.65
"""So alike are two names of which one may be meant by the other; `unobtainium` is no aluminium."""


def did_you_mean(name: str, known: Iterable[str], *, ending: str = "") -> str:
    """`did you mean SW? ` for a name that is nearly a known one, in whatever case; else nothing.

    Also for one that is a word of known ones: glass of soda-lime-glass.

    ending: what stands behind a name where people write it; it makes no two of them more alike.
    """
    from difflib import get_close_matches  # not loaded for --help

    by_lower = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), by_lower, n=1, cutoff=_NEAR)
    close = close or [each for each in by_lower if name.lower() in each.split("-")]
    return (
        f"did you mean {' or '.join(by_lower[each] + ending for each in close)}? " if close else ""
    )
