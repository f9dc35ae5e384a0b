"""Tables of a configuration file's keys: unit, default, limits and meaning.

The docstring below a field of the section is its meaning. A paragraph that begins with `Default:`
or `Limits:` replaces the value derived from the type.
"""

import ast
import inspect
import re
from collections.abc import Iterator
from enum import Enum
from itertools import pairwise
from textwrap import dedent
from types import NoneType
from typing import Literal, get_args, get_origin

from annotated_types import Ge, Le, MaxLen, MinLen
from pydantic.fields import FieldInfo

from model.config.fields import Quantity, Section, quantities

HEAD = "| key | unit | default | limits | meaning |\n|---|---|---|---|---|"


def key_rows(page: str, heading: str) -> dict[str, list[str]]:
    """Return the table below a second-level heading: [unit, default, limits, meaning] by key."""
    (text,) = [
        section
        for section in re.split(r"^## ", page, flags=re.MULTILINE)
        if section.startswith(f"{heading}\n")
    ]
    table = text[text.index("| key |") :].split("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table]
    return {key.replace("`", ""): rest for key, *rest in cells}


def key_table(section: type[Section]) -> str:
    """Return the table of all keys of a section."""
    return "\n".join([HEAD, *rows_of(section)])


def rows_of(section: type[Section], *, above: type[Section] = Section) -> Iterator[str]:
    """Yield a row for each key of a section that its parent section `above` lacks, in order.

    If it has a parent, keys begin with the section's name, such as `click.duration`.
    """
    prefix = "" if above is Section else f"{section.__name__.lower()}."
    said = _docstrings(section)
    for name, field in section.model_fields.items():
        if name in above.model_fields:
            continue
        meaning, *further = said[name].split("\n\n")
        stated = dict(" ".join(each.split()).split(": ", 1) for each in further)
        quantity = next(iter(quantities(field)), None)
        cells = (
            f"`{prefix}{name}`",
            quantity.dimension.unit if quantity else "",
            stated.get("Default") or _default(field, quantity),
            stated.get("Limits") or (bounds_in_words(quantity) if quantity else _limits(field)),
            in_cell(meaning),
        )
        yield re.sub(r"\|(  )+", "| ", f"| {' | '.join(cells)} |")


def in_cell(docstring: str) -> str:
    """Return the first paragraph as a cell: no final period, lower case unless it is a name."""
    text = " ".join(docstring.split("\n\n")[0].split()).removesuffix(".")
    first = text.split(" ")[0]
    return text[0].lower() + text[1:] if first.istitle() and "'" not in first else text


def bounds_in_words(asked: Quantity) -> str:
    """Return all finite bounds of a quantity, worded like the error message."""
    bounds = {
        "above": asked.above,
        "at least": asked.at_least,
        "at most": asked.at_most,
        "below": asked.below,
    }
    return ", ".join(f"{word} {b:g}" for word, b in bounds.items() if abs(b) != float("inf"))


def _docstrings(of: type) -> dict[str, str]:
    """Return the docstring of each field of a class and its parent sections, by name."""
    classes = [each for each in reversed(of.__mro__) if each is of or issubclass(each, Section)]
    found = dict[str, str]()
    for each in classes:
        (tree,) = ast.parse(dedent(inspect.getsource(each))).body
        found |= {
            field.target.id: inspect.cleandoc(str(below.value.value))
            for field, below in pairwise(tree.body if isinstance(tree, ast.ClassDef) else [])
            if isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
        }
    return found


def _default(field: FieldInfo, quantity: Quantity | None) -> str:
    value = field.get_default(call_default_factory=True)
    if field.is_required():
        return "required"
    if value is None or value in ({}, []):
        return "none"
    if isinstance(value, Section):
        return "see there"
    if isinstance(value, tuple):
        return f"`[{', '.join(f'{each:g}' for each in value)}]`"
    if quantity is None:
        return f"`{str(value).lower()}`"
    units = quantity.dimension.factors if quantity.dimension.unit else {}
    forms = [f"{value:.7g}", *(f"{value / float(by):.7g} {unit}" for unit, by in units.items())]
    return min(forms, key=lambda form: (len(form.split()[0]), len(form)))


def _limits(field: FieldInfo) -> str:
    """Return the choices, the range of an integer, or the allowed number of entries."""
    kind, bounds = field.annotation, field.metadata
    parts = get_args(kind)
    if parts and parts[-1] is NoneType:  # the key is optional
        kind = parts[0] if get_origin(parts[0]) is Literal else (get_args(parts[0]) or parts)[0]
        annotations = getattr(parts[0], "__metadata__", ())
        bounds = [own for each in annotations for own in getattr(each, "metadata", (each,))]
    if get_origin(kind) is Literal:
        return ", ".join(f"`{each}`" for each in get_args(kind))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return ", ".join(f"`{each.value}`" for each in kind)
    least = next(
        (
            str(b.ge if isinstance(b, Ge) else b.min_length)
            for b in bounds
            if isinstance(b, Ge | MinLen)
        ),
        "",
    )
    most = next(
        (
            str(b.le if isinstance(b, Le) else b.max_length)
            for b in bounds
            if isinstance(b, Le | MaxLen)
        ),
        "",
    )
    if least and most:
        return f"{least} to {most}"
    return f"{least} or more" if least else f"up to {most}" if most else ""
