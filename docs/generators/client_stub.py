"""Parts of `controller/api` that follow from where methods are handled and readings are defined.

Methods are registered in `controller/daemon/handlers.py`, which clients and gateway do not load.
"""

import textwrap
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Union, get_args, get_origin

from controller.api.methods import BY_PLACE, Method
from controller.api.schema import Empty
from controller.daemon.handlers import ApiService
from drivers.protocol.definition import READINGS

_WIDTH = 100  # of a line, as ruff has it
_BY_HAND = ("touch", "play", "subscribe", "unsubscribe")
"""Methods of `AsyncClient` that put parameters together from positions and names of topics."""


def registered() -> dict[str, tuple[Method, str]]:
    """The methods that the daemon handles, by name, with what each does."""
    return {
        name: (handler.method, " ".join((handler.__doc__ or "").split()))
        for name, handler in vars(ApiService).items()
        if hasattr(handler, "method")
    }


def _table() -> str:
    """The table of all methods, in methods.py."""
    rows = [f'    "{name}": {_call(method)},' for name, (method, _) in registered().items()]
    return "\n".join(["METHODS: dict[str, Method] = {", *rows, "}", '"""Every method, by name."""'])


def _call(method: Method) -> str:
    """A registration as Python."""
    changed = [
        f"{key}={value}"
        for key, default in Method._field_defaults.items()
        if (value := getattr(method, key)) != default
    ]
    return f"Method({', '.join([method.params.__name__, method.result.__name__, *changed])})"


def summaries() -> str:
    """The whole file summaries.py."""
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
    """The fields of an amplifier's status that are readings of the protocol, in schema.py."""
    lines = []
    for each in READINGS:
        default = "None, " if each.is_added else ""
        meaning = each.meaning + "; null where the amplifier does not state it" * each.is_added
        line = f'    {each.key}: float | None = Field({default}description="{meaning}")'
        if len(line) > _WIDTH:
            line = line.replace("Field(", "Field(\n        ")[:-1] + "\n    )"
        lines.append(line)
    return "\n".join(lines)


def _methods() -> str:
    """The methods of `AsyncClient` that are one request each."""
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
    """The parameters: required and marked ones by position or name, all others by name alone."""
    fields = sorted(method.params.model_fields.items(), key=lambda item: not item[1].is_required())
    is_by_place = True
    for name, field in fields:
        if is_by_place and not field.is_required() and BY_PLACE not in field.metadata:
            is_by_place = False
            yield "*"
        default = "" if field.is_required() else f" = {field.default!r}"
        yield f"{name}: {_kind(field.annotation)}{default}"


def _kind(annotation: Any) -> str:
    """A type as Python."""
    if get_origin(annotation) is Annotated:
        return _kind(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return " | ".join(map(_kind, get_args(annotation)))
    return "None" if annotation is type(None) else str(annotation.__name__)


def _blocking() -> str:
    """The methods of `Client`."""
    return "\n".join(f"    {name} = _blocking(AsyncClient.{name})" for name in registered())


PARTS: Mapping[str, Mapping[str, Callable[[], str]]] = {
    "methods": {"table": _table},
    "schema": {"readings": _readings},
    "client": {"methods": _methods, "blocking": _blocking},
}
"""The writers of a module of `controller/api`, by module and name of the part."""
