"""The reference part of reference/api.md: methods, topics, types and errors of the API.

`python docs/generators/api_page.py` rewrites it between the page's two marks.
"""

import types
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from controller.api.jsonrpc import ERROR_MEANINGS
from controller.api.methods import METHODS
from controller.api.schema import Message
from controller.api.topics import TOPICS, EventParams
from page_part import insert

WRITER = "docs/generators/api_page.py"
PAGE = Path(__file__).parents[1] / "reference" / "api.md"


def reference() -> str:
    """All tables, as Markdown."""
    models: dict[str, type[Message]] = {}
    lines = ["### Methods", ""]
    for name, method in METHODS.items():
        lines += [f"#### {name}", "", f"{_sentence(method.summary)}", ""]
        lines += [*_table("parameter", method.params, models), ""]
        lines += [*_table("result", method.result, models), ""]
    lines += ["### Topics", "", "The parameters of every `event` notification:", ""]
    lines += [*_table("parameter", EventParams, models), ""]
    for topic, entry in TOPICS.items():
        lines += [f"#### topic {topic}", "", f"{_sentence(entry.summary)}", ""]
        lines += [*_table("data", entry.data, models), ""]
    lines += ["### Types", ""]
    shown: set[str] = set()
    while left := [name for name in models if name not in shown]:
        for name in left:
            shown.add(name)
            lines += [f"#### {name}", "", _summary(models[name]), ""]
            lines += [*_table("key", models[name], models), ""]
    lines += ["### Errors", "", "| code | name | meaning |", "|---|---|---|"]
    lines += [
        f"| {code.value} | {code.name} | {meaning} |" for code, meaning in ERROR_MEANINGS.items()
    ]
    return "\n".join(lines) + "\n"


def _table(head: str, model: type[Message], models: dict[str, type[Message]]) -> Iterator[str]:
    """One row per field; collects the models that fields are made of."""
    if not model.model_fields:
        yield f"*{head}:* an empty object, `{{}}`"
        return
    yield f"| {head} | type | |"
    yield "|---|---|---|"
    for name, field in model.model_fields.items():
        kind = _kind(field.rebuild_annotation(), models)
        optional = "" if field.is_required() else "optional"
        notes = "; ".join(part for part in (field.description, optional) if part)
        yield f"| `{name}` | {kind} | {notes} |"


def _kind(annotation: Any, models: dict[str, type[Message]]) -> str:
    """A type in words."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        bounds = ", ".join(_bounds(arguments[1:]))
        return _kind(arguments[0], models) + (f" {bounds}" if bounds else "")
    if origin in (Union, types.UnionType):
        return " or ".join(_kind(argument, models) for argument in arguments)
    if origin is Literal:
        return ", ".join(f"`{argument}`" for argument in arguments)
    if origin is list:
        return f"list of {_kind(arguments[0], models)}"
    if origin is tuple:
        return f"[{', '.join(_kind(argument, models) for argument in arguments)}]"
    if origin is dict:
        return f"object with values: {_kind(arguments[1], models)}"
    if isinstance(annotation, type) and issubclass(annotation, Message):
        models[annotation.__name__] = annotation
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    return _PLAIN[annotation]


_PLAIN = {
    str: "text",
    int: "whole number",
    float: "number",
    bool: "true or false",
    type(None): "null",
    Any: "anything",
    object: "anything",
}

_SIGNS = {
    "ge": "at least {}",
    "gt": "above {}",
    "le": "at most {}",
    "lt": "below {}",
    "min_length": "of at least {}",
    "max_length": "of at most {}",
}


def _bounds(metadata: Iterable[object]) -> Iterator[str]:
    for part in metadata:
        for bound in getattr(part, "metadata", [part]):
            for sign, words in _SIGNS.items():
                value = getattr(bound, sign, None)
                if value is not None:
                    yield words.format(f"{value:g}" if isinstance(value, float) else value)


def _summary(model: type[Message]) -> str:
    return " ".join((model.__doc__ or "").split())


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


if __name__ == "__main__":
    PAGE.write_text(insert(PAGE.read_text("utf-8"), reference(), writer=WRITER), encoding="utf-8")
