"""The methods of the clients that are one method of the API each: made from the registry.

`calls.pyi`, written by `make pages`, has their signatures for editors and mypy.
"""

import inspect
from collections.abc import Callable
from typing import Any

from controller.api.link import make_params
from controller.api.methods import Method
from controller.api.registered import METHODS
from controller.api.schema import BY_PLACE, Empty, Message
from controller.api.summaries import SUMMARIES

BY_HAND = ("touch", "play", "subscribe", "unsubscribe")
"""Methods whose arguments the clients put together, from positions and names of topics."""


def signature_of(method: Method) -> inspect.Signature:
    """The parameters of a method after self: required and marked ones by place or name.

    All others by name.
    """
    parameters = [inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)]
    fields = method.params.model_fields.items()
    for name, field in sorted(fields, key=lambda each: not each[1].is_required()):
        kind, default = inspect.Parameter.KEYWORD_ONLY, field.default
        if field.is_required() or BY_PLACE in field.metadata:
            kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        if field.is_required():
            default = inspect.Parameter.empty
        parameters.append(
            inspect.Parameter(name, kind, default=default, annotation=field.annotation)
        )
    result = None if method.result is Empty else method.result
    return inspect.Signature(parameters, return_annotation=result)


def _coroutine_of(name: str, method: Method) -> Callable[..., Any]:
    """A coroutine function that calls a method of the API by `call` of its client."""
    signature = signature_of(method)

    async def call(*values: Any, **named: object) -> Message | None:
        given = signature.bind(*values, **named).arguments
        client = given.pop("self")
        result: Message = await client.call(name, make_params(name, **given), method.result)
        return None if method.result is Empty else result

    call.__name__, call.__qualname__ = name, f"AsyncClient.{name}"
    call.__doc__ = SUMMARIES[name]
    call.__signature__ = signature  # type: ignore[attr-defined]
    return call


class AsyncCalls:
    """Methods of `AsyncClient`."""


class Calls:
    """Methods of `Client`: those of `AsyncClient`, which it adds."""


for _name, _method in METHODS.items():
    if _name not in BY_HAND:
        setattr(AsyncCalls, _name, _coroutine_of(_name, _method))
