"""TUIO 1.1 cursors (/tuio/2Dcur) over UDP: what touch tables and their simulators send.

A bundle has the name of its sender (source), the session ids that are down (alive), the positions
of those that changed (set) and a sequence number (fseq); see tuio.org, "TUIO 1.1 Protocol
Specification". A bundle with any malformed message is ignored as a whole.
"""

import asyncio
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from controller.sources.contacts import CONTACT_TIMEOUT, MAX_CONTACT_TIMEOUT
from controller.sources.datagrams import Datagram, Peer, listen
from controller.sources.osc import OscError, osc_messages
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import Touch, TouchFrame, TouchSource, number_option
from model.errors import InputError

ADDRESS = "/tuio/2Dcur"
DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 3333  # registered for TUIO

# Room for some 140 cursors; senders keep below 4 KiB so that a datagram is not fragmented.
_MAX_DATAGRAM = 8 * 1024
_MAX_NAME = 100
_MAX_SENDERS = 16
_SOURCE = b"source\0\0"  # OSC string, NUL-padded
# Like the reference client, a sequence number that falls by more than 100 is a restarted sender. A
# restart within the first 100 frames shows by the pause: reordered frames are never this late.
_LATE_FRAMES = 100
_LATE_SECONDS = 0.5
# Senders such as the reference implementation are silent while fingers rest; some repeat the alive
# message once a second.
DEFAULT_TIMEOUT = 3.0  # s

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Bundle:
    """The messages of one bundle; None where missing."""

    source: str | None = None
    alive: tuple[int, ...] | None = None
    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    sequence: int | None = None


@dataclass
class _Sender:
    """The state of one sender; peer: the host and port that it was last heard from."""

    last_heard: float
    peer: Peer
    sequence: int = 0
    sequence_time: float = -math.inf  # when that sequence number arrived
    alive: tuple[int, ...] = ()
    positions: dict[int, tuple[float, float]] = field(default_factory=dict)


class TuioReader:
    """Decoder of datagrams into touch frames, without I/O; times are arguments.

    Senders are distinguished by the name in their source message and their host, or without a name
    by host and port; where there are too many, a sender of the busiest peer is dropped. Every
    bundle with cursors or an alive message confirms all contacts of its sender for the timeout [s].
    Never raises: unusable datagrams are counted in `rejects`.
    """

    def __init__(self, rejects: RejectCounter, *, timeout: float = DEFAULT_TIMEOUT) -> None:
        self.rejects = rejects
        self._timeout = timeout
        self._senders: dict[str, _Sender] = {}

    def read(self, datagram: bytes, peer: Peer, *, now: float) -> TouchFrame | None:
        """Return the frame that a datagram completes at now [s], or None.

        A cursor that is alive but was never set is omitted; positions may be NaN.
        """
        if len(datagram) > _MAX_DATAGRAM:
            self.rejects.count("oversized", f"{len(datagram)} bytes from {peer[0]}:{peer[1]}")
            return None
        try:
            bundle = _read_bundle(datagram)
        except OscError as error:
            self.rejects.count("malformed", f"datagram from {peer[0]}:{peer[1]}: {error}")
            return None
        if bundle == _Bundle(source=bundle.source):
            return None  # another TUIO profile, or an empty bundle
        name = f"tuio:{peer[0]}:{peer[1]}"
        if bundle.source is not None:
            name = f"tuio:{peer[0]}/{bundle.source}"
        sender = self._sender(name, peer, now)
        if sender is None or not self._accept_sequence(bundle.sequence, sender, name, now=now):
            return None
        for x, y in bundle.positions.values():
            if not (math.isfinite(x) and math.isfinite(y)):
                self.rejects.count("not_finite", f"{name} sent a cursor at ({x}, {y})")
        sender.last_heard, sender.peer = now, peer
        if bundle.alive is not None:
            sender.alive = tuple(dict.fromkeys(bundle.alive))
        known = sender.positions | bundle.positions
        sender.positions = {id: known[id] for id in sender.alive if id in known}
        touches = tuple(Touch(id, x, y) for id, (x, y) in sender.positions.items())
        return TouchFrame(name, now, touches, self._timeout, origin=f"tuio:{peer[0]}:{peer[1]}")

    def _sender(self, name: str, peer: Peer, now: float) -> _Sender | None:
        """Return the state of a sender, a new one if it is unknown, None if there are too many."""
        if name not in self._senders:
            if len(self._senders) >= _MAX_SENDERS:
                evicted = self._sender_to_evict(peer, now)
                if evicted is None:
                    self.rejects.count("too_many_senders", f"{name} is ignored")
                    return None
                del self._senders[evicted]
            self._senders[name] = _Sender(now, peer)
        return self._senders[name]

    def _sender_to_evict(self, peer: Peer, now: float) -> str | None:
        """Return the sender to drop for a new sender of this peer, or None.

        It is the one not heard from for longest if that has been idle, or else of the busiest peer.
        """

        def oldest(names: Iterable[str]) -> str:
            return min(names, key=lambda name: self._senders[name].last_heard)

        idle = oldest(self._senders)
        if now - self._senders[idle].last_heard >= _LATE_SECONDS:
            return idle
        counts = Counter(sender.peer for sender in self._senders.values())
        ((busiest, count),) = counts.most_common(1)
        if count <= counts[peer] + 1:
            return None
        return oldest(name for name, sender in self._senders.items() if sender.peer == busiest)

    def _accept_sequence(
        self, sequence: int | None, sender: _Sender, name: str, *, now: float
    ) -> bool:
        """Store a sequence number and return True, or False if a newer frame has arrived before.

        Bundles without a number and redundant ones (-1) are never late; a frame split over
        several bundles repeats its number.
        """
        if sequence is None or sequence < 0:
            return True
        behind = sender.sequence - sequence
        if behind > 0:
            if behind <= _LATE_FRAMES and now - sender.sequence_time < _LATE_SECONDS:
                self.rejects.count("late", f"frame {sequence} of {name} after {sender.sequence}")
                return False
            sender.alive, sender.positions = (), {}  # a restarted sender
        sender.sequence, sender.sequence_time = sequence, now
        return True


def _read_bundle(datagram: bytes) -> _Bundle:
    """Read the cursor messages of a datagram; raises OscError."""
    source: str | None = None
    alive: tuple[int, ...] | None = None
    positions: dict[int, tuple[float, float]] = {}
    sequence: int | None = None
    for arguments in osc_messages(datagram, address=ADDRESS):
        match arguments:
            case ("source", str(name)) if len(name) <= _MAX_NAME:
                source = name
            case ("alive", *ids) if all(isinstance(id, int) for id in ids):
                alive = tuple(int(id) for id in ids)
            case ("set", int(id), float(x), float(y), float(), float(), float()):
                positions[id] = (x, y)
            case ("fseq", int(number)):
                sequence = number
            case _:
                raise OscError(f"arguments must be those of TUIO 1.1, got {arguments!s:.80}")
    return _Bundle(source, alive, positions, sequence)


def without_superseded(waiting: Sequence[Datagram]) -> list[Datagram]:
    """Return waiting datagrams without those that the newest bundle of their sender supersedes.

    A bundle supersedes older ones if it is complete.
    """
    is_complete: dict[tuple[Peer, bytes], bool] = {}
    kept = []
    for each in reversed(waiting):
        sender = (each.peer, _source_name(each.data))
        if sender not in is_complete:
            is_complete[sender] = len(is_complete) < _MAX_SENDERS and _is_complete_bundle(each.data)
        elif is_complete[sender]:
            continue
        kept.append(each)
    return kept[::-1]


def _source_name(datagram: bytes) -> bytes:
    """Return the raw name in the source message of a datagram without decoding the rest."""
    _, found, rest = datagram.partition(_SOURCE)
    return rest.partition(b"\0")[0] if found else b""


def _is_complete_bundle(datagram: bytes) -> bool:
    """Whether a bundle has all cursors that are alive, with their positions."""
    if len(datagram) > _MAX_DATAGRAM:
        return False
    try:
        bundle = _read_bundle(datagram)
    except OscError:
        return False
    return bundle.alive is not None and set(bundle.alive) <= bundle.positions.keys()


class TuioSource(TouchSource):
    """Listens for TUIO at `tuio:HOST:PORT`, `tuio:PORT` or `tuio:` (127.0.0.1:3333).

    A touch table on another machine needs an explicit HOST, because TUIO has no authentication.
    `?timeout=SECONDS`: how long a resting finger stays without a bundle. Raises InputError for any
    other URL, and in `run` if the port is taken.
    """

    def __init__(self, url: str) -> None:
        address, _, options = url.partition("?")
        self.host, self.port = _host_and_port(address)
        self.rejects = RejectCounter(_logger)
        self._url = url
        self._reader = TuioReader(self.rejects, timeout=_timeout(url, options))

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver a frame per bundle until cancelled."""

        def received(datagram: bytes, peer: Peer, arrived: float) -> None:
            frame = self._reader.read(datagram, peer, now=arrived)
            if frame is not None:
                deliver(frame)

        try:
            endpoint = await listen(
                self.host,
                self.port,
                received,
                max_size=_MAX_DATAGRAM,
                drop_superseded=without_superseded,
            )
        except OSError as error:
            raise InputError(
                f"touch source {self._url}: cannot bind UDP {self.host}:{self.port} "
                f"({error.strerror}); stop the program that uses it, or choose another port"
            ) from error
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            endpoint.close()


def _timeout(url: str, options: str) -> float:
    """Return the timeout option [s] of a URL; raises InputError."""
    timeout = number_option(options, "timeout", default=DEFAULT_TIMEOUT)
    if not CONTACT_TIMEOUT <= timeout <= MAX_CONTACT_TIMEOUT:  # NaN is not
        raise InputError(
            f"touch source {url}: options must be ?timeout=SECONDS from {CONTACT_TIMEOUT:g} to "
            f"{MAX_CONTACT_TIMEOUT:g}, got ?{options}"
        )
    return timeout


def _host_and_port(url: str) -> tuple[str, int]:
    """Return host and port of `tuio:HOST:PORT`; raises InputError."""
    rest = url.removeprefix("tuio:").removeprefix("//")
    host, _, port = rest.rpartition(":")
    number = int(port) if port.isascii() and port.isdecimal() and len(port) < 6 else -1
    if not port:
        number = DEFAULT_PORT
    if not url.startswith("tuio:") or not 0 <= number < 65536:
        raise InputError(
            "touch source must be tuio:HOST:PORT with a port from 0 to 65535, such as "
            f"tuio:127.0.0.1:3333, got {url}"
        )
    return host.strip("[]") or DEFAULT_HOST, number
