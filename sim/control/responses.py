"""Responses of control operations, built at once or later."""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, TypeAlias

from sim.control.context import SimulationContext

Request: TypeAlias = dict[str, Any]
Response: TypeAlias = dict[str, Any]
ResponseBuilder: TypeAlias = Callable[[], Response]
"""Builds a response, or raises InputError; independent of the bench, so any thread may call it."""


@dataclass(frozen=True)
class Deferred:
    """A response that can be built after waiting in the event loop."""

    wait: Callable[[], Coroutine[Any, Any, None]]
    then: ResponseBuilder


Operation: TypeAlias = Callable[[SimulationContext, Request, float], ResponseBuilder | Deferred]
"""Executes a request at a time [s], or raises InputError and changes nothing."""


def ready(response: Response) -> ResponseBuilder:
    """A builder for a response that exists already."""
    return lambda: response
