"""What every backend must do: carry one request to an amplifier and bring its reply back."""

from abc import ABC, abstractmethod

from drivers.protocol.messages import Reply, Request


class Backend(ABC):
    """An amplifier over one kind of wire; retries, tokens and state belong to `Amplifier`."""

    @abstractmethod
    def __init__(self, url: str) -> None:
        """Take the URL apart without touching the wire; raises CommandError."""

    @abstractmethod
    async def open(self) -> None:
        """Open the wire, exclusively where it can be; raises LinkError with what to do about it."""

    @abstractmethod
    async def close(self) -> None:
        """Close the wire; safe to call twice and on a wire that is already lost."""

    @abstractmethod
    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send one request and wait for its own reply; a late reply to another is dropped.

        timeout [s]: what the amplifier may take; what a slow wire needs comes on top of it. Raises
        LinkTimeout, LinkError. A Nak is returned, not raised. Cancelling leaves the wire usable.
        """

    @property
    @abstractmethod
    def last_sent(self) -> float:
        """When the last byte of the last request went out, on time.monotonic() [s]."""
