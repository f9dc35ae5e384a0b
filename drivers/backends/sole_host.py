"""Exclusive right of one program on this machine to arm an amplifier, for TCP.

Serial ports are exclusive and CAN nodes reveal another host; TCP does neither. Reading the status
and stopping stay open to all programs.
"""

import contextlib
import socket
import sys

from drivers.backends.hardware import HARDWARE_PROVIDER
from drivers.errors import LinkError


class SoleHost:
    """The right to arm the amplifier of this name; the system revokes it when the program ends.

    Systems other than Linux have no such names: every program has the right there.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._held: socket.socket | None = None

    def claim(self) -> None:
        """Take the right; LinkError if another program on this machine has it."""
        if self._held is not None or sys.platform != "linux" or HARDWARE_PROVIDER.get() is not None:
            return
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0era-haptics host of {self._name}"[:100])
        except OSError as error:
            claim.close()
            raise LinkError(
                f"another program on this machine drives the amplifier at {self._name}; end it, or "
                "stop it with era stop"
            ) from error
        self._held = claim

    def release(self) -> None:
        """Release the right; safe to call without it."""
        held, self._held = self._held, None
        if held is not None:
            with contextlib.suppress(OSError):
                held.close()
