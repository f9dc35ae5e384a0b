"""The messages of the API for TypeScript, and the version of its package for npm."""

import re
import types
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from client_stub import registered
from controller.api.schema import Message
from controller.api.topics import TOPICS

_HEAD = "// Written by docs/generators/script_types.py."
_EVENT = """/** An event notification of any topic. */
export type Event = {
  [T in Topic]: { topic: T; time_s: number; lost: number; data: Topics[T] };
}[Topic];

/** A method's parameters as arguments: they may be left out where all of them may. */
export type Arguments<M extends Method> = {} extends Methods[M]["params"]
  ? [params?: Methods[M]["params"]]
  : [params: Methods[M]["params"]];"""


def messages() -> str:
    """The whole file api.d.ts."""
    models: dict[str, type[Message]] = {}
    methods = [
        *_interface("Methods", "Every method by name: its parameters and its result."),
        *(
            f"  /** {summary} */\n  {name}: {{ params: {_kind(method.params, models)}; "
            f"result: {_kind(method.result, models)} }};"
            for name, (method, summary) in registered().items()
        ),
        "}",
        "export type Method = keyof Methods;",
        *_interface("Topics", "The data of every topic of event notifications."),
        *(
            f"  /** {entry.summary} */\n  {topic}: {_kind(entry.data, models)};"
            for topic, entry in TOPICS.items()
        ),
        "}",
        "export type Topic = keyof Topics;",
    ]
    lines = [_HEAD, *methods, "", _EVENT]
    shown: set[str] = set()
    while left := [name for name in models if name not in shown]:
        for name in left:
            shown.add(name)
            lines += [*_interface(name, models[name].__doc__ or ""), *_fields(name, models), "}"]
    return "\n".join(lines) + "\n"


def with_version(package: str) -> str:
    """The file package.json with the version of the distribution."""
    return re.sub(r'("version": )"[^"]*"', rf'\1"{version("era-haptics")}"', package)


def _interface(name: str, summary: str) -> Iterator[str]:
    yield f"\n/** {' '.join(summary.split())} */"
    yield f"export interface {name} {{"


def _fields(name: str, models: dict[str, type[Message]]) -> Iterator[str]:
    for key, field in models[name].model_fields.items():
        if field.description:
            yield f"  /** {field.description} */"
        optional = "" if field.is_required() else "?"
        yield f"  {key}{optional}: {_kind(field.rebuild_annotation(), models)};"


def _kind(annotation: Any, models: dict[str, type[Message]]) -> str:
    """A type in TypeScript; collects the models that it is made of."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _kind(arguments[0], models)
    if origin in (Union, types.UnionType):
        return _joined(" | ", arguments, models)
    if origin is Literal:
        return " | ".join(f'"{argument}"' for argument in arguments)
    if origin is list:
        return f"Array<{_kind(arguments[0], models)}>"
    if origin is tuple:
        return f"[{_joined(', ', arguments, models)}]"
    if origin is dict:
        return f"Record<string, {_kind(arguments[1], models)}>"
    if isinstance(annotation, type) and issubclass(annotation, Message):
        models[annotation.__name__] = annotation
        return annotation.__name__
    return _PLAIN[annotation]


def _joined(sign: str, arguments: Iterable[Any], models: dict[str, type[Message]]) -> str:
    return sign.join(_kind(argument, models) for argument in arguments)


_PLAIN = {
    str: "string",
    int: "number",
    float: "number",
    bool: "boolean",
    type(None): "null",
    Any: "unknown",
    object: "unknown",
}
