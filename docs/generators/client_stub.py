"""Generated parts of `controller/api`: the client's methods, summaries and readings.

The summaries are the docstrings of the handlers in `controller/daemon/handlers.py`, a module that
clients and gateway do not load.
"""

import textwrap
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Union, get_args, get_origin

from controller.api.methods import BY_PLACE, METHODS, Method
from controller.api.schema import Empty, one_line
from controller.daemon.handlers import ApiService
from drivers.protocol.definition import READINGS

_WIDTH = 100  # of a line, as in the configuration of ruff
_BY_HAND = ("touch", "play", "subscribe", "unsubscribe")
"""Hand-written methods of `AsyncClient`, whose arguments differ from the parameters."""

_CONSTANTS = ("DEFAULT_LEASE", "METHODS", "SILENCING")
"""Names that client.py imports from methods.py in addition to result classes."""


def registered() -> dict[str, tuple[Method, str]]:
    """Return all methods by name, with the handler's docstring on one line."""
    methods = {}
    for name, method in METHODS.items():
        docstring = getattr(ApiService, name).__doc__ or ""
        methods[name] = method, one_line(docstring)
    return methods


def summaries() -> str:
    """Return the file summaries.py."""
    lines = [
        "# Written by docs/generators/client_stub.py.",
        "# ruff: noqa: E501",
        '"""Summaries of all API methods, for the reference, OpenAPI and the help of `era`.',
        "",
        "Apart from the messages, whose import would double the time of help.",
        '"""',
        "",
        "SUMMARIES = {",
        *(f'    "{name}": "{summary}",' for name, (_, summary) in registered().items()),
        "}",
    ]
    return "\n".join(lines) + "\n"


def _readings() -> str:
    """Return the fields of an amplifier's status that are readings, for schema.py."""
    lines = []
    for reading in READINGS:
        default = " = None" if reading.is_added else ""
        meaning = reading.meaning
        if reading.is_added:
            meaning += "; null where the amplifier does not state it"
        lines.append(f"    {reading.key}: float | None{default}")
        lines += textwrap.wrap(
            f'"""{meaning}"""', _WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 4
        )
    return "\n".join(lines)


def _results() -> str:
    """Return the import statement of client.py for methods.py."""
    classes = {method.result.__name__ for method in METHODS.values()} - {"Empty"}
    names = [*_CONSTANTS, *sorted(classes)]
    lines = ["from controller.api.methods import (", *(f"    {name}," for name in names), ")"]
    return "\n".join(lines)


def _methods() -> str:
    """Return the methods of `AsyncClient` that send a single request."""
    return "\n\n".join(
        "\n".join(_method(name, method, summary))
        for name, (method, summary) in registered().items()
        if name not in _BY_HAND
    )


def _method(name: str, method: Method, summary: str) -> Iterator[str]:
    parameters = [*_parameters(method)]
    result = "None" if method.result is Empty else method.result.__name__
    given = [part.partition(":")[0] for part in parameters if part != "*"]
    head = f"    async def {name}({', '.join(['self', *parameters])}) -> {result}:"
    if len(head) > _WIDTH:
        head = head.replace("(", "(\n        ").replace(") ->", "\n    ) ->")
    if method.silences:
        yield "    @lenient"
    yield head
    first, dot, rest = summary.partition(". ")
    wrapped = textwrap.wrap(rest, _WIDTH - 8)
    yield from _docstring([first + dot.strip(), *([""] if wrapped else []), *wrapped])
    call = ", ".join([method.result.__name__, f'"{name}"', *(f"{key}={key}" for key in given)])
    yield f"        {'' if method.result is Empty else 'return '}await self._call({call})"


def _docstring(lines: list[str]) -> Iterator[str]:
    quotes = '"""'
    lines = [quotes + lines[0], *lines[1:]]
    if len(lines) == 1:
        lines[0] += quotes
    else:
        lines.append(quotes)
    yield from (f"        {line}".rstrip() for line in lines)


def _parameters(method: Method) -> Iterator[str]:
    """Yield the parameters; optional ones can only be given by name, unless marked otherwise."""
    fields = sorted(method.params.model_fields.items(), key=lambda item: not item[1].is_required())
    is_by_place = True
    for name, field in fields:
        if is_by_place and not field.is_required() and BY_PLACE not in field.metadata:
            is_by_place = False
            yield "*"
        default = "" if field.is_required() else f" = {field.default!r}"
        yield f"{name}: {_kind(field.annotation)}{default}"


def _kind(annotation: Any) -> str:
    """Return a type as Python code."""
    if get_origin(annotation) is Annotated:
        return _kind(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return " | ".join(map(_kind, get_args(annotation)))
    return "None" if annotation is type(None) else str(annotation.__name__)


def _blocking() -> str:
    """Return the methods of `Client`."""
    return "\n".join(f"    {name} = _blocking(AsyncClient.{name})" for name in registered())


PARTS: Mapping[str, Mapping[str, Callable[[], str]]] = {
    "schema": {"readings": _readings},
    "client": {"results": _results, "methods": _methods, "blocking": _blocking},
}
"""Writers of the generated parts of `controller/api`, by module and part name."""
