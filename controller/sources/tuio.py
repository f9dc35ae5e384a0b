"""TUIO 1.1 cursors (/tuio/2Dcur) over UDP: what touch tables and their simulators send.

A bundle has the name of its sender (source), the session ids that are down (alive), the positions
of those that changed (set) and a sequence number (fseq); see tuio.org, "TUIO 1.1 Protocol
Specification". Numbers count by their value, whatever their type; what follows the arguments that
are needed is ignored. A malformed message is counted, and the others of its bundle are read.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from controller.sources.datagrams import Datagram, Peer
from controller.sources.osc import Argument, OscError, osc_messages, read_message
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import Touch, TouchFrame
from controller.sources.udp_source import UdpSource
from registry import threads

ADDRESS = "/tuio/2Dcur"

# What is not served, of TUIO 1.1 and 2.0; a custom profile is another address.
_PROFILE = re.compile(r"/(?:tuio/)?(tuio2|(?:2|25|3)D(?:cur|obj|blb))(?=/|$)")
_IDLE_ADDRESSES = ("/tuio2/frm", "/tuio2/alv")  # without a position

_MAX_MESSAGES = 256  # of a datagram: some 4 ms, and ten times as many cursors as there are contacts
_MAX_NAME = 100  # characters; the rest is cut off
_MAX_SENDERS = 16
_SOURCE = b"source\0\0"  # OSC string, NUL-padded
# Like the reference client, a sequence number that falls by more than 100 is a restarted sender. A
# restart within the first 100 frames shows by the pause: reordered frames are never this late.
_LATE_FRAMES = 100
# Senders such as the reference implementation are silent while fingers rest; some repeat the alive
# message once a second.
DEFAULT_TIMEOUT = 3.0  # s
RESTART_PAUSE = 0.5
"""Time [s] without a datagram after which a sender at another port is the one of before."""

MUTE_AFTER = 10.0
"""Time [s] without cursors after which a sender that should be heard is mute."""

_MIN_REPEATS = 20  # frames without cursors in a row, of a sender that repeats itself at rest


@dataclass
class _Bundle:
    """The messages of one bundle; None where missing.

    malformed: why messages were refused; others: addresses that are not served, and whether they
    had touches.
    """

    source: str | None = None
    alive: tuple[int, ...] | None = None
    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    sequence: int | None = None
    malformed: list[str] = field(default_factory=list)
    others: dict[str, bool] = field(default_factory=dict)


@dataclass
class _Sender:
    """The state of one sender; peer, former: host and port of it, and before.

    alive: None until stated; resting: frames in a row without cursors.
    """

    last_heard: float
    peer: Peer
    former: Peer | None = None
    sequence: int = 0
    sequence_time: float = -math.inf  # when that sequence number arrived
    alive: tuple[int, ...] | None = None
    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    resting: int = 0


class TuioReader:
    """Decoder of datagrams into touch frames, without I/O; times are arguments.

    Senders are distinguished by the name in their source message and their host, or without a name
    by host and port, as are programs that send under one name by turns; where there are too many,
    a sender of the busiest peer is dropped. Every bundle with cursors or an alive message confirms
    all contacts of its sender for the timeout [s]. Of a sender that never states what is alive,
    that is what a bundle sets. Never raises: what is not used is counted in `rejects`.
    """

    def __init__(self, rejects: RejectCounter, *, timeout: float = DEFAULT_TIMEOUT) -> None:
        self.rejects = rejects
        self.others: set[str] = set()
        """Profiles that have come and are not served."""
        self._timeout = timeout
        self._senders: dict[str, _Sender] = {}

    def read(self, datagram: bytes, peer: Peer, *, now: float) -> TouchFrame | None:
        """Return the frame that a datagram completes at now [s], or None.

        A cursor that is alive but was never set is omitted; positions may be NaN.
        """
        bundle = _read_bundle(datagram)
        if bundle.others or bundle.malformed:
            self._count(bundle, f"{peer[0]}:{peer[1]}")
        if bundle.alive is None and not bundle.positions:
            return None
        name = self._name(bundle, peer, now)
        sender = self._sender(name, peer, now)
        if sender is None or not self._accept_sequence(bundle.sequence, sender, name, now=now):
            return None
        if sender.peer != peer:
            sender.former = sender.peer
        sender.last_heard, sender.peer = now, peer
        if bundle.alive is not None:
            sender.alive = tuple(dict.fromkeys(bundle.alive))
        known = sender.positions | bundle.positions
        alive = tuple(bundle.positions) if sender.alive is None else sender.alive
        sender.positions, touches = {}, list[Touch]()
        for id in alive:
            if id in known:
                sender.positions[id] = known[id]
                touches.append(Touch(id, *known[id]))
        sender.resting = 0 if alive else sender.resting + 1
        origin = f"tuio:{peer[0]}:{peer[1]}"
        return TouchFrame(name, now, tuple(touches), self._timeout, origin=origin)

    def is_mute(self, *, since: float, now: float) -> bool:
        """Whether nothing was read since a time [s] though it should have been.

        Nothing at all; or nothing more of a sender that has repeated itself without cursors.
        """
        if not self._senders:
            return now - since >= MUTE_AFTER
        last = max(self._senders.values(), key=lambda sender: sender.last_heard)
        return last.resting >= _MIN_REPEATS and now - last.last_heard >= MUTE_AFTER

    def _count(self, bundle: _Bundle, place: str) -> None:
        """Count what of a bundle from a place is not used: other profiles, malformed messages."""
        for address, has_touches in bundle.others.items():
            profile = _PROFILE.match(address)
            if profile:
                self.others.add(profile[0])
            if has_touches:
                self.rejects.count(
                    f"profile_{profile[1]}" if profile else "other_address",
                    f"{address:.80} of {place} arrives, {ADDRESS} is served",
                )
        for problem in bundle.malformed:
            self.rejects.count("malformed", f"message from {place}: {problem}")

    def _name(self, bundle: _Bundle, peer: Peer, now: float) -> str:
        """Return the name of a sender: of host and source, with the port where that is not unique.

        A name that comes from another port is that of a program that was restarted, or that takes
        another port for each datagram and goes on counting its frames. It is that of a second
        program if its frames do not follow those that came just before, or the former port is
        heard again.
        """
        own = f"tuio:{peer[0]}:{peer[1]}"
        if bundle.source is None:
            return own
        shared, own = f"tuio:{peer[0]}/{bundle.source}", f"{own}/{bundle.source}"
        if own in self._senders:
            return own
        known = self._senders.get(shared)
        if known is None or known.peer == peer:
            return shared
        sequence = -1 if bundle.sequence is None else bundle.sequence
        follows = sequence < 0 or 0 < sequence - known.sequence <= _LATE_FRAMES
        if known.former != peer and (follows or now - known.last_heard >= RESTART_PAUSE):
            return shared
        ports = f"ports {known.peer[1]} and {peer[1]}"
        self.rejects.count("same_name", f"{shared} comes from {ports}; rename one of the programs")
        return own

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
        if now - self._senders[idle].last_heard >= RESTART_PAUSE:
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
            if behind <= _LATE_FRAMES and now - sender.sequence_time < RESTART_PAUSE:
                self.rejects.count("late", f"frame {sequence} of {name} after {sender.sequence}")
                return False
            sender.alive, sender.positions = None, {}  # a restarted sender
        sender.sequence, sender.sequence_time = sequence, now
        return True


def _read_bundle(datagram: bytes) -> _Bundle:
    """Read the messages of a datagram."""
    bundle, cursors = _Bundle(), list[tuple[Argument, ...]]()
    messages = osc_messages(datagram, limit=_MAX_MESSAGES + 1)
    if len(messages) > _MAX_MESSAGES:
        bundle.malformed.append(f"bundle must have at most {_MAX_MESSAGES} messages")
    for message in messages[:_MAX_MESSAGES]:
        try:
            address, arguments = read_message(message)
        except OscError as error:
            bundle.malformed.append(str(error))
            continue
        if address == ADDRESS:
            cursors.append(arguments)
            continue
        is_idle = arguments[:1] in (("source",), ("fseq",)) or arguments == ("alive",)
        is_idle |= address in _IDLE_ADDRESSES
        bundle.others[address] = not is_idle or bundle.others.get(address, False)
    _read_cursors(bundle, cursors)
    return bundle


def _read_cursors(bundle: _Bundle, messages: Iterable[tuple[Argument, ...]]) -> None:
    """Add the messages of cursors, by their arguments, to a bundle."""
    for arguments in messages:
        try:
            match arguments:
                case ("source", str(name), *_):
                    bundle.source = name[:_MAX_NAME]
                case ("alive", *ids):
                    bundle.alive = tuple(map(_whole, ids))
                case ("set", id, int(x) | float(x), int(y) | float(y), *_):
                    bundle.positions[_whole(id)] = (float(x), float(y))
                case ("fseq", number, *_):
                    bundle.sequence = _whole(number)
                case _:
                    raise OscError(f"arguments must be those of TUIO 1.1, got {arguments!s:.80}")
        except OscError as error:
            bundle.malformed.append(str(error))


def _whole(value: Argument) -> int:
    """Return the value of a whole number of any type; raises OscError."""
    if not isinstance(value, int | float) or value % 1 != 0:  # NaN and infinity are not
        raise OscError(f"session ids and frame numbers must be whole, got {value!r:.40}")
    return int(value)


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
    bundle = _read_bundle(datagram)
    return bundle.alive is not None and set(bundle.alive) <= bundle.positions.keys()


class TuioSource(UdpSource):
    """Listens for TUIO at `tuio:HOST:PORT`, `tuio:PORT` or `tuio:` (127.0.0.1:3333)."""

    default_port = "3333"  # registered for TUIO
    default_timeout = DEFAULT_TIMEOUT

    @cached_property
    def _reader(self) -> TuioReader:
        """Made once a daemon has set its own counter of rejects."""
        return TuioReader(self.rejects, timeout=self.timeout)

    @property
    def problem(self) -> str | None:
        """Why no cursors come although the port is bound, and what to do."""
        if not self._reader.is_mute(since=self.opened, now=threads.now()):
            return None
        others = ", ".join(sorted(self._reader.others))
        return (
            f"no {ADDRESS} on UDP {self.host}:{self.port} for {MUTE_AFTER:g} s"
            f"{f' ({others} arrives instead)' if others else ''}; start the sender, and let it "
            "send TUIO 1.1 cursors to this address"
        )

    def read(self, datagram: bytes, peer: Peer, arrived: float) -> TouchFrame | None:
        """Return the frame of a bundle."""
        return self._reader.read(datagram, peer, now=arrived)

    def drop_superseded(self, waiting: Sequence[Datagram]) -> list[Datagram]:
        """Return those that the newest bundle of their sender does not supersede."""
        return without_superseded(waiting)
