"""Requests to an amplifier that have no reply, and may have been carried out."""

from collections.abc import Hashable
from dataclasses import dataclass

from drivers.protocol.records import Values
from drivers.protocol.table import LATCHED, STATES
from sim.witness.decoded import Request

ENABLED = STATES["OPERATION_ENABLED"]


@dataclass(frozen=True, slots=True)
class Sent:
    """A request as it was sent: in which order, when its first byte passed [s], its reply's key."""

    number: int
    begun: float
    request: Request
    key: Hashable = None

    @property
    def is_broadcast(self) -> bool:
        """Whether it never has a reply."""
        return self.key is None


class Unanswered:
    """Requests in order, until a reply or a later status shows what became of them."""

    def __init__(self) -> None:
        self._sent: list[Sent] = []

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._sent)

    def add(self, sent: Sent) -> None:
        """Add a request."""
        self._sent.append(sent)

    def remove(self, sent: Sent) -> None:
        """Remove a request that has its reply."""
        self._sent = [each for each in self._sent if each.number != sent.number]

    def take_before(self, number: int) -> list[Sent]:
        """Remove and return the requests before one that has a status in its reply."""
        earlier = [each for each in self._sent if each.number < number]
        self._sent = [each for each in self._sent if each.number >= number]
        return earlier

    def clear(self) -> None:
        """Forget all."""
        self._sent.clear()


def is_carried_out(request: Request, status: Values) -> bool:
    """Whether a later status shows that a request was carried out."""
    match request.name:
        case "Commit":
            return bool(status["token"] == request.values["token"])
        case "Set":
            is_played = status["token"] == request.values["token"]
            return bool(is_played and request.values["now"])
        case "Stop":
            return status["state"] in LATCHED
        case "Disarm":
            return bool(status["state"] != ENABLED)
        case "Arm":
            return bool(status["state"] == ENABLED)
        case "Silence":
            return not any(status["tokens"])
        case _:
            return request.name == "Clear"
