"""Where hosts reach a software amplifier: a terminal or a port, kept while it restarts."""

import os
import socket
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from model.errors import InputError
from sim.soft_amp.settings import Protocol
from sim.transport.links import linked

_LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Place:
    """A line; terminal, listening: its descriptors, -1 for none. url: of the first amplifier."""

    url: str
    terminal: int = -1
    listening: int = -1

    def urls(self, amplifiers: int, *, protocol: Protocol) -> list[str]:
        """The URL of each amplifier."""
        if protocol is Protocol.MODBUS:
            return [f"{self.url}/{unit}" for unit in range(1, amplifiers + 1)]
        others = range(2, amplifiers + 1)
        return [self.url, *(f"{self.url}?address={address}" for address in others)]


@contextmanager
def terminal_place(link: Path | None) -> Iterator[Place]:
    """A pseudo-terminal, and a symbolic link to it while this lasts; raises InputError."""
    with ExitStack() as stack:
        near, far = os.openpty()
        stack.callback(os.close, near)
        # Kept open, so that a host that closes it does not hang up the line.
        stack.callback(os.close, far)
        tty.setraw(far)
        os.set_blocking(near, False)
        path = os.ttyname(far)
        if link is not None:
            path = stack.enter_context(linked(link, to=path))
        yield Place(f"serial://{path}", terminal=near)


@contextmanager
def tcp_place(port: int, *, protocol: Protocol) -> Iterator[Place]:
    """A port of this machine alone, 0 for any; raises InputError."""
    try:
        listening = socket.create_server((_LOOPBACK, port), backlog=4)
    except OSError as problem:
        raise InputError(
            f"port {port}: cannot listen: {problem.strerror}; choose another"
        ) from None
    with listening:
        listening.setblocking(False)
        scheme = "serial+tcp" if protocol is Protocol.SERIAL else "modbus+tcp"
        url = f"{scheme}://{_LOOPBACK}:{listening.getsockname()[1]}"
        yield Place(url, listening=listening.fileno())
