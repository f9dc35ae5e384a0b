"""The tables of kinds of effects and of their keys in reference/effects.md, from the classes.

A kind's row is the first paragraph of its docstring.
"""

import inspect
from collections.abc import Callable, Mapping

from controller.effects.effect import Effect
from controller.effects.kinds import BUILT_IN_EFFECTS
from key_tables import HEAD, in_cell, rows_of


def kinds() -> str:
    """A row for each kind that is built in."""
    rows = [
        f"| `{each.kind}` | {_finger(each)} | {'yes' if each.needs_entry else ''} | "
        f"{in_cell(inspect.getdoc(each) or '')} |"
        for each in BUILT_IN_EFFECTS
    ]
    return "\n".join(["| kind | for | needs an entry | what is felt |", "|---|---|---|---|", *rows])


def keys() -> str:
    """A row for each key that a kind has by itself."""
    return "\n".join(
        [HEAD, *(row for each in BUILT_IN_EFFECTS for row in rows_of(each, above=Effect))]
    )


PARTS: Mapping[str, Callable[[], str]] = {"kinds": kinds, "keys": keys}


def _finger(kind: type[Effect]) -> str:
    """Whose effect it is."""
    moving = "a moving finger" if kind.is_for_motion else "any finger"
    return f"{moving} in a region" if kind.needs_region else moving
