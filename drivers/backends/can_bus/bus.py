"""A CAN bus that the amplifiers of a process share: one adapter, and `canopen` sorts what comes.

It is fed here rather than by python-can's Notifier, which spins on an adapter that was lost.
Callbacks run in the adapter's thread.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence

import canopen

from drivers import clock
from drivers.backends.can_bus.adapter import open_adapter
from drivers.backends.stand_in import Adapter
from drivers.backends.urls.can_bus import CanBusUrl
from drivers.codec.can_bus.frame import CanFrame
from drivers.errors import LinkError

# What it has to say reaches users as errors of ours.
logging.getLogger("canopen").addHandler(logging.NullHandler())


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
        self._nodes: set[int] = set()
        self.bad = 0
        self.loss: str | None = None
        self.changing = asyncio.Lock()  # held while it is opened or closed
        self._loop = loop
        self._adapter: Adapter | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is there."""
        return self._adapter is not None and self.loss is None

    @property
    def is_used(self) -> bool:
        """Whether somebody has acquired it and not released it since."""
        return self.users > 0

    def claim(self, node: int) -> None:
        """Use the bus for a node; LinkError where this program does so already."""
        if node in self._nodes:
            raise LinkError(
                f"node {node} on {self.url}: this program has it open already; give every "
                "amplifier a node number of its own"
            )
        self._nodes.add(node)

    def give_back(self, node: int) -> None:
        """No longer use it for this node."""
        self._nodes.discard(node)

    async def open(self) -> None:
        """Open the adapter and start reading; raises LinkError."""
        self.loss = None
        self._adapter = await open_adapter(self.url, on_frame=self._take, on_loss=self._lose)

    async def close(self) -> None:
        """Close the adapter and end the reader."""
        adapter, self._adapter = self._adapter, None
        if self.loss is None:
            self.loss = f"{self.url} was closed"
        if adapter is not None:
            adapter.close()
            await adapter.wait_closed()

    def send(self, frames: Sequence[CanFrame]) -> None:
        """Put frames on the bus, without another's in between; raises LinkError."""
        if self._adapter is None or self.loss is not None:
            raise LinkError(self.loss or f"{self.url} is not open")
        self._adapter.send(frames)

    def _take(self, frame: CanFrame) -> None:
        """Pass a frame on, in the adapter's thread."""
        try:
            self.network.notify(frame.id, bytearray(frame.data), clock.now())
        except Exception:  # whatever a frame of somebody else's brings about, the next is read
            self.bad += 1

    def _lose(self, what: str) -> None:
        if self.loss is not None:
            return
        self.loss = what
        _WIRES.pop(_key(self.url, self._loop), None)  # so that the next to come opens it anew
        for tell in tuple(self.on_loss):
            tell(what)


_WIRES: dict[tuple[int, CanBusUrl], CanWire] = {}


def _key(url: CanBusUrl, loop: asyncio.AbstractEventLoop) -> tuple[int, CanBusUrl]:
    return id(loop), url


async def acquire(url: CanBusUrl) -> CanWire:
    """The bus of this URL in the running loop, opened by the first who wants it; LinkError."""
    loop = asyncio.get_running_loop()
    wire = _WIRES.setdefault(_key(url, loop), CanWire(url, loop))
    wire.users += 1
    try:
        async with wire.changing:
            if not wire.is_open:
                await wire.open()
    except BaseException:
        await release(wire)
        raise
    return wire


async def release(wire: CanWire) -> None:
    """Leave a bus; the last to leave closes it."""
    wire.users -= 1
    async with wire.changing:  # who comes meanwhile waits until the adapter is free
        if not wire.is_used:
            await wire.close()
        if not wire.is_used and _WIRES.get(_key(wire.url, wire._loop)) is wire:
            del _WIRES[_key(wire.url, wire._loop)]
