"""The ports that wires take from the machine, replaceable for tests in virtual time.

Frames, retries and timeouts are the same whoever opens a port. TCP connections belong to the event
loop.
"""

from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from typing import Protocol, TypeAlias


class OpenPort(Protocol):
    """What a line needs of a port that is open; it is told of data and loss."""

    @property
    def is_blocked(self) -> bool:
        """Whether it has not taken all bytes yet."""

    def write(self, data: bytes) -> None:
        """Send bytes without waiting, as soon as the line takes them; LinkError if it is lost.

        They replace the unsent rest of earlier ones.
        """

    def poll(self) -> None:
        """Hand over what has come and was not read yet."""


class Port(OpenPort, Protocol):
    """A port of a line; data and loss are reported to the callbacks of its opening."""

    def close(self) -> None:
        """Close it; no callback is called afterwards."""

    async def wait_closed(self) -> None:
        """Wait until it is closed."""


PortOpener: TypeAlias = Callable[
    [str, Callable[[bytes], None], Callable[[str], None]], Awaitable[Port]
]
"""Opens a serial port by its name, with what takes its data and its loss; raises LinkError."""

PORT_OPENER: ContextVar[PortOpener | None] = ContextVar("PORT_OPENER", default=None)
"""Who opens serial ports in this context; None: the machine itself."""
