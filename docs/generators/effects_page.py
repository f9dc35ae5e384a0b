"""The tables of kinds of effects and of their keys in reference/effects.md, from the classes.

`python docs/generators/effects_page.py` rewrites them between the page's marks. A kind's row is the
first paragraph of its docstring; a key's meaning stands below it in the class.
"""

import ast
import inspect
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Any, Literal, get_args, get_origin

from controller.effects.effect import Effect, effect_kind, effect_kinds
from key_tables import bounds_in_words, quantities
from model.config.sections import Quantity
from model.config.units import COMMON_FACTORS


def kinds() -> str:
    """A row for each kind that is built in."""
    rows = [
        f"| `{each.kind}` | {_finger(each)} | {_sentence(inspect.getdoc(each) or '')} |"
        for each in _built_in()
    ]
    return "\n".join(["| kind | for | what is felt |", "|---|---|---|", *rows])


def keys() -> str:
    """A row for each key that a kind has by itself."""
    head = ["| key | unit | default | limits | meaning |", "|---|---|---|---|---|"]
    return "\n".join([*head, *(row for each in _built_in() for row in _rows(each))])


PARTS: Mapping[str, Callable[[], str]] = {"kinds": kinds, "keys": keys}


def _built_in() -> Iterator[type[Effect]]:
    """The kinds of the project itself: others may be installed."""
    every = (effect_kind(name) for name in effect_kinds())
    return (each for each in every if each.__module__.startswith("controller."))


def _finger(kind: type[Effect]) -> str:
    """Whose effect it is."""
    moving = "a moving finger" if kind.is_for_motion else "any finger"
    return f"{moving} in a region" if kind.needs_region else moving


def _rows(kind: type[Effect]) -> Iterator[str]:
    said = _docstrings(kind)
    for name, field in kind.model_fields.items():
        if name in Effect.model_fields:
            continue
        quantity = next(iter(quantities(field)), None)
        cells = (
            f"`{kind.kind}.{name}`",
            quantity.dimension.unit if quantity else "",
            _default(field.default, quantity),
            bounds_in_words(quantity) if quantity else _choices(field.annotation),
            said[name],
        )
        yield f"| {' | '.join(cells)} |".replace("|  |", "| |")


def _docstrings(of: type) -> dict[str, str]:
    """What stands below each field of a class, by its name."""
    (tree,) = ast.parse(dedent(inspect.getsource(of))).body
    body = tree.body if isinstance(tree, ast.ClassDef) else []
    return {
        field.target.id: _sentence(str(below.value.value))
        for field, below in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
    }


def _sentence(docstring: str) -> str:
    """The first paragraph within a cell of a table: one line, without capital and full stop."""
    text = " ".join(docstring.split("\n\n")[0].split()).removesuffix(".")
    return text[0].lower() + text[1:]


def _default(value: Any, quantity: Quantity | None) -> str:
    if value is None:
        return "none"
    if quantity is None:
        return f"`{str(value).lower()}`"
    units = COMMON_FACTORS[quantity.dimension.unit] if quantity.dimension.unit else {}
    forms = [f"{value:.7g}", *(f"{value / float(by):.7g} {unit}" for unit, by in units.items())]
    return min(forms, key=lambda form: (len(form.split()[0]), len(form)))


def _choices(annotation: Any) -> str:
    if get_origin(annotation) is not Literal:
        return ""
    return ", ".join(f"`{each}`" for each in get_args(annotation))


if __name__ == "__main__":
    from page_part import insert

    path = Path(__file__).parents[1] / "reference" / "effects.md"
    page = path.read_text("utf-8")
    for name, write in PARTS.items():
        page = insert(page, write(), writer=f"docs/generators/effects_page.py {name}")
    path.write_text(page, encoding="utf-8")
