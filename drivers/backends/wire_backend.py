"""Base of backends over real wires: counters, time of the last byte, callbacks."""

from collections.abc import Callable
from typing import TypeVar

from drivers.backend import Backend
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierEvent, Request, Stop
from drivers.statistics import WireCounters

_LineT = TypeVar("_LineT")


class WireBackend(Backend):
    """A backend with counters and callbacks.

    Subclasses count in `_counters`, set `_last_sent_at` when a request has gone out, `_loss` when
    the wire is lost, and call `_on_event` and `_on_loss`, which have no effect before `listen`.
    """

    def __init__(self) -> None:
        self._counters = WireCounters()
        self._last_sent_at = 0.0
        self._on_event: Callable[[AmplifierEvent], None] = _ignore
        self._on_loss: Callable[[str], None] = _ignore
        self._loss: str | None = None  # until reopened, even if others have joined the line again

    @property
    def counters(self) -> WireCounters:
        """Frame counters of this amplifier, or of the line that it shares."""
        return self._counters

    @property
    def last_sent_at(self) -> float:
        """Time [s] when system or adapter took the last byte, by the event loop's clock."""
        return self._last_sent_at

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """See `Backend.listen`."""
        self._on_event, self._on_loss = on_event, on_loss

    def _require(self, line: _LineT | None, name: str, request: Request) -> _LineT:
        """Return the open line; LinkError if it is not open, or lost, except for a Stop."""
        if line is None or (self._loss is not None and not isinstance(request, Stop)):
            raise LinkError(self._loss or f"{name} is not open; open the amplifier first")
        return line


def _ignore(_: object) -> None:
    pass
