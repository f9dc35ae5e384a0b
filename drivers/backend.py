"""The backend interface: carry one request to an amplifier and return its reply.

A backend is registered as an entry point of `era_haptics.backends` under the scheme of its URLs and
checked by `drivers.conformance`. What it must have is `open`, `close`, `exchange` and
`last_sent_at`; the defaults of the others suit a wire with one amplifier that sends nothing
unsolicited.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

from drivers.errors import CommandError
from drivers.protocol.messages import AmplifierEvent, Broadcast, Reply, Request
from drivers.protocol.wire_times import WireTimes
from drivers.statistics import WireCounters


class Backend(ABC):
    """An amplifier over one kind of wire; retries, tokens and state belong to `Amplifier`."""

    @abstractmethod
    def __init__(self, url: str) -> None:
        """Parse the URL without touching the wire; raises CommandError."""

    @abstractmethod
    async def open(self) -> None:
        """Open the wire, exclusively if possible; raises LinkError with a remedy.

        A wire shared by several amplifiers is opened once per process.
        """

    @abstractmethod
    async def close(self) -> None:
        """Close the wire; safe to call twice and on a lost wire."""

    @abstractmethod
    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send one request and wait for its reply; late replies to others are discarded.

        Called for one request at a time on a line (see `drivers.line`). A Stop is sent as long as
        the wire is open, even if the amplifier counts as lost.

        timeout [s]: of the whole exchange, extended if the wire is slower. Raises LinkTimeout,
        LinkError; CommandRefused for a set that the amplifier cannot play, CommandError for an
        amplifier that does not fit its configuration; TypeError for a set or envelope that has not
        passed a guard (`require_safe`). A Nak is returned, not raised. Cancelling leaves the wire
        usable.
        """

    @property
    @abstractmethod
    def last_sent_at(self) -> float:
        """Time [s] when the last byte of the last request went out, by the event loop's clock.

        Until it has advanced, a request counts as unsent and is cancelled at once for a stop.
        """

    @property
    def counters(self) -> WireCounters:
        """Frame counters; all zero if nothing is counted."""
        return WireCounters()

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """Register callbacks, called in the event loop, before `open`.

        on_event: for unsolicited events; on_loss: once per opening, if the wire or the amplifier is
        found lost while no request is pending.
        """
        return

    @property
    def bus(self) -> str | None:
        """Identifier of what one broadcast reaches; None without broadcasts."""
        return None

    async def broadcast(self, request: Broadcast) -> None:
        """Send a commit or a stop to every amplifier of the bus; there are no replies.

        A stop may be broadcast during an exchange. Raises LinkError, also for a stop that the wire
        cannot send during an exchange, and CommandError if there is no bus.
        """
        raise CommandError(
            f"this wire does not support broadcasts, got {type(request).__name__}; send it to each "
            "amplifier"
        )

    @property
    def carries_sessions(self) -> bool:
        """Whether requests carry their session; else the host itself is the session."""
        return True

    @property
    def wire_times(self) -> WireTimes:
        """Durations on its wire; zero if unknown."""
        return WireTimes()
