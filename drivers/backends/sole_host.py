"""One program of a machine that arms an amplifier which several can reach.

A serial port is for one program alone and a CAN node tells of another host by itself; over TCP
nobody would notice. Asking how an amplifier is, and stopping it, stays open to all.
"""

import contextlib
import socket
import sys

from drivers.backends.hardware import HARDWARE_PROVIDER
from drivers.errors import LinkError


class SoleHost:
    """The right to arm what has this name; the system takes it back when the program ends.

    Where the system knows no names for this (others than Linux) everybody has it.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._held: socket.socket | None = None

    def claim(self) -> None:
        """Have it from now on; LinkError where another on this machine has it."""
        if self._held is not None or sys.platform != "linux" or HARDWARE_PROVIDER.get() is not None:
            return
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0era-haptics host of {self._name}"[:100])
        except OSError as error:
            claim.close()
            raise LinkError(
                f"another program on this machine drives the amplifier at {self._name}; end that "
                "one, or stop it with era stop"
            ) from error
        self._held = claim

    def release(self) -> None:
        """Give it back; safe without it."""
        held, self._held = self._held, None
        if held is not None:
            with contextlib.suppress(OSError):
                held.close()
