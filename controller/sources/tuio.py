"""TUIO 1.1 cursors (/tuio/2Dcur) over UDP, as touch tables and their simulators send them.

A bundle has the name of its sender (source), the session ids that are down (alive), the positions
of those that changed (set) and a sequence number (fseq); see tuio.org, "TUIO 1.1 Protocol
Specification". Numbers count by their value, whatever their type, and further arguments are
ignored. A malformed message is counted, and the others of its bundle are read. Messages are those
of Open Sound Control 1.0 (opensoundcontrol.stanford.edu/spec-1_0.html), from untrusted datagrams.

A capture is a text file with the datagrams of a sender and their times, to be replayed:

    # era-haptics TUIO capture 1
    0.000000 2362756e646c6500...
    0.016667 2362756e646c6500...

Seconds from the start and the datagram in hexadecimal; further lines that start with # are
comments. Malformed datagrams are kept as received.
"""

import asyncio
import math
import re
import struct
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TypeAlias

from controller.sources.touch import RejectCounter, Touch, TouchFrame
from controller.sources.udp_source import MAX_DATAGRAM, Datagram, Peer, UdpSource
from drivers.errors import LinkError, system_message
from model.errors import InputError
from registry import threads
from registry.files import read_regular

Argument: TypeAlias = str | int | float | None
"""Argument of a message; None for a blob, and for true, false, nil and impulse."""

_BUNDLE = b"#bundle\0"
_BUNDLE_HEADER = len(_BUNDLE) + 8  # the time tag is ignored: touches are current
_MAX_DEPTH = 8  # of bundles in bundles
_ADDRESS = re.compile(rb"/[!-~]*")
_RUNS = re.compile(rb"[sS]|b|[TFNI]+|[ifdhtcrm]+")
_CODES = bytes.maketrans(b"htcrm", b"qQiII")  # of struct, which has those of i, f and d


class OscError(ValueError):
    """A message that cannot be read."""


def osc_messages(datagram: bytes, *, limit: int) -> list[bytes]:
    """Return the encoded messages of a datagram in order, for `read_message`; so many at most.

    What is neither a message nor a bundle is among them; what follows an element whose size exceeds
    its bundle is one such element.
    """
    found, ends = list[bytes](), list[int]()  # of the bundles that enclose an element
    at, end, is_whole = 0, len(datagram), True
    while len(found) < limit:
        is_bundle = end - at >= _BUNDLE_HEADER and datagram.startswith(_BUNDLE, at)
        if is_whole and is_bundle and len(ends) < _MAX_DEPTH:
            ends.append(end)
            at += _BUNDLE_HEADER
        else:
            found.append(datagram[at:end])
            at = end
        while ends and at == ends[-1]:
            ends.pop()
        if not ends:
            break
        size = int.from_bytes(datagram[at : at + 4], "big", signed=True)
        is_whole = 0 < size <= ends[-1] - at - 4
        at, end = (at + 4, at + 4 + size) if is_whole else (at, ends[-1])
    return found


# Most messages of a panel repeat: its name, the contacts that are alive, resting fingers.
@lru_cache(maxsize=256)
def read_message(message: bytes) -> tuple[str, tuple[Argument, ...]]:
    """Return the address and the arguments of an encoded message; raises OscError.

    Bytes of a text that are not UTF-8 are written as \\xNN.
    """
    address = message.partition(b"\0")[0]
    at = len(address) // 4 * 4 + 4  # texts are padded by one to four zeros
    tags = message[at:].partition(b"\0")[0]
    runs = _RUNS.findall(tags)
    if not (_ADDRESS.fullmatch(address) and tags.startswith(b",")):
        raise OscError(f"element must be a message with argument types, got {message[:24]!r}")
    if b"".join(runs) != tags.translate(None, b",[]"):
        raise OscError(f"argument types must be letters of OSC 1.0, got {tags[:32]!r}")
    arguments: list[Argument] = []
    at += len(tags) // 4 * 4 + 4
    try:
        for run in runs:  # numbers that follow each other at once
            if run in (b"s", b"S"):
                end = message.index(b"\0", at)
                arguments.append(message[at:end].decode(errors="backslashreplace"))
                at += (end - at) // 4 * 4 + 4
            elif run == b"b":
                (size,) = struct.unpack_from(">I", message, at)
                arguments.append(None)
                at += 4 + (size + 3) // 4 * 4
            elif run[0] in b"TFNI":
                arguments += [None] * len(run)
            else:
                layout = ">" + run.translate(_CODES).decode()
                arguments += struct.unpack_from(layout, message, at)
                at += struct.calcsize(layout)
    except (struct.error, ValueError) as error:
        raise OscError(f"invalid message: {error}") from error
    return address.decode(), tuple(arguments)


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
    """The messages of one bundle; None where missing."""

    source: str | None = None
    alive: tuple[int, ...] | None = None
    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    sequence: int | None = None
    malformed: list[str] = field(default_factory=list)  # why messages were refused
    others: dict[str, bool] = field(default_factory=dict)  # unserved addresses; if with touches


@dataclass
class _Sender:
    """The state of one sender."""

    last_heard: float
    peer: Peer  # its host and port
    former: Peer | None = None  # those before
    sequence: int = 0
    sequence_time: float = -math.inf  # when that sequence number arrived
    alive: tuple[int, ...] | None = None  # until stated
    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    resting: int = 0  # frames in a row without cursors


class TuioReader:
    """Decodes datagrams into touch frames, without I/O; times are arguments.

    Senders are distinguished by the name in their source message and their host, or without a name
    by host and port, as are programs that send under one name by turns. Beyond the most senders,
    one of the busiest peer is dropped. Every bundle with cursors or an alive message confirms all
    contacts of its sender for the timeout [s]. If a sender never states which cursors are alive,
    those of a bundle are. Never raises: unusable input is counted in `rejects`.
    """

    def __init__(self, rejects: RejectCounter, *, timeout: float = DEFAULT_TIMEOUT) -> None:
        self.rejects = rejects
        self.others: set[str] = set()
        """Profiles that were received and are not served."""
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

        That is no sender at all, or no more frames of one that has repeated itself without cursors.
        """
        if not self._senders:
            return now - since >= MUTE_AFTER
        last = max(self._senders.values(), key=lambda sender: sender.last_heard)
        return last.resting >= _MIN_REPEATS and now - last.last_heard >= MUTE_AFTER

    def _count(self, bundle: _Bundle, place: str) -> None:
        """Count the unusable messages of a bundle from a place: other profiles, malformed ones."""
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
        """Return the name of a sender: host and source, and the port where these are not unique.

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
        _, found, rest = each.data.partition(_SOURCE)
        sender = (each.peer, rest.partition(b"\0")[0] if found else b"")
        if sender not in is_complete:
            is_complete[sender] = len(is_complete) < _MAX_SENDERS and _is_complete_bundle(each.data)
        elif is_complete[sender]:
            continue
        kept.append(each)
    return kept[::-1]


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
        """The reader, made once a daemon has set its own counter of rejects."""
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
        """Return the datagrams that the newest bundle of their sender does not supersede."""
        return without_superseded(waiting)


HEADER = "# era-haptics TUIO capture 1"
_LINE = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ((?:[0-9a-f]{2})+)", re.ASCII | re.IGNORECASE)
MAX_BYTES = 16 << 20  # 100 s of ten fingers at 100 Hz; of one finger a quarter of an hour


@dataclass(frozen=True, slots=True)
class RecordedDatagram:
    """A datagram of a capture."""

    time: float
    """When it was sent [s] from the start."""
    payload: bytes


def read_capture(path: Path | str) -> list[RecordedDatagram]:
    """Read a capture; raises InputError with file and line."""
    path = Path(path)
    lines = _lines(path)
    if lines[0] != HEADER:
        raise InputError(f"{path}, line 1: must be {HEADER!r} for a TUIO capture")
    datagrams: list[RecordedDatagram] = []
    for number, line in enumerate(lines[1:], start=2):
        if line.startswith("#") or not line.strip():
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise InputError(
                f"{path}, line {number}: must be seconds, a space and the datagram in "
                f"hexadecimal, got {line[:60]!r}"
            )
        datagram = RecordedDatagram(float(match.group(1)), bytes.fromhex(match.group(2)))
        if len(datagram.payload) > MAX_DATAGRAM:
            raise InputError(
                f"{path}, line {number}: datagram must have at most {MAX_DATAGRAM} bytes, got "
                f"{len(datagram.payload)}"
            )
        if datagrams and datagram.time < datagrams[-1].time:
            raise InputError(f"{path}, line {number}: times must not decrease")
        datagrams.append(datagram)
    if not datagrams:
        raise InputError(f"{path}: capture must contain datagrams")
    return datagrams


def _lines(path: Path) -> list[str]:
    """Read the lines of a capture; raises InputError."""
    try:
        content = read_regular(path, MAX_BYTES)
        return content.decode("utf-8-sig").replace("\r\n", "\n").removesuffix("\n").split("\n")
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the path, which is relative to the "
            "working directory, and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be a TUIO capture, got a binary file") from error


async def replay_capture(datagrams: Sequence[RecordedDatagram], host: str, port: int) -> None:
    """Send datagrams to a UDP port at their recorded pace, on the event loop's clock.

    Raises LinkError if the port is closed.
    """
    loop = asyncio.get_running_loop()
    sender = _ReplaySocket()
    try:
        transport, _ = await loop.create_datagram_endpoint(lambda: sender, remote_addr=(host, port))
    except OSError as error:
        raise _refusal(host, port, error) from error
    try:
        start = loop.time()
        for datagram in datagrams:
            await asyncio.sleep(max(0.0, start + datagram.time - loop.time()))
            if sender.refused is not None:
                raise _refusal(host, port, sender.refused) from sender.refused
            transport.sendto(datagram.payload)
    finally:
        transport.close()


def _refusal(host: str, port: int, problem: Exception) -> LinkError:
    return LinkError(
        f"cannot send to UDP {host}:{port} ({system_message(problem)}); check the address, and "
        "start the controller first"
    )


class _ReplaySocket(asyncio.DatagramProtocol):
    """The UDP end of a replay; keeps an error that the network reported."""

    def __init__(self) -> None:
        self.refused: Exception | None = None

    def error_received(self, exc: Exception) -> None:
        """Keep the error."""
        self.refused = exc
