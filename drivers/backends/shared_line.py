"""What several amplifiers of a process are on: opened by the first, closed by the last."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from typing import Any, ClassVar, Generic, TypeVar
from weakref import WeakKeyDictionary

from drivers.backends.hardware import Adapter, Port
from drivers.errors import LinkError

_OpenT = TypeVar("_OpenT", bound=Port | Adapter)


class SharedLine(ABC, Generic[_OpenT]):
    """A serial line, a Modbus line or a CAN bus; whoever is on it is known by a number.

    Who comes while it is opened or closed waits for that. A loss is one for all who are on it until
    each joins again; the first of them opens it anew. place: its name for people.
    """

    number: ClassVar[str]
    """What the number is called on this wire."""

    def __init__(self, place: str) -> None:
        self.place = place
        self._users: dict[int, Callable[[str], None]] = {}
        self._told: set[int] = set()  # of the loss, and not back since
        self._loss: str | None = None
        self._opened: _OpenT | None = None
        self._changing = asyncio.Lock()  # held while it is opened or closed

    async def join(self, number: int, on_loss: Callable[[str], None]) -> None:
        """Be on it from now on; on_loss: told once, in the event loop, why it was lost.

        Raises LinkError: where it cannot be opened, and for a number that is in use.
        """
        if number in self._users:
            raise LinkError(
                f"{self.number} {number} on {self.place}: this program has it open already; give "
                f"every amplifier there a {self.number} of its own"
            )
        self._users[number] = on_loss
        try:
            async with self._changing:
                if self._loss is not None:
                    await self._shut()
                if self._opened is None:
                    self._loss = None
                    self._opened = await self._open()
                self._told.discard(number)  # of a loss while this one waited to be on it
        except BaseException:
            await self.leave(number)
            raise

    async def leave(self, number: int) -> None:
        """Be on it no longer; the last to go closes it. Safe to call twice."""
        self._users.pop(number, None)
        self._told.discard(number)
        if self._users:
            return
        self._give_up(f"{self.place} was closed")
        async with self._changing:
            if not self._users:  # nobody has come meanwhile
                await self._shut()
        if not self._users:
            _forget(self)

    def raise_if_lost(self, number: int | None = None) -> None:
        """Raise LinkError where it is lost, or was, and this one is not back since.

        To be called when something goes out: it may have waited while others opened it anew.
        """
        if self._loss is not None:
            raise LinkError(self._loss)
        if number in self._told:
            raise LinkError(
                f"{self.place} was lost, and {self.number} {number} is not back on it; open that "
                "amplifier again"
            )

    def _ready(self) -> _OpenT:
        """What is open, for whoever sends; LinkError where nothing is, or it is lost."""
        self.raise_if_lost()
        opened = self._opened  # a thread may ask while it is closed
        if opened is None:
            raise LinkError(f"{self.place} is not open; open the amplifier first")
        return opened

    def _lose(self, what: str) -> None:
        """It is gone; to be called in the event loop by what notices."""
        if self._loss is not None:
            return
        self._loss = what
        self._give_up(what)
        for number, on_loss in tuple(self._users.items()):
            if number not in self._told:
                self._told.add(number)
                on_loss(what)

    async def _shut(self) -> None:
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()
            await opened.wait_closed()

    @abstractmethod
    async def _open(self) -> _OpenT:
        """Open it; raises LinkError."""

    def _give_up(self, what: str) -> None:
        """End what still waits for an answer."""
        return


_LineT = TypeVar("_LineT", bound=SharedLine[Any])

_LINES: "WeakKeyDictionary[asyncio.AbstractEventLoop, dict[Hashable, SharedLine[Any]]]" = (
    WeakKeyDictionary()
)


def shared_line(kind: type[_LineT], key: Hashable, make: Callable[[], _LineT]) -> _LineT:
    """The line of this kind and key in the running event loop; made where nobody is on it yet."""
    lines = _LINES.setdefault(asyncio.get_running_loop(), {})
    line = lines.get((kind, key))
    if not isinstance(line, kind):
        line = lines[kind, key] = make()
    return line


def _forget(line: SharedLine[Any]) -> None:
    lines = _LINES.get(asyncio.get_running_loop(), {})
    for key in [key for key, known in lines.items() if known is line]:
        del lines[key]
