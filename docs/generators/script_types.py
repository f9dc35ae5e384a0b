"""The messages of the API for TypeScript, and the version of its package for npm."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from client_stub import registered
from controller.api.methods import TOPICS
from message_types import Models, Notation, each_model

_ROOT = Path(__file__).parents[2]
_HEAD = "// Written by docs/generators/script_types.py."
_EVENT = """/** An event notification of any topic. */
export type Event = {
  [T in Topic]: { topic: T; time_s: number; lost: number; data: Topics[T] };
}[Topic];

/** A method's parameters as arguments, optional if all parameters are optional. */
export type Arguments<M extends Method> = {} extends Methods[M]["params"]
  ? [params?: Methods[M]["params"]]
  : [params: Methods[M]["params"]];"""


def messages() -> str:
    """Return the file api.d.ts."""
    models: Models = {}
    methods = [
        *_interface("Methods", "Parameters and result of every method."),
        *(
            f"  /** {summary} */\n  {name}: {{ params: {_TYPES.type_of(method.params, models)}; "
            f"result: {_TYPES.type_of(method.result, models)} }};"
            for name, (method, summary) in registered().items()
        ),
        "}",
        "export type Method = keyof Methods;",
        *_interface("Topics", "The data of every topic of event notifications."),
        *(
            f"  /** {entry.summary} */\n  {topic}: {_TYPES.type_of(entry.data, models)};"
            for topic, entry in TOPICS.items()
        ),
        "}",
        "export type Topic = keyof Topics;",
    ]
    lines = [_HEAD, *methods, "", _EVENT]
    for name, model in each_model(models):
        lines += [*_interface(name, model.__doc__ or ""), *_fields(name, models), "}"]
    return "\n".join(lines) + "\n"


def with_version(package: str) -> str:
    """Return package.json with the version in pyproject.toml."""
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    return re.sub(r'("version": )"[^"]*"', rf'\1"{project["version"]}"', package)


def _interface(name: str, summary: str) -> Iterator[str]:
    yield f"\n/** {' '.join(summary.split())} */"
    yield f"export interface {name} {{"


def _fields(name: str, models: Models) -> Iterator[str]:
    descriptions = models[name].descriptions()
    for key, field in models[name].model_fields.items():
        if key in descriptions:
            yield f"  /** {descriptions[key]} */"
        optional = "" if field.is_required() else "?"
        yield f"  {key}{optional}: {_TYPES.type_of(field.rebuild_annotation(), models)};"


_TYPES = Notation(
    plain={
        str: "string",
        int: "number",
        float: "number",
        bool: "boolean",
        type(None): "null",
        Any: "unknown",
        object: "unknown",
    },
    union=" | ",
    literal='"{}"',
    literals=" | ",
    items=", ",
    array="Array<{}>",
    mapping="Record<string, {}>",
    model="{}".format,
)
