"""Touch sources over UDP: their URLs, and datagrams with their times of arrival.

The event loop's own endpoint reads one datagram per iteration and timestamps only the read: touches
would be outdated and the queueing delay unmeasured. Here one iteration reads all waiting datagrams
and delivers the backlog in slices of at most 0.25 ms. On Linux the kernel timestamps each
datagram. In a flood the newest are kept; the kernel would keep the oldest.
"""

import asyncio
import contextlib
import logging
import math
import re
import socket
import struct
import sys
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import ClassVar, NamedTuple, TypeAlias

from controller.sources.touch import (
    CONTACT_TIMEOUT,
    MAX_CONTACT_TIMEOUT,
    TouchFrame,
    TouchSource,
    frame_moment,
    number_option,
)
from model.errors import InputError
from registry import threads

MAX_ITERATION_TIME = 0.00025  # s; longest delay of other tasks by a flood
MAX_DATAGRAM = 65_507  # bytes; UDP over IPv4
BACKLOG_THRESHOLD = 16  # waiting datagrams; from here on superseded ones are dropped
_MAX_WAITING = 512  # also read per iteration; the oldest are dropped

Peer: TypeAlias = tuple[str, int]
DatagramCallback: TypeAlias = Callable[[bytes, Peer, float], None]
"""Called with a datagram, its sender's host and port, and its arrival [s] by the loop's clock."""


class Datagram(NamedTuple):
    """A datagram, its sender and its arrival [s]."""

    data: bytes
    peer: Peer
    arrived: float


DropSuperseded: TypeAlias = Callable[[Sequence[Datagram]], Iterable[Datagram]]
"""Returns the waiting datagrams, in order, that no later one supersedes."""

_logger = logging.getLogger(__name__)

_TIMESTAMPS = 35  # SO_TIMESTAMPNS and SCM_TIMESTAMPNS of Linux, which Python does not name
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY = 64  # bytes; room for a timestamp and its header


class Datagrams:
    """Listens on a bound UDP socket until it is closed; see `listen`."""

    def __init__(
        self,
        endpoint: socket.socket,
        received: DatagramCallback,
        *,
        max_size: int,
        drop_superseded: DropSuperseded,
    ) -> None:
        self.failures = 0
        """Number of datagrams whose callback raised an exception; the first one is logged."""
        self._socket = endpoint
        self._received = received
        self._drop_superseded = drop_superseded
        self._waiting: deque[Datagram] = deque(maxlen=_MAX_WAITING)
        self._is_due = False
        self._buffer_size = max_size + 1  # so that the size reveals a larger datagram
        self._loop = asyncio.get_running_loop()
        self._latest = self._loop.time()
        if sys.platform == "linux":
            with contextlib.suppress(OSError):
                endpoint.setsockopt(socket.SOL_SOCKET, _TIMESTAMPS, 1)
        self._loop.add_reader(endpoint, self._readable)

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Stop listening."""
        self._loop.remove_reader(self._socket)
        self._socket.close()

    def _readable(self) -> None:
        """Read all waiting datagrams; reading costs a tenth of decoding."""
        offset = _clock_offset(self._loop.time)
        for _ in range(_MAX_WAITING):
            try:
                data, ancillary, _, peer = self._socket.recvmsg(self._buffer_size, _ANCILLARY)
            except OSError:  # nothing more, or an ICMP error
                break
            at = (str(peer[0]), int(peer[1]))
            self._waiting.append(Datagram(data, at, self._arrival(ancillary, offset)))
        if len(self._waiting) > BACKLOG_THRESHOLD:
            self._waiting = deque(self._drop_superseded(self._waiting), maxlen=_MAX_WAITING)
        if not self._is_due:
            self._deliver_backlog()

    def _deliver_backlog(self) -> None:
        """Deliver the waiting datagrams, a large backlog in slices."""
        self._is_due = False
        end = time.perf_counter() + MAX_ITERATION_TIME
        while self._waiting and self._socket.fileno() >= 0:  # the callback may close it
            self._deliver(self._waiting.popleft())
            if len(self._waiting) > BACKLOG_THRESHOLD and time.perf_counter() >= end:
                break
        if self._waiting and self._socket.fileno() >= 0:
            self._is_due = True
            self._loop.call_soon(self._deliver_backlog)

    def _deliver(self, datagram: Datagram) -> None:
        """Deliver a datagram; an exception must not hold up the next one, which may be a lift."""
        try:
            self._received(*datagram)
        except Exception:  # a bug
            self.failures += 1
            if self.failures == 1:
                host, port = datagram.peer
                _logger.exception("datagram from %s:%d: dropped because of a bug", host, port)

    def _arrival(self, ancillary: list[tuple[int, int, bytes]], offset: float) -> float:
        """Return the arrival of a datagram, never before the previous one.

        offset [s]: offset of the loop's clock to the system clock.
        """
        now = arrived = self._loop.time()
        for level, kind, content in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _TIMESTAMPS) and len(content) == _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack(content)
                arrived = seconds + nanoseconds * 1e-9 + offset
        self._latest = max(self._latest, frame_moment(arrived, now))
        return self._latest


def _clock_offset(clock: Callable[[], float]) -> float:
    """Return the offset [s] of a clock to the system clock."""
    # Of three readings the largest: least time has passed between its two clocks.
    return max(clock() - time.time() for _ in range(3))


async def listen(
    host: str,
    port: int,
    received: DatagramCallback,
    *,
    max_size: int,
    drop_superseded: DropSuperseded = tuple,
) -> Datagrams:
    """Listen on a host and UDP port, 0 for any that is free; raises OSError.

    max_size: bytes of the longest datagram; longer ones are cut to one byte more. drop_superseded:
    drops superseded datagrams where many wait.
    """
    loop = asyncio.get_running_loop()
    addresses = await loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    family, kind, protocol, _, address = addresses[0]
    endpoint = socket.socket(family, kind, protocol)
    try:
        endpoint.setblocking(False)
        endpoint.bind(address)
        return Datagrams(endpoint, received, max_size=max_size, drop_superseded=drop_superseded)
    except BaseException:
        endpoint.close()
        raise


DEFAULT_HOST = "127.0.0.1"
_PORT = re.compile(r"[0-9]{1,5}")


class UdpSource(TouchSource):
    """Listens at `SCHEME:HOST:PORT`, or `SCHEME:PORT` of 127.0.0.1, and reads each datagram.

    A panel on another machine needs an explicit HOST: datagrams have no authentication.
    `?timeout=SECONDS`: how long a resting finger stays without a frame. Raises InputError for any
    other URL, and in `run` if the port is taken.
    """

    default_port: ClassVar[str] = ""
    """Port of URLs without one; empty if they must have one."""
    default_timeout: ClassVar[float] = CONTACT_TIMEOUT
    """Timeout [s] of URLs without one."""
    max_size: ClassVar[int] = MAX_DATAGRAM
    """Bytes of the longest datagram; longer ones are cut to one byte more."""

    def __init__(self, url: str) -> None:
        self._url = url
        self.opened = math.inf
        """When the port was bound [s]."""
        address, _, options = url.partition("?")
        scheme, _, host_and_port = address.partition(":")
        host, _, port = host_and_port.removeprefix("//").rpartition(":")
        self.host = host.strip("[]") or DEFAULT_HOST
        port = port or self.default_port
        if not _PORT.fullmatch(port) or int(port) > 65535:
            raise InputError(
                f"touch source must be {scheme}:HOST:PORT with a port from 0 to 65535, such as "
                f"{scheme}:{DEFAULT_HOST}:{self.default_port or 3333}, got {url}"
            )
        self.port = int(port)
        self.timeout = number_option(options, "timeout", default=self.default_timeout)
        """Time [s] that `read` gives its frames."""
        if not CONTACT_TIMEOUT <= self.timeout <= MAX_CONTACT_TIMEOUT:  # NaN is not
            raise InputError(
                f"touch source {url}: options must be ?timeout=SECONDS from {CONTACT_TIMEOUT:g} to "
                f"{MAX_CONTACT_TIMEOUT:g}, got ?{options}"
            )

    @abstractmethod
    def read(self, datagram: bytes, peer: Peer, arrived: float) -> TouchFrame | None:
        """Return the frame that a datagram completes, or None.

        peer: host and port of the sender; arrived [s]: the time of the frame. Malformed input must
        be counted in `rejects`, not raised.
        """

    def drop_superseded(self, waiting: Sequence[Datagram]) -> Iterable[Datagram]:
        """Return the waiting datagrams, in order, that no later one supersedes."""
        return waiting

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver a frame per datagram until cancelled."""

        def received(datagram: bytes, peer: Peer, arrived: float) -> None:
            frame = self.read(datagram, peer, arrived)
            if frame is not None:
                deliver(frame)

        try:
            endpoint = await listen(
                self.host,
                self.port,
                received,
                max_size=self.max_size,
                drop_superseded=self.drop_superseded,
            )
        except OSError as error:
            raise InputError(
                f"touch source {self._url}: cannot bind UDP {self.host}:{self.port} "
                f"({error.strerror}); stop the program that uses it, or choose another port or "
                "address of this machine"
            ) from error
        self.opened = threads.now()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            endpoint.close()
