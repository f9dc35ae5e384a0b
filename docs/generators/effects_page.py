"""The tables of effect kinds and their keys in docs/reference/effects.md, from the classes.

The first paragraph of a kind's docstring describes it.
"""

import inspect
from collections.abc import Callable, Mapping

from controller.effects.effect import Effect
from controller.effects.kinds import BUILT_IN_EFFECTS
from key_tables import HEAD, in_cell, rows_of


def kinds() -> str:
    """Return a row for each built-in kind."""
    rows = [
        f"| `{each.kind}` | {_finger(each)} | {'yes' if each.needs_entry else ''} | "
        f"{in_cell(inspect.getdoc(each) or '')} |"
        for each in BUILT_IN_EFFECTS
    ]
    return "\n".join(["| kind | for | needs an entry | sensation |", "|---|---|---|---|", *rows])


def keys() -> str:
    """Return a row for each key that belongs to a single kind."""
    return "\n".join(
        [HEAD, *(row for each in BUILT_IN_EFFECTS for row in rows_of(each, above=Effect))]
    )


PARTS: Mapping[str, Callable[[], str]] = {"kinds": kinds, "keys": keys}


def _finger(kind: type[Effect]) -> str:
    """Return the fingers that feel a kind of effect."""
    moving = "a moving finger" if kind.is_for_motion else "any finger"
    return f"{moving} in a region" if kind.needs_region else moving
