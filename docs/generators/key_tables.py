"""The tables of keys on documentation pages: unit, default, limits and meaning of each key."""

import re
from typing import Any, get_args

from pydantic.fields import FieldInfo

from model.config.sections import Quantity


def key_rows(page: str, heading: str) -> dict[str, list[str]]:
    """The table of keys under a heading of the second level: [unit, default, limits, meaning]."""
    (text,) = [
        section
        for section in re.split(r"^## ", page, flags=re.MULTILINE)
        if section.startswith(f"{heading}\n")
    ]
    table = text[text.index("| key |") :].split("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table]
    return {key.replace("`", ""): rest for key, *rest in cells}


def quantities(field: FieldInfo) -> list[Quantity]:
    """Every Quantity that a field's type carries, however deep."""

    def within(annotation: Any, metadata: Any = ()) -> list[Quantity]:
        found = [part for part in metadata if isinstance(part, Quantity)]
        for part in (*get_args(annotation), *getattr(annotation, "__metadata__", ())):
            found += [part] if isinstance(part, Quantity) else within(part)
        return found

    return within(field.annotation, field.metadata)


def bounds_in_words(asked: Quantity) -> str:
    """Every finite bound of a quantity, in the words of the error."""
    bounds = {
        "above": asked.above,
        "at least": asked.at_least,
        "at most": asked.at_most,
        "below": asked.below,
    }
    return ", ".join(f"{word} {b:g}" for word, b in bounds.items() if abs(b) != float("inf"))
