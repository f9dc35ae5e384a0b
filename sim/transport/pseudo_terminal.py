"""A serial line between a host and a far end on one machine: a pseudo-terminal of the system.

The host opens one side, as a serial port; the far end reads and writes the other side.
"""

import asyncio
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from contextvars import ContextVar
from pathlib import Path

from drivers.errors import LinkError

_READ_MAX = 4096  # bytes per read
TERMINAL_MAKER: ContextVar["Callable[..., PseudoTerminal] | None"] = ContextVar(
    "TERMINAL_MAKER", default=None
)
"""The factory of serial lines in this context; None for `PseudoTerminal`."""


class PseudoTerminal:
    """The far end's side of a serial line: a pseudo-terminal of the system. Raises LinkError.

    on_data: called with bytes from the host; unpluggable: the port is a symbolic link, which
    outlives each pseudo-terminal. Bytes that a host does not read are lost.
    """

    def __init__(self, on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> None:
        self._on_data = on_data
        self._master = -1
        self._slave = -1
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
        """Create the line if it is unplugged; raises LinkError."""
        if self._master >= 0:
            return
        try:
            import tty  # not on Windows

            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkError(
                f"cannot create a pseudo-terminal: {error.strerror}; close programs that use some, "
                "or raise kernel.pty.max"
            ) from error
        # Kept open, so that hosts may disconnect without a hang-up.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._folder is not None:
            self._link()

    def listen(self) -> None:
        """Read from now on, in the running event loop."""
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def unplug(self) -> None:
        """Remove the line."""
        if self._master < 0:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        if self._folder is not None:
            # Before closing: another program can then get the same number, and its bytes.
            Path(self.port).unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)
        self._master = -1
        self._slave = -1

    def plug(self, is_plugged: bool) -> None:
        """Unplug the line, or plug it in and read again."""
        if is_plugged:
            self.plug_in()
            self.listen()
        else:
            self.unplug()

    def close(self) -> None:
        """Release all resources."""
        self.unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def write(self, data: bytes) -> None:
        """Write to the host; discarded while unplugged."""
        if self._master < 0:
            return
        with suppress(BlockingIOError):
            os.write(self._master, data)

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


def make_terminal(on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> PseudoTerminal:
    """Create a serial line by the factory of this context; see `PseudoTerminal`."""
    make = TERMINAL_MAKER.get() or PseudoTerminal
    return make(on_data, unpluggable=unpluggable)
