"""What an operation of control gives back: that which makes the answer, now or in a while."""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, TypeAlias

from sim.control.context import SimulationContext

Answer: TypeAlias = Callable[[], dict[str, Any]]
"""Makes an answer, or raises InputError; touches nothing of the bench: any thread may do it."""


@dataclass(frozen=True)
class Wait:
    """Something has to pass first, in the event loop, and then the answer can be made."""

    passes: Callable[[], Coroutine[Any, Any, None]]
    then: Answer


Operation: TypeAlias = Callable[[SimulationContext, dict[str, Any], float], Answer | Wait]
"""Does what a request asks now [s], or raises InputError and changes nothing."""


def already(answer: dict[str, Any]) -> Answer:
    """An answer that is made."""
    return lambda: answer
