"""Notifications to systemd, as sd_notify(3) sends them.

They are datagrams to the socket in NOTIFY_SOCKET, non-blocking; errors are ignored. Nothing is sent
if the variable is not set.
"""

import contextlib
import os
import socket
from collections.abc import Mapping

_MAX_CHARACTERS = 400


class ServiceManager:
    """Return the service manager named in an environment, if any."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        # Opened here, so that the watchdog is fed even when no descriptor is left.
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        self._watchdog_interval = _watchdog_interval(environment)
        self._last_alive = float("-inf")

    def notify(self, *assignments: str) -> None:
        """Send assignments such as STATUS=..., one per line, without their control characters."""
        if self._socket is None:
            return
        message = "\n".join(map(_printable, assignments)).encode()
        address = self._address
        if address.startswith("@"):  # in the abstract namespace
            address = f"\0{address[1:]}"
        with contextlib.suppress(OSError):
            self._socket.sendto(message, socket.MSG_DONTWAIT, address)

    def ready(self, status: str) -> None:
        """Report that the service is up."""
        self.notify("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")

    def alive(self, now: float) -> None:
        """Feed systemd's watchdog if it is due at a time [s]; call it while all is well."""
        interval = self._watchdog_interval
        if interval is not None and now - self._last_alive >= interval:
            self._last_alive = now
            self.notify("WATCHDOG=1")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


def _printable(text: str) -> str:
    characters = [character for character in text if character.isprintable()]
    return "".join(characters[:_MAX_CHARACTERS])


def _watchdog_interval(environment: Mapping[str, str]) -> float | None:
    """Half of WATCHDOG_USEC [s] if it is meant for this process, else None."""
    microseconds = environment.get("WATCHDOG_USEC", "")
    is_ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    if not (microseconds.isascii() and microseconds.isdecimal() and is_ours):
        return None
    return int(microseconds) / 2e6 or None
