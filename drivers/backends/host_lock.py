"""Lock with which one program on this machine arms an amplifier that cannot tell hosts apart.

Laboratory instruments need it; others tell hosts apart by their session. Reading the status and
stopping need no lock.
"""

import contextlib
import socket
import sys

from drivers.errors import LinkError
from drivers.hardware import HARDWARE_PROVIDER


class HostLock:
    """Lock of the host of one amplifier; the system releases it when the program ends.

    On systems other than Linux, which have no such names, it has no effect.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._address = f"\0era-haptics host of {name}"[:100]
        self._held: socket.socket | None = None

    def acquire(self) -> None:
        """Acquire it; LinkError if another program on this machine holds it."""
        if self._held is not None or not _has_effect():
            return
        held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            held.bind(self._address)
        except OSError as error:
            held.close()
            raise self._error() from error
        self._held = held

    @property
    def is_held_elsewhere(self) -> bool:
        """Whether another program on this machine holds it."""
        if self._held is not None or not _has_effect():
            return False
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
            return probe.connect_ex(self._address) == 0

    def require_free(self) -> None:
        """Raise LinkError if another program on this machine holds it."""
        if self.is_held_elsewhere:
            raise self._error()

    def release(self) -> None:
        """Release it, if held."""
        held, self._held = self._held, None
        if held is not None:
            with contextlib.suppress(OSError):
                held.close()

    def _error(self) -> LinkError:
        return LinkError(
            f"another program on this machine drives the amplifier at {self._name}; end it, or "
            "stop it with era stop"
        )


def _has_effect() -> bool:
    """Whether names are shared with other programs: not on simulated hardware."""
    return sys.platform == "linux" and HARDWARE_PROVIDER.get() is None
