"""Signatures of what the API makes from a table: methods of the clients, readings of amplifiers."""

import inspect
import types
from typing import Annotated, Any, Union, get_args, get_origin

from controller.api.calls import BY_HAND, signature_of
from controller.api.methods import METHODS
from controller.api.schema import Empty
from drivers.protocol.table import READINGS

_HEAD = "# Written by docs/generators/client_stub.py."


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
    made = {name: method for name, method in METHODS.items() if name not in BY_HAND}
    results = sorted({each.result.__name__ for each in made.values() if each.result is not Empty})
    lines = [
        _HEAD,
        "",
        "import inspect",
        "",
        "from controller.api.methods import (",
        *(f"    {name}," for name in sorted(["Method", *results])),
        ")",
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
            lines.append(f"    {keyword} {name}({_parameters(signature)}) -> {result}: ...")
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
