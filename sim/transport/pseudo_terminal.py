"""A pseudo-terminal as a line: a host opens one side of it, the far end reads the other."""

import asyncio
import os
import tempfile
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Protocol

from drivers.errors import LinkError

_READ_MAX = 4096


class Terminal(ABC):
    """A serial line that can be pulled out and put in again, as far ends see it.

    dropped: writes that nobody made room for; an amplifier does not wait for its host.
    """

    dropped: int

    @property
    @abstractmethod
    def port(self) -> str:
        """The path of the host's side."""

    @abstractmethod
    def plug_in(self) -> None:
        """Make the line, where there is none; raises LinkError."""

    @abstractmethod
    def listen(self) -> None:
        """Read from now on, in the running event loop."""

    @abstractmethod
    def unplug(self) -> None:
        """Take the line away: for the host it is gone."""

    def plug(self, is_plugged: bool) -> None:
        """Pull the line out, or put it in again and read from then on."""
        if is_plugged:
            self.plug_in()
            self.listen()
        else:
            self.unplug()

    @abstractmethod
    def close(self) -> None:
        """Give everything back."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """To the host; nothing where the line is unplugged."""


class TerminalMaker(Protocol):
    """Makes terminals; see `make_terminal`."""

    def __call__(self, on_data: Callable[[bytes], None], *, unpluggable: bool) -> Terminal:
        """A terminal."""


TERMINAL_MAKER: ContextVar[TerminalMaker | None] = ContextVar("TERMINAL_MAKER", default=None)
"""Who makes the terminals in this context; the system as a rule, a bench in virtual time itself."""


def make_terminal(on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> Terminal:
    """A serial line; on_data is called with what the host has written. Raises LinkError.

    unpluggable: its port has the same path when it is plugged in again.
    """
    return (TERMINAL_MAKER.get() or PseudoTerminal)(on_data, unpluggable=unpluggable)


class PseudoTerminal(Terminal):
    """A terminal of the system's.

    unpluggable: the port is named by a link that outlives the pseudo-terminal, for each time it is
    plugged in it is another one.
    """

    def __init__(self, on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> None:
        self._on_data = on_data
        self.dropped = 0
        self._master = self._slave = -1
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.plug_in()
        if unpluggable:
            self._folder = tempfile.TemporaryDirectory(prefix="era-line-")
            self._link()

    @property
    def port(self) -> str:
        """The path of the host's side."""
        if self._folder is not None:
            return str(Path(self._folder.name) / "port")
        return os.ttyname(self._slave)

    def plug_in(self) -> None:
        """Make the line, where there is none; raises LinkError."""
        if self._master >= 0:
            return
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkError(
                f"the system gives no pseudo-terminal ({error.strerror}); close programs that hold "
                "some, or raise their number"
            ) from error
        # The slave stays open here, so that a host may come and go without a hang-up.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._folder is not None:
            self._link()

    def listen(self) -> None:
        """Read from now on, in the running event loop."""
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def unplug(self) -> None:
        """Take the line away: for the host it is gone."""
        if self._master < 0:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        if self._folder is not None:
            Path(self.port).unlink(missing_ok=True)

    def close(self) -> None:
        """Give everything back."""
        self.unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def write(self, data: bytes) -> None:
        """To the host; nothing where the line is unplugged."""
        if self._master < 0:
            return
        try:
            complete = os.write(self._master, data) == len(data)
        except BlockingIOError:
            complete = False
        self.dropped += not complete

    def _link(self) -> None:
        link = Path(self.port)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))

    def _readable(self) -> None:
        try:
            data = os.read(self._master, _READ_MAX)
        except BlockingIOError:  # another wake-up took the bytes
            return
        self._on_data(data)
