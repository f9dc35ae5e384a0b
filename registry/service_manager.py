"""Notifications to systemd, in the format of sd_notify(3).

A notification is a datagram to the socket named by NOTIFY_SOCKET. Sending never blocks, and errors
are ignored. Without this variable, nothing is sent.
"""

import contextlib
import os
import socket
from collections.abc import Mapping

_MAX_CHARACTERS = 400  # of an assignment; longer ones are cut


class ServiceManager:
    """Sender of notifications to the service manager that an environment names, if any."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        # Opened early: the watchdog must be fed even if no file descriptor is left later.
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        self._watchdog_interval = _watchdog_interval(environment)
        self._last_alive = float("-inf")

    def notify(self, *assignments: str) -> None:
        """Send assignments such as STATUS=..., without control characters, each in one line."""
        if self._socket is None:
            return
        message = "\n".join(map(_printable, assignments)).encode()
        address = self._address
        if address.startswith("@"):  # in the abstract namespace
            address = f"\0{address[1:]}"
        with contextlib.suppress(OSError):
            self._socket.sendto(message, socket.MSG_DONTWAIT, address)

    def ready(self, status: str) -> None:
        """Report that the service has started."""
        self.notify("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")

    def alive(self, now: float) -> None:
        """Feed the watchdog if that is due at time `now` [s]; call it while the service works."""
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
    """Return half of WATCHDOG_USEC [s], or None if no watchdog is set for this process."""
    microseconds = environment.get("WATCHDOG_USEC", "")
    is_ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    if not (microseconds.isascii() and microseconds.isdecimal() and is_ours):
        return None
    return int(microseconds) / 2e6 or None
