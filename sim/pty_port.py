"""A serial port that exists in memory only: a pseudo-terminal that can be unplugged."""

import asyncio
import os
import tempfile
import tty
from collections.abc import Callable
from pathlib import Path

from drivers.errors import LinkError

_READ_MAX = 4096


class PtyPort:
    """The far side of a serial port; received is called with the bytes that come.

    named: its path is that of a link, which outlives the pseudo-terminal.
    """

    def __init__(self, received: Callable[[bytes], None], *, named: bool = False) -> None:
        self._received = received
        self._master = self._slave = -1
        self._folder = tempfile.TemporaryDirectory(prefix="era-port-") if named else None
        self.dropped = 0
        self.plug_in()

    @property
    def path(self) -> str:
        """What the host opens."""
        if self._folder is not None:
            return str(Path(self._folder.name) / "port")
        return os.ttyname(self._slave)

    def plug_in(self) -> None:
        """Be there, and listen in the running event loop."""
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
            link = Path(self.path)
            link.unlink(missing_ok=True)
            link.symlink_to(os.ttyname(self._slave))
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def unplug(self) -> None:
        """Be gone: whoever has the port open is hung up on."""
        if self._master < 0:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        if self._folder is not None:
            Path(self.path).unlink(missing_ok=True)

    def close(self) -> None:
        """Be gone for good."""
        self.unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def write(self, data: bytes) -> None:
        """Send; what nobody takes is dropped and counted."""
        if self._master < 0:
            return
        try:
            complete = os.write(self._master, data) == len(data)
        except BlockingIOError:
            complete = False
        if not complete:
            self.dropped += 1

    def _readable(self) -> None:
        try:
            data = os.read(self._master, _READ_MAX)
        except BlockingIOError:  # another wake-up took the bytes
            return
        self._received(data)
