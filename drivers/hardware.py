"""What wires take from the machine, replaceable for tests in virtual time.

Serial ports and random numbers. Frames, retries and timeouts are the same with every provider. TCP
connections belong to the event loop.
"""

import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextvars import ContextVar
from typing import Protocol


class Port(Protocol):
    """An open serial port; data and loss are reported to the callbacks of its opening."""

    @property
    def is_blocked(self) -> bool:
        """Whether it has not taken all bytes yet."""

    def write(self, data: bytes) -> None:
        """Send bytes without waiting, as soon as the line takes them; LinkError if it is lost.

        They replace the unsent rest of earlier ones.
        """

    def poll(self) -> None:
        """Hand over what has come and was not read yet."""

    def close(self) -> None:
        """Close it; no callback is called afterwards."""

    async def wait_closed(self) -> None:
        """Wait until it is closed."""


class HardwareProvider(ABC):
    """Replacement of the machine's hardware and system resources."""

    @abstractmethod
    async def open_port(
        self, name: str, *, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open a serial port; raises LinkError."""

    @abstractmethod
    def below(self, limit: int) -> int:
        """Return a random number, 0 to limit - 1."""


HARDWARE_PROVIDER: ContextVar[HardwareProvider | None] = ContextVar(
    "HARDWARE_PROVIDER", default=None
)
"""Provider in this context; None: the machine itself."""


def number_below(limit: int) -> int:
    """Return an unpredictable number, 0 to limit - 1, or one that the provider chooses."""
    hardware = HARDWARE_PROVIDER.get()
    return secrets.randbelow(limit) if hardware is None else hardware.below(limit)
