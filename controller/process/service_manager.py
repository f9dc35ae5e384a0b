"""Notifications to systemd by the protocol of sd_notify(3): READY=1, WATCHDOG=1, STATUS=...

Datagrams to the socket in NOTIFY_SOCKET, non-blocking; errors are ignored. Without the variable
nothing is sent.
"""

import contextlib
import os
import socket
from collections.abc import Mapping

_MAX_TEXT = 400  # characters


class ServiceManager:
    """Notifies the service manager named in an environment."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        # Opened at once: the watchdog is to be fed when no descriptor is left, too.
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        self._watchdog_interval = _watchdog_interval(environment)
        self._last_alive = float("-inf")

    def notify(self, *assignments: str) -> None:
        """Send assignments such as STATUS=..., one a line; control characters are removed."""
        if self._socket is None:
            return
        lines = ("".join(c for c in text if c.isprintable())[:_MAX_TEXT] for text in assignments)
        # @ marks an address in the abstract namespace
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        with contextlib.suppress(OSError):
            self._socket.sendto("\n".join(lines).encode(), socket.MSG_DONTWAIT, address)

    def ready(self, status: str) -> None:
        """Report that the daemon serves requests."""
        self.notify("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")

    def alive(self, now: float) -> None:
        """Feed systemd's watchdog; called by the control loop after each cycle, at a time [s]."""
        interval = self._watchdog_interval
        if interval is not None and now - self._last_alive >= interval:
            self._last_alive = now
            self.notify("WATCHDOG=1")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


def _watchdog_interval(environment: Mapping[str, str]) -> float | None:
    """Half of WATCHDOG_USEC [s] if it is meant for this process, else None."""
    microseconds = environment.get("WATCHDOG_USEC", "")
    is_ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    if not (microseconds.isascii() and microseconds.isdecimal() and is_ours):
        return None
    return int(microseconds) / 2e6 or None
