"""Datagrams as they come in: all that have arrived at once, each with when it did.

An event loop's own endpoint reads one datagram in a turn, and knows only when it did so: a command
would be decided by what is old by then, and the time that a datagram has waited would not be seen.
Here a turn takes what is there and hands it on: a few all at once, for what came together is
decided together, of many as much as a quarter of a millisecond allows. The system says when each
came, where it does that (Linux). Where more come than can be handed on, the newest are what counts:
the system would keep the oldest. Where the loop watches no sockets (Windows), its endpoint serves.
"""

import asyncio
import contextlib
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeAlias

TURN = 0.00025  # s; as long as everybody else waits for a sender that floods
MANY = 16  # that wait: more than a panel sends in a turn; now those are left out that are moot
_MOST = 512  # that are read in a turn, and that wait; the oldest go first

Peer: TypeAlias = tuple[str, int]
Received: TypeAlias = Callable[[bytes, Peer, float], None]
"""Told of a datagram, the host and port it came from, and when [s], by the event loop's clock."""


class Datagram(NamedTuple):
    """What came, from where, and when [s]."""

    data: bytes
    peer: Peer
    arrived: float


Thin: TypeAlias = Callable[[Sequence[Datagram]], Iterable[Datagram]]
"""Which of the datagrams that wait, in their order, are not made moot by a later one."""

_TIMESTAMPS = 35  # SO_TIMESTAMPNS and SCM_TIMESTAMPNS of Linux, which Python does not name
_TIMESPEC = struct.Struct("@ll")
_LOOKS, _AT_ONCE = 3, 0.00005  # s; two clocks that are read further apart are read again
_LONGEST_WAIT = 1.0  # s; a system's clock that was set meanwhile must not make touches old


class Datagrams:
    """Listens on a UDP port until it is closed; see `listen`."""

    def __init__(
        self, line: socket.socket, received: Received, *, largest: int, thin: Thin
    ) -> None:
        self._line = line
        self._received = received
        self._thin = thin
        self._waiting: deque[Datagram] = deque(maxlen=_MOST)
        self._is_due = False
        self._most = largest + 1  # so that a larger one is known by its size
        self._loop = asyncio.get_running_loop()
        self._latest = self._loop.time()
        self._transport: asyncio.DatagramTransport | None = None

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self._line.getsockname()[1])

    async def begin(self) -> None:
        """Listen from now on."""
        if sys.platform == "linux":
            with contextlib.suppress(OSError):
                self._line.setsockopt(socket.SOL_SOCKET, _TIMESTAMPS, 1)
        try:
            self._loop.add_reader(self._line, self._readable)
        except NotImplementedError:
            self._transport, _ = await self._loop.create_datagram_endpoint(
                lambda: _Endpoint(self._received, self._loop), sock=self._line
            )

    def close(self) -> None:
        """Listen no more."""
        if self._transport is not None:
            self._transport.close()
            return
        self._loop.remove_reader(self._line)
        self._line.close()

    def _readable(self) -> None:
        """Take what has arrived; reading costs a tenth of what understanding does."""
        ahead = _ahead(self._loop.time)
        for _ in range(_MOST):
            try:
                data, ancillary, _, peer = self._line.recvmsg(self._most, _ANCILLARY)
            except OSError:  # there is nothing more, or what was sent from here was refused
                break
            at = (str(peer[0]), int(peer[1]))
            self._waiting.append(Datagram(data, at, self._arrival(ancillary, ahead)))
        if len(self._waiting) > MANY:
            self._waiting = deque(self._thin(self._waiting), maxlen=_MOST)
        if not self._is_due:
            self._hand_on()

    def _hand_on(self) -> None:
        """Hand on what waits, of many until the turn is over; the rest follows in the next ones."""
        self._is_due = False
        end = time.perf_counter() + TURN
        while self._waiting and self._line.fileno() >= 0:  # whoever receives may close it
            self._received(*self._waiting.popleft())
            if len(self._waiting) > MANY and time.perf_counter() >= end:
                break
        if self._waiting and self._line.fileno() >= 0:
            self._is_due = True
            self._loop.call_soon(self._hand_on)

    def _arrival(self, ancillary: list[tuple[int, int, bytes]], ahead: float) -> float:
        """When a datagram arrived, never before the one that was read before it.

        ahead [s]: how far the loop's clock is before the system's.
        """
        now = arrived = self._loop.time()
        for level, kind, content in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _TIMESTAMPS) and len(content) == _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack(content)
                arrived = seconds + nanoseconds * 1e-9 + ahead
        if not now - _LONGEST_WAIT <= arrived <= now:
            arrived = now
        self._latest = max(self._latest, arrived)
        return self._latest


def _ahead(clock: Callable[[], float]) -> float:
    """How far a clock is before the system's [s]; looked again where something came in between."""
    ahead = 0.0
    for _ in range(_LOOKS):
        before = clock()
        ahead = before - time.time()
        if clock() - before < _AT_ONCE:
            break
    return ahead


_ANCILLARY = 64  # bytes; room for a timestamp and its header


async def listen(
    host: str, port: int, received: Received, *, largest: int, thin: Thin = tuple
) -> Datagrams:
    """Listen on a host and UDP port, 0 for any that is free; raises OSError.

    largest: bytes of the longest datagram; of one that is longer a byte more is handed on. thin:
    asked what may be left out where many wait.
    """
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    family, kind, protocol, _, address = found[0]
    line = socket.socket(family, kind, protocol)
    try:
        line.setblocking(False)
        line.bind(address)
        made = Datagrams(line, received, largest=largest, thin=thin)
        await made.begin()
    except BaseException:
        line.close()
        raise
    return made


class _Endpoint(asyncio.DatagramProtocol):
    """What stands in where the loop watches no sockets."""

    def __init__(self, received: Received, loop: asyncio.AbstractEventLoop) -> None:
        self._received = received
        self._loop = loop

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Hand one datagram on."""
        self._received(data, (addr[0], addr[1]), self._loop.time())
