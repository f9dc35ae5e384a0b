"""Requests as they were sent, and what shows that one without a reply was carried out."""

from collections.abc import Callable
from dataclasses import dataclass

from drivers.protocol.records import Values
from drivers.protocol.table import LATCHED, STATES
from sim.witness.decoded import Request

ENABLED = STATES["OPERATION_ENABLED"]


@dataclass(eq=False, slots=True)
class Sent:
    """A request as it was sent, in this order; begun [s]: when its first byte passed.

    since: from which on its amplifier has to respond, infinite while it is the host's turn; begin,
    end: between which it is carried out, None for until its reply [s].
    """

    number: int
    request: Request
    begun: float
    since: float
    begin: float
    end: float | None = None
    is_overdue: bool = False


_CARRIED_OUT: dict[str, Callable[[Values, Values], bool]] = {
    "Arm": lambda values, status: status["state"] == ENABLED,
    "Disarm": lambda values, status: status["state"] != ENABLED,
    "Set": lambda values, status: values["now"] and status["token"] == values["token"],
    "Commit": lambda values, status: status["token"] == values["token"],
    "Silence": lambda values, status: not any(status["tokens"]),
    "Stop": lambda values, status: status["state"] in LATCHED,
    "Clear": lambda values, status: True,
}
CHANGING = frozenset(_CARRIED_OUT)
"""Requests that change what the amplifier does."""


def is_carried_out(request: Request, status: Values) -> bool:
    """Whether a later status shows that a request was carried out."""
    return bool(_CARRIED_OUT[request.name](request.values, status))
