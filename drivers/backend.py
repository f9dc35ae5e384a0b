"""What every backend must do: carry one request to an amplifier and bring its reply back.

Written by whoever adds a wire, registered as an entry point of `era_haptics.backends` under the
scheme of its URLs, and held to `drivers.conformance`. The first five members are its own; the
others have answers that suit a wire with one amplifier that only speaks when it is asked.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from drivers.errors import CommandError
from drivers.protocol.messages import AmplifierEvent, Broadcast, Reply, Request
from drivers.protocol.wire_times import NoTimes, WireTimes
from drivers.statistics import WireCounters


class Backend(ABC):
    """An amplifier over one kind of wire; retries, tokens and state belong to `Amplifier`."""

    @abstractmethod
    def __init__(self, url: str) -> None:
        """Take the URL apart without touching the wire; raises CommandError."""

    @abstractmethod
    async def open(self) -> None:
        """Open the wire, exclusively where it can be; raises LinkError with what to do about it.

        A wire that several amplifiers share is opened once in a process, for all of them.
        """

    @abstractmethod
    async def close(self) -> None:
        """Close the wire; safe to call twice and on a wire that is already lost."""

    @abstractmethod
    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send one request and wait for its own reply; a late reply to another is dropped.

        timeout [s]: for all of it; longer where the wire itself needs longer. Raises LinkTimeout,
        LinkError. A Nak is returned, not raised. Cancelling leaves the wire usable.
        Sets and envelopes must have been let through by a guard: TypeError for others, as
        `require_safe` raises it.
        """

    @property
    @abstractmethod
    def last_sent(self) -> float:
        """When the last byte of the last request went out, by the event loop's clock [s]."""

    @property
    def counters(self) -> WireCounters:
        """What was seen on the wire; all zero where nothing is counted."""
        return WireCounters()

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """Whom to tell, in the event loop, what comes unasked.

        on_event: the amplifier's own events; on_loss: once after each opening, when the wire or the
        amplifier on it was found to be gone without a request being on its way. To be called before
        `open`. A wire that notices neither calls nobody.
        """
        return

    @property
    def bus(self) -> str | None:
        """Names what it shares with others that one broadcast reaches; None without broadcasts."""
        return None

    @property
    def takes_turns(self) -> bool:
        """Whether all who share its bus are asked one after the other, and wait for each other."""
        return False

    @property
    def is_unsent(self) -> bool:
        """Whether nothing of the request that is being exchanged has gone out yet.

        As where it waits for others on the wire: if it is cancelled then, nothing is sent.
        """
        return False

    def silencing(self, request: Request) -> AbstractContextManager[None]:
        """A context in which a request that silences waits for its turn: keep the wire free for it.

        What others would send meanwhile waits, on a wire that they share.
        """
        return nullcontext()

    async def broadcast(self, request: Broadcast) -> None:
        """Send a commit or a stop to every amplifier of the bus at once; nobody answers.

        Raises LinkError, and CommandError where there is no bus.
        """
        raise CommandError(
            f"this wire knows no broadcast, so none of a {type(request).__name__}; tell each "
            "amplifier by itself"
        )

    @property
    def wire_times(self) -> WireTimes:
        """How long things take on its wire; none where nobody knows."""
        return NoTimes()
