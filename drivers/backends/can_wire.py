"""A CAN bus that the amplifiers of a process share: one adapter, one thread that reads it.

`canopen` sorts what comes by identifier. It is fed here rather than by python-can's Notifier, which
spins on an adapter that was lost. Callbacks run in the reader's thread.
"""

import asyncio
import contextlib
import errno
import logging
import threading
from collections.abc import Callable, Sequence

import can
import canopen

from drivers.backends.can_interfaces import open_bus, send_all, wake
from drivers.backends.can_url import CanBusUrl
from drivers.errors import LinkError
from drivers.protocol.can_frame import CanFrame

_READ_TIMEOUT = 0.05  # s; how long the reader of a bus that cannot be woken notices its end
_BUS_OFF = 0x40  # of the class of an error frame, as SocketCAN numbers them
_OFF = "the adapter went bus-off; check wiring, termination and bit rate"
_TROUBLE = (can.CanError, OSError, ValueError, TypeError)  # TypeError: closed while it was read

for _library in ("can", "canopen"):  # what they have to say reaches users as errors of ours
    logging.getLogger(_library).addHandler(logging.NullHandler())


class _Network(canopen.Network):
    """What `canopen` sends, sent by the wire."""

    def __init__(self, wire: "CanWire") -> None:
        super().__init__()
        self._wire = wire

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._wire.send([CanFrame(can_id, bytes(data))])


class CanWire:
    """A bus, open from `acquire` to the last `release`; on_loss: whom to tell in the event loop."""

    def __init__(self, url: CanBusUrl, loop: asyncio.AbstractEventLoop) -> None:
        self.url = url
        self.network = _Network(self)
        self.on_loss: list[Callable[[str], None]] = []
        self.users = 0
        self.bad = 0
        self.loss: str | None = None
        self.opening = asyncio.Lock()
        self._loop = loop
        self._bus: can.BusABC | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._sending = threading.Lock()

    @property
    def is_open(self) -> bool:
        """Whether it is there."""
        return self._bus is not None and self.loss is None

    async def open(self) -> None:
        """Open the adapter and start reading; raises LinkError."""
        try:
            self._bus = await asyncio.to_thread(open_bus, self.url)
        except _TROUBLE as problem:
            raise LinkError(_why_not_open(self.url, problem)) from problem
        except ImportError as problem:
            raise LinkError(
                f"{self.url} cannot be opened: this system lacks what python-can needs for "
                f"{self.url.interface} ({problem})"
            ) from problem
        self._thread = threading.Thread(
            target=self._read, args=(self._bus,), name=f"era-can {self.url}", daemon=True
        )
        self._thread.start()

    async def close(self) -> None:
        """Close the adapter and end the reader."""
        self._closing.set()
        bus, thread = self._bus, self._thread
        if self.loss is None:
            self.loss = f"{self.url} was closed"
        if bus is None or thread is None:
            return
        wake(bus)
        await asyncio.to_thread(thread.join)
        self._bus = self._thread = None

    def send(self, frames: Sequence[CanFrame]) -> None:
        """Put frames on the bus, without another's in between; raises LinkError."""
        bus = self._bus
        if bus is None or self.loss is not None:
            raise LinkError(self.loss or f"{self.url} is not open")
        try:
            with self._sending:
                send_all(bus, frames)
        except _TROUBLE as problem:
            what = self._what_was_lost(problem)
            self._loop.call_soon_threadsafe(self._lose, what)
            raise LinkError(what) from problem

    def _read(self, bus: can.BusABC) -> None:
        """Read until the bus is closed or lost; runs in the reader's thread, and closes it."""
        problem: Exception | str = ""
        try:
            while not self._closing.is_set() and not problem:
                message = bus.recv(timeout=_READ_TIMEOUT)
                if message is not None:
                    problem = self._take(message)
        except _TROUBLE as error:
            problem = error
        finally:
            with contextlib.suppress(*_TROUBLE):
                bus.shutdown()
        if not self._closing.is_set():
            with contextlib.suppress(RuntimeError):  # of a loop that is closed: nobody waits
                self._loop.call_soon_threadsafe(self._lose, self._what_was_lost(problem))

    def _take(self, message: can.Message) -> str:
        """Pass a frame on; says what is wrong with the bus where it tells."""
        if message.is_error_frame:
            return _OFF if message.arbitration_id & _BUS_OFF else ""
        if not (message.is_remote_frame or message.is_extended_id):
            try:
                self.network.notify(message.arbitration_id, message.data, message.timestamp)
            except Exception:  # whatever a frame of somebody else's brings about, the next is read
                self.bad += 1
        return ""

    def _lose(self, what: str) -> None:
        if self.loss is not None:
            return
        self.loss = what
        _WIRES.pop(_key(self.url, self._loop), None)  # so that the next to come opens it anew
        self._closing.set()
        if self._bus is not None:
            wake(self._bus)
        for tell in tuple(self.on_loss):
            tell(what)

    def _what_was_lost(self, problem: Exception | str) -> str:
        return (
            f"the CAN bus {self.url} was lost ({problem}): check the adapter and the cable, then "
            "open the amplifier again"
        )


_WIRES: dict[tuple[int, CanBusUrl], CanWire] = {}


def _key(url: CanBusUrl, loop: asyncio.AbstractEventLoop) -> tuple[int, CanBusUrl]:
    return id(loop), url


async def acquire(url: CanBusUrl) -> CanWire:
    """The bus of this URL in the running loop, opened by the first who wants it; LinkError."""
    loop = asyncio.get_running_loop()
    wire = _WIRES.setdefault(_key(url, loop), CanWire(url, loop))
    wire.users += 1
    try:
        async with wire.opening:
            if not wire.is_open:
                await wire.open()
    except BaseException:
        await release(wire)
        raise
    return wire


async def release(wire: CanWire) -> None:
    """Leave a bus; the last to leave closes it."""
    wire.users -= 1
    if wire.users == 0:
        if _WIRES.get(_key(wire.url, wire._loop)) is wire:
            del _WIRES[_key(wire.url, wire._loop)]
        await wire.close()


def _why_not_open(url: CanBusUrl, problem: Exception) -> str:
    cause: BaseException | None = problem
    code = None
    while cause is not None and code is None:
        code = getattr(cause, "errno", None)
        cause = cause.__cause__ or cause.__context__
    if url.interface == "slcan" and code in (errno.EACCES, errno.EPERM):
        remedy = (
            "this user may not use the port; add the user to the group that owns it (often "
            "dialout: sudo usermod -aG dialout $USER) and log in again"
        )
    elif url.interface == "slcan" and code in (errno.EAGAIN, errno.EBUSY):
        remedy = "another program has the port open; close that one"
    elif url.interface == "slcan":
        remedy = "check the port's name, that the adapter is plugged in, and the bit rate"
    elif url.interface == "socketcand":
        remedy = "check address and port, that socketcand runs there, and that it serves this bus"
    elif url.interface == "socketcan":
        remedy = (
            f"check that the interface is there (ip link) and up: sudo ip link set {url.channel} "
            f"up type can bitrate {url.bitrate}"
        )
    else:
        remedy = "check its name"
    return f"CAN bus {url} cannot be opened: {remedy} (the system says: {problem})"
