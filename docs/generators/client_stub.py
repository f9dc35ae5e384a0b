"""What clients and gateway have of the methods of the API, from where these are handled.

Also the readings of amplifiers in their status.
"""

import inspect
import types
from collections.abc import Iterator
from typing import Annotated, Any, Union, get_args, get_origin

from controller.api.calls import BY_HAND, signature_of
from controller.api.methods import Method
from controller.api.schema import Empty
from controller.daemon.methods import ApiService
from drivers.protocol.definition import READINGS

_HEAD = "# Written by docs/generators/client_stub.py."
_WIDTH = 100  # of a line, as ruff has it


def registered() -> dict[str, tuple[Method, str]]:
    """The methods that the daemon handles, by name, with what each does."""
    return {
        name: (handler.method, " ".join((handler.__doc__ or "").split()))
        for name, handler in vars(ApiService).items()
        if hasattr(handler, "method")
    }


def table() -> str:
    """The whole file registered.py."""
    methods = {name: method for name, (method, _) in registered().items()}
    kinds = {kind for each in methods.values() for kind in (each.params, each.result)} - {Empty}
    lines = [
        _HEAD,
        '"""Every method of the API, by name, and those that end what plays."""',
        "",
        *_import("controller.api.methods", "Method", *(each.__name__ for each in kinds)),
        "from controller.api.schema import Empty",
        "",
        "METHODS: dict[str, Method] = {",
        *(f'    "{name}": {_call(method)},' for name, method in methods.items()),
        "}",
        "SILENCING = frozenset(name for name, method in METHODS.items() if method.silences)",
    ]
    return "\n".join(lines) + "\n"


def _call(method: Method) -> str:
    """A registration as Python."""
    changed = [
        f"{key}={value}"
        for key, default in Method._field_defaults.items()
        if (value := getattr(method, key)) != default
    ]
    return f"Method({', '.join([method.params.__name__, method.result.__name__, *changed])})"


def _import(module: str, *names: str) -> Iterator[str]:
    yield f"from {module} import ("
    yield from (f"    {name}," for name in sorted(names))
    yield ")"


def summaries() -> str:
    """The whole file summaries.py."""
    lines = [
        _HEAD,
        "# ruff: noqa: E501",
        '"""What every method of the API does: in reference, OpenAPI, and the help of `era`.',
        "",
        "Apart from what messages are made of, which would double the time of help.",
        '"""',
        "",
        "SUMMARIES = {",
        *(f'    "{name}": "{summary}",' for name, (_, summary) in registered().items()),
        "}",
    ]
    return "\n".join(lines) + "\n"


def status_stub() -> str:
    """The whole file amplifier_status.pyi."""
    lines = [
        *(_HEAD, "", "from controller.api.schema import AmplifierState", ""),
        "class AmplifierStatus(AmplifierState):",
        *(f"    {each.key}: float | None{' = None' * each.is_added}" for each in READINGS),
    ]
    return "\n".join(lines) + "\n"


def stub() -> str:
    """The whole file calls.pyi."""
    made = {name: each for name, (each, _) in registered().items() if name not in BY_HAND}
    results = {each.result.__name__ for each in made.values() if each.result is not Empty}
    lines = [
        _HEAD,
        "",
        "import inspect",
        "",
        *_import("controller.api.methods", "Method", *results),
        "",
        "BY_HAND: tuple[str, ...]",
        "",
        "def signature_of(method: Method) -> inspect.Signature: ...",
    ]
    for kind, keyword in (("AsyncCalls", "async def"), ("Calls", "def")):
        lines += ["", f"class {kind}:"]
        for name, method in made.items():
            signature = signature_of(method)
            result = "None" if method.result is Empty else method.result.__name__
            line = f"    {keyword} {name}({_parameters(signature)}) -> {result}: ..."
            if len(line) > _WIDTH:
                line = line.replace("(", "(\n        ").replace(") ->", "\n    ) ->")
            lines.append(line)
    return "\n".join(lines) + "\n"


def _parameters(signature: inspect.Signature) -> str:
    parts: list[str] = []
    for each in signature.parameters.values():
        if each.kind is each.KEYWORD_ONLY and "*" not in parts:
            parts.append("*")
        kind = "" if each.annotation is each.empty else f": {_kind(each.annotation)}"
        parts.append(
            each.name + kind + ("" if each.default is each.empty else f" = {each.default!r}")
        )
    return ", ".join(parts)


def _kind(annotation: Any) -> str:
    """A type as Python."""
    if get_origin(annotation) is Annotated:
        return _kind(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return " | ".join(map(_kind, get_args(annotation)))
    return "None" if annotation is type(None) else str(annotation.__name__)
