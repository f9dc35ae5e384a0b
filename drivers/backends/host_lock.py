"""Lock with which one program on this machine arms an amplifier over TCP.

Serial ports are exclusive, and CAN nodes reveal another host. Reading the status and stopping need
no lock.
"""

import contextlib
import socket
import sys

from drivers.backends.hardware import HARDWARE_PROVIDER
from drivers.errors import LinkError


class HostLock:
    """Lock of the host of one amplifier; the system releases it when the program ends.

    On systems other than Linux, which have no such names, it has no effect.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._held: socket.socket | None = None

    def acquire(self) -> None:
        """Acquire it; LinkError if another program on this machine holds it."""
        if self._held is not None or sys.platform != "linux" or HARDWARE_PROVIDER.get() is not None:
            return
        held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            held.bind(f"\0era-haptics host of {self._name}"[:100])
        except OSError as error:
            held.close()
            raise LinkError(
                f"another program on this machine drives the amplifier at {self._name}; end it, or "
                "stop it with era stop"
            ) from error
        self._held = held

    def release(self) -> None:
        """Release it, if held."""
        held, self._held = self._held, None
        if held is not None:
            with contextlib.suppress(OSError):
                held.close()
