"""What systemd is told: READY=1, WATCHDOG=1 and their like, by the protocol of sd_notify(3).

Datagrams to the socket that NOTIFY_SOCKET names. Nothing waits, and nothing that goes wrong with it
matters to the daemon; without the variable nobody is told.
"""

import contextlib
import os
import socket
import time
from collections.abc import Mapping


class ServiceManager:
    """Tells the service manager that an environment names."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
        self._alive_every = _alive_every(environment)  # s; None where it does not ask for it
        self._told_alive_at = float("-inf")

    def tell(self, *assignments: str) -> None:
        """Send assignments such as STATUS=..., each on its line; control characters are dropped."""
        if self._socket is None:
            return
        lines = ("".join(c for c in text if c.isprintable())[:400] for text in assignments)
        # @ stands for a name that is in no folder.
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        with contextlib.suppress(OSError):
            self._socket.sendto("\n".join(lines).encode(), address)

    def ready(self, status: str) -> None:
        """The daemon serves."""
        self.tell("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self.tell(f"STATUS={text}")

    def reloading(self) -> None:
        """A reload begins; `ready` ends it."""
        self.tell("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """The daemon ends."""
        self.tell("STOPPING=1")

    def alive(self, now: float) -> None:
        """To be called by the control loop after it has run, at a time [s], however often."""
        if self._alive_every is not None and now - self._told_alive_at >= self._alive_every:
            self._told_alive_at = now
            self.tell("WATCHDOG=1")

    def close(self) -> None:
        """Tell nothing more."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _alive_every(environment: Mapping[str, str]) -> float | None:
    """Half of the time that WATCHDOG_USEC allows, if it is meant for this process."""
    microseconds = environment.get("WATCHDOG_USEC", "")
    meant = environment.get("WATCHDOG_PID", str(os.getpid()))
    if not (microseconds.isascii() and microseconds.isdecimal()) or meant != str(os.getpid()):
        return None
    return int(microseconds) / 2e6 or None
