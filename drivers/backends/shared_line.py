"""A line shared by several amplifiers of a process: opened by the first, closed by the last."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from typing import Any, ClassVar, Generic, TypeVar
from weakref import WeakKeyDictionary

from drivers.errors import LinkError
from drivers.hardware import Adapter, Port

_OpenT = TypeVar("_OpenT", bound=Port | Adapter)


class SharedLine(ABC, Generic[_OpenT]):
    """A serial line, a Modbus line or a CAN bus; its users are identified by a number.

    `join` blocks during open and close. After a loss each user must rejoin; the first one to do so
    reopens the line. name: of the line, in messages; tap: of streams of bytes, called with all that
    is received.
    """

    address_term: ClassVar[str]
    """Word of this wire for the number of a user: address, unit or node."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.tap: Callable[[bytes], None] | None = None
        self._users: dict[int, Callable[[str], None]] = {}
        self._notified: set[int] = set()  # of the loss, and not joined since
        self._loss: str | None = None
        self._opened: _OpenT | None = None
        self._changing = asyncio.Lock()  # held while it is opened or closed

    async def join(self, number: int, on_loss: Callable[[str], None]) -> None:
        """Add a user; on_loss: called once, in the event loop, with the cause of a loss.

        Raises LinkError if the line cannot be opened, and for a number in use.
        """
        if number in self._users:
            raise LinkError(
                f"{self.address_term} {number} on {self.name} is already open in this program; "
                f"give each amplifier its own {self.address_term}"
            )
        self._users[number] = on_loss
        try:
            async with self._changing:
                if self._loss is not None:
                    await self._shut()
                if self._opened is None:
                    self._loss = None
                    self._opened = await self._open()
                self._notified.discard(number)  # a loss while this one was waiting
        except BaseException:
            await self.leave(number)
            raise

    async def leave(self, number: int) -> None:
        """Remove a user; the last one closes the line. Safe to call twice."""
        self._users.pop(number, None)
        self._notified.discard(number)
        if self._users:
            return
        self._fail_pending(f"{self.name} was closed")
        async with self._changing:
            if not self._users:  # no user has joined meanwhile
                await self._shut()
        if not self._users:
            _forget(self)

    def raise_if_lost(self, number: int | None = None) -> None:
        """Raise LinkError if the line is lost, or was, and this user has not joined since.

        Call it before sending: the request may have waited while others reopened the line.
        """
        if self._loss is not None:
            raise LinkError(self._loss)
        if number in self._notified:
            raise LinkError(
                f"{self.name} was lost, and {self.address_term} {number} has not been reopened; "
                "open that amplifier again"
            )

    def _ready(self) -> _OpenT:
        """Return the open port or adapter; LinkError if it is closed or lost."""
        self.raise_if_lost()
        opened = self._opened  # a thread may call while it is being closed
        if opened is None:
            raise LinkError(f"{self.name} is not open; open the amplifier first")
        return opened

    def _lose(self, cause: str) -> None:
        """Notify the users of a loss; called in the event loop."""
        if self._loss is not None:
            return
        self._loss = cause
        self._fail_pending(cause)
        for number, on_loss in tuple(self._users.items()):
            if number not in self._notified:
                self._notified.add(number)
                on_loss(cause)

    async def _shut(self) -> None:
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()
            await opened.wait_closed()

    @abstractmethod
    async def _open(self) -> _OpenT:
        """Open the port or adapter; raises LinkError."""

    def _fail_pending(self, cause: str) -> None:
        """Fail pending requests."""
        return


_LineT = TypeVar("_LineT", bound=SharedLine[Any])

_LINES: "WeakKeyDictionary[asyncio.AbstractEventLoop, dict[Hashable, SharedLine[Any]]]" = (
    WeakKeyDictionary()
)


def shared_line(kind: type[_LineT], key: Hashable, make: Callable[[], _LineT]) -> _LineT:
    """Return the line of this kind and key in the running event loop, a new one if unused."""
    lines = _LINES.setdefault(asyncio.get_running_loop(), {})
    line = lines.get((kind, key))
    if not isinstance(line, kind):
        line = lines[kind, key] = make()
    return line


def _forget(line: SharedLine[Any]) -> None:
    lines = _LINES.get(asyncio.get_running_loop(), {})
    for key in [key for key, known in lines.items() if known is line]:
        del lines[key]
