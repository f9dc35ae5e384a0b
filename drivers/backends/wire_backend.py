"""What the backends over real wires have in common: counters, the last byte, whom to tell."""

from collections.abc import Callable

from drivers.backend import Backend
from drivers.protocol.messages import AmplifierEvent
from drivers.statistics import WireCounters


class WireBackend(Backend):
    """A backend that counts, and tells of events and of a loss that nobody asked about.

    What derives from it counts in `_counters`, puts the time into `_last_sent` when a request has
    gone out, and calls `_on_event` and `_on_loss`, which nobody hears before `listen`.
    """

    def __init__(self) -> None:
        self._counters = WireCounters()
        self._last_sent = 0.0
        self._on_event: Callable[[AmplifierEvent], None] = _ignore
        self._on_loss: Callable[[str], None] = _ignore

    @property
    def counters(self) -> WireCounters:
        """What was seen for this amplifier, or on the line by all who share it."""
        return self._counters

    @property
    def last_sent(self) -> float:
        """When system or adapter took the last request's last byte, by the loop's clock [s]."""
        return self._last_sent

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """See `Backend.listen`."""
        self._on_event, self._on_loss = on_event, on_loss


def _ignore(_: object) -> None:
    pass
