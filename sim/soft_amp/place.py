"""Where hosts reach a software amplifier: a terminal or a port, kept while it restarts."""

import fcntl
import os
import socket
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from model.errors import InputError
from sim.soft_amp.settings import Protocol

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
            stack.enter_context(_lock(link))
            _make_link(link, to=path)
            stack.callback(_remove_link, link, to=path)
        yield Place(f"serial://{path if link is None else link.absolute()}", terminal=near)


@contextmanager
def _lock(link: Path) -> Iterator[None]:
    """Keep others from a link; a lock ends with its process, even a killed one."""
    path = link.with_name(f".{link.name}.lock")
    try:
        with path.open("wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
    except BlockingIOError:
        raise InputError(
            f"--link {link}: in use by another amplifier; choose another path"
        ) from None
    except OSError as problem:
        raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None


def _make_link(link: Path, *, to: str) -> None:
    if not link.is_symlink() and link.exists():
        raise InputError(f"--link {link}: exists and is no symbolic link; choose another path")
    made = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        made.symlink_to(to)
        made.replace(link)
    except OSError as problem:
        raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None


def _remove_link(link: Path, *, to: str) -> None:
    if link.is_symlink() and str(link.readlink()) == to:  # not another's by now
        link.unlink()


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
        scheme = "serial" if protocol is Protocol.SERIAL else "modbus+tcp"
        url = f"{scheme}://{_LOOPBACK}:{listening.getsockname()[1]}"
        yield Place(url, listening=listening.fileno())
