"""TUIO 1.1 cursors and blobs (/tuio/2Dcur, /tuio/2Dblb) over UDP, as touch tables send them.

A bundle contains the name of its sender (source), the active session ids (alive), the changed
positions (set) and a sequence number (fseq), each for one profile; see tuio.org, "TUIO 1.1 Protocol
Specification". A blob also has a width and a height, relative to the sensor, which distinguish a
hand from a finger. Numbers of any type are accepted, and additional arguments are ignored. A
malformed message is counted, and the rest of its bundle is read. Messages use Open Sound Control
1.0 (opensoundcontrol.stanford.edu/spec-1_0.html) and come in untrusted datagrams.

A capture is a text file with the datagrams of a sender and their times, for replay:

    # era-haptics TUIO capture 1
    0.000000 2362756e646c6500...
    0.016667 2362756e646c6500...

Each line has the seconds from the start and the datagram in hexadecimal; other lines starting
with # are comments. Malformed datagrams are kept as received.
"""

import math
import re
import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from io import TextIOWrapper
from itertools import islice, product
from pathlib import Path
from typing import TextIO, TypeAlias

from controller.sources.touch import Touch, TouchFrame
from controller.sources.udp_source import MAX_DATAGRAM, Datagram, Peer, UdpSource
from model.errors import InputError
from registry import threads
from registry.files import LineTooLong, lines_of, open_regular
from registry.limits import MAX_CONTACTS

Argument: TypeAlias = str | int | float | None
"""Argument of a message; None for a blob, true, false, nil and impulse."""

_BUNDLE = b"#bundle\0"
_BUNDLE_HEADER = len(_BUNDLE) + 8  # the time tag is ignored: touches are current
_MAX_DEPTH = 8  # of nested bundles
_ADDRESS = re.compile(rb"/[!-~]*")
_RUNS = re.compile(rb"[sS]|b|[TFNI]+|[ifdhtcrm]+")
_CODES = bytes.maketrans(b"htcrm", b"qQiII")  # codes of `struct`, which already has i, f and d


def osc_messages(datagram: bytes, *, limit: int) -> list[bytes]:
    """Return the encoded messages of a datagram in order, for `read_message`; up to a limit.

    Elements that are neither message nor bundle are included; after an element whose size exceeds
    its bundle, the rest is one such element.
    """
    found, ends = list[bytes](), list[int]()  # of the bundles around an element
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


# Most messages of a panel repeat: its name, active contacts, resting fingers.
@lru_cache(maxsize=256)
def read_message(message: bytes) -> tuple[str, tuple[Argument, ...]]:
    """Return the address and the arguments of an encoded message; raises InputError.

    Bytes of a text that are not valid UTF-8 are written as \\xNN.
    """
    address = message.partition(b"\0")[0]
    at = len(address) // 4 * 4 + 4  # strings are padded with one to four zeros
    tags = message[at:].partition(b"\0")[0]
    runs = _RUNS.findall(tags)
    if not (_ADDRESS.fullmatch(address) and tags.startswith(b",")):
        raise InputError(f"element must be a message with argument types, got {message[:24]!r}")
    if b"".join(runs) != tags.translate(None, b",[]"):
        raise InputError(f"argument types must be letters of OSC 1.0, got {tags[:32]!r}")
    arguments: list[Argument] = []
    at += len(tags) // 4 * 4 + 4
    try:
        for run in runs:  # consecutive numbers in one step
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
        raise InputError(f"invalid message: {error}") from error
    return address.decode(), tuple(arguments)


CURSORS, BLOBS = SERVED = "/tuio/2Dcur", "/tuio/2Dblb"

_Key: TypeAlias = tuple[str, int]
"""Profile and session id of a contact."""

_NEAR = 0.02  # of the sensor: a cursor this close to the centre of a small blob is the same contact
_PARTED = 4.0  # at this multiple of the distance they separate again; fast movement stays below it
_APART_IDS = 1 << 32  # added to the id of a contact with a duplicate id, above all ids of senders

# Unsupported addresses of TUIO 1.1 and 2.0; custom profiles have other addresses.
_PROFILE = re.compile(r"/(?:tuio/)?(tuio2|(?:2|25|3)D(?:cur|obj|blb))(?=/|$)")
_IDLE_ADDRESSES = ("/tuio2/frm", "/tuio2/alv")  # without a position

_MAX_MESSAGES = 256  # per datagram: some 4 ms, and ten times the maximum number of contacts
_MAX_NAME = 100  # characters; the rest is cut off
_MAX_SENDERS = 16
_SOURCE = b"source\0\0"  # OSC string, NUL-padded
# As in the reference client, a sequence number that drops by more than 100 is a restarted sender.
# A pause reveals a restart within the first 100 frames: reordered frames are never this late.
_LATE_FRAMES = 100
# Senders such as the reference implementation are silent while fingers rest; some repeat the alive
# message once a second.
DEFAULT_TIMEOUT = 3.0  # s
RESTART_PAUSE = 0.5
"""Time [s] without a datagram after which a sender at another port counts as the same sender."""

MUTE_AFTER = 10.0
"""Time [s] without cursors after which a sender that should send counts as mute."""

_MIN_REPEATS = 20  # consecutive frames without cursors, of a sender that repeats frames at rest


@dataclass
class _Profile:
    """Contacts of one profile, from a bundle or from all bundles of a sender."""

    alive: tuple[int, ...] | None = None  # until stated
    touches: dict[int, Touch] = field(default_factory=dict)  # by session id
    sequence: int = -1  # negative until numbered
    numbered_at: float = -math.inf  # s; when that number arrived
    last_heard: float = -math.inf  # s


@dataclass
class _Bundle:
    """Parsed messages of a bundle."""

    source: str | None = None
    profiles: dict[str, _Profile] = field(default_factory=dict)  # by address
    malformed: list[str] = field(default_factory=list)  # reasons of rejected messages
    others: dict[str, bool] = field(
        default_factory=dict
    )  # unsupported addresses; whether they carry touches


@dataclass
class _Sender:
    """State of a sender."""

    last_heard: float
    peer: Peer  # its host and port
    former: Peer | None = None  # its previous address
    profiles: dict[str, _Profile] = field(default_factory=dict)  # by address
    ids: dict[_Key, int] = field(default_factory=dict)  # of its contacts, if it sends blobs
    resting: int = 0  # consecutive frames without contacts

    def touches(self, *, since: float) -> tuple[Touch, ...]:
        """Return the contacts of profiles received since a time [s].

        A contact that is both a cursor and a blob is a cursor with the blob's size, and keeps its
        id as long as either of them is alive.
        """
        known = {
            (address, number): touch
            for address, each in self.profiles.items()
            for number, touch in each.touches.items()
            if each.last_heard > since
        }
        if BLOBS not in self.profiles:
            return tuple(known.values())
        before, self.ids, found = self.ids, {}, dict[int, Touch]()
        pairs = _paired(known, before)
        alone = [each for each in known if each not in pairs.values()]
        for one in sorted(alone, key=lambda each: each not in before):
            two = pairs.get(one, one)
            id = before.get(one, before.get(two, known[one].id))
            while id in found:
                id += _APART_IDS
            self.ids[one] = self.ids[two] = id
            found[id] = replace(known[one], id=id, size=known[two].size)
        return tuple(found.values())


def _paired(known: Mapping[_Key, Touch], before: Mapping[_Key, int]) -> dict[_Key, _Key]:
    """Match blobs to cursors: first the previous matches, then the nearest ones.

    before: ids of contacts. Compares at most the maximum number of contacts.
    """
    near, pairs = list[tuple[bool, float, _Key, _Key]](), dict[_Key, _Key]()
    few = [[each for each in known if each[0] == of][:MAX_CONTACTS] for of in SERVED]
    for one, two in product(*few):
        cursor, blob = known[one], known[two]
        was_one = before.get(one, math.nan) == before.get(two, math.nan)
        radius = max(_NEAR, min(blob.size or (0.0,)) / 2)
        gap = math.dist((cursor.x, cursor.y), (blob.x, blob.y)) / radius
        if gap <= (_PARTED if was_one else 1.0):
            near.append((not was_one, gap, one, two))
    for _, _, one, two in sorted(near):
        if one not in pairs and two not in pairs.values():
            pairs[one] = two
    return pairs


class TuioSource(UdpSource):
    """Listens for TUIO at `tuio:HOST:PORT`, `tuio:PORT` or `tuio:` (127.0.0.1:3333).

    Senders are distinguished by the name in their source message and by host; without a name, or if
    programs send alternately under the same name, by host and port. Above the maximum number of
    senders, one of the busiest peer is dropped. Every bundle with contacts or an alive message
    confirms all contacts of its profile and sender for the timeout [s]. If a sender never sends
    alive messages, the contacts of a bundle are alive. Reading never raises: unusable input is
    counted in `rejects`.
    """

    default_port = "3333"  # registered for TUIO
    default_timeout = DEFAULT_TIMEOUT

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._others: set[str] = set()  # unsupported profiles received
        self._senders: dict[str, _Sender] = {}

    @property
    def problem(self) -> str | None:
        """Why no contacts arrive although the port is bound, and the remedy."""
        if not self.is_mute(since=self.opened, now=threads.now()):
            return None
        others = ", ".join(sorted(self._others))
        return (
            f"no {' or '.join(SERVED)} on UDP {self.host}:{self.port} for {MUTE_AFTER:g} s"
            f"{f' ({others} arrives instead)' if others else ''}; start the sender, and "
            "configure it to send TUIO 1.1 cursors or blobs to this address"
        )

    def read(self, datagram: bytes, peer: Peer, arrived: float) -> TouchFrame | None:
        """Return the frame that a datagram, arriving at a time [s], completes, or None.

        A contact that is alive but was never set is omitted; positions can be NaN.
        """
        bundle = _read_bundle(datagram)
        self._count(bundle, f"{peer[0]}:{peer[1]}")
        if not bundle.profiles:
            return None
        name = self._name(bundle, peer, arrived)
        sender = self._sender(name, peer, arrived)
        if sender is None:
            return None
        changed = dict[str, _Profile]()
        for address, new in bundle.profiles.items():
            known = sender.profiles.get(address, _Profile())
            if (added := self._added(new, known, name, arrived)) is not None:
                changed[address] = added
        if not changed:
            return None
        sender.profiles |= changed
        if sender.peer != peer:
            sender.former = sender.peer
        sender.last_heard, sender.peer = arrived, peer
        touches = sender.touches(since=arrived - self.timeout)
        sender.resting = 0 if touches else sender.resting + 1
        origin = f"tuio:{peer[0]}:{peer[1]}"
        return TouchFrame(name, arrived, touches, self.timeout, origin=origin)

    def drop_superseded(self, waiting: Sequence[Datagram]) -> list[Datagram]:
        """Return the waiting datagrams, except those superseded by a newer bundle of their kind.

        Bundles of one sender with the same profiles are of the same kind. A bundle supersedes older
        ones if it is complete: it has all active contacts, with their positions.
        """
        is_complete: dict[tuple[object, ...], bool] = {}
        kept = []
        for each in reversed(waiting):
            _, found, rest = each.data.partition(_SOURCE)
            profiles = [address.encode() in each.data for address in SERVED]
            kind = (each.peer, rest.partition(b"\0")[0] if found else b"", *profiles)
            if kind not in is_complete:
                stated = (
                    _read_bundle(each.data).profiles.values()
                    if len(is_complete) < _MAX_SENDERS
                    else ()
                )
                is_complete[kind] = bool(stated) and all(
                    one.alive is not None and one.touches.keys() >= {*one.alive} for one in stated
                )
            elif is_complete[kind]:
                continue
            kept.append(each)
        return kept[::-1]

    def is_mute(self, *, since: float, now: float) -> bool:
        """Whether nothing was received since a time [s] although it should have been.

        Either no sender exists, or a sender that repeats frames without cursors has stopped.
        """
        if not self._senders:
            return now - since >= MUTE_AFTER
        last = max(self._senders.values(), key=lambda sender: sender.last_heard)
        return last.resting >= _MIN_REPEATS and now - last.last_heard >= MUTE_AFTER

    def _count(self, bundle: _Bundle, place: str) -> None:
        """Count the unusable messages of a bundle from a sender: other profiles, malformed ones."""
        for address, has_touches in bundle.others.items():
            profile = _PROFILE.match(address)
            if profile:
                self._others.add(profile[0])
            if has_touches:
                self.rejects.count(
                    f"profile_{profile[1]}" if profile else "other_address",
                    f"{address:.80} of {place} arrives, {' and '.join(SERVED)} are served",
                )
        for problem in bundle.malformed:
            self.rejects.count("malformed", f"message from {place}: {problem}")

    def _name(self, bundle: _Bundle, peer: Peer, now: float) -> str:
        """Return the name of a sender: host and source, and the port where these are not unique.

        A known name from another port is a restarted program, or a program that uses another port
        for each datagram and continues its frame numbers. It is a second program if its frame
        numbers do not continue the latest ones, or if the former port is heard again.
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
        follows = all(
            new.sequence < 0
            or (former := known.profiles.get(address)) is None
            or 0 < new.sequence - former.sequence <= _LATE_FRAMES
            for address, new in bundle.profiles.items()
        )
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

        This is the sender silent for longest, if it is idle, or else one of the busiest peer.
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

    def _added(self, new: _Profile, known: _Profile, name: str, now: float) -> _Profile | None:
        """Update a profile of a sender from a bundle; None if a newer frame came before.

        Bundles without a number and redundant bundles (-1) are never late; a frame split over
        several bundles repeats its number.
        """
        sequence, numbered_at = known.sequence, known.numbered_at
        if new.sequence >= 0:
            if new.sequence < sequence:
                if sequence - new.sequence <= _LATE_FRAMES and now - numbered_at < RESTART_PAUSE:
                    self.rejects.count("late", f"frame {new.sequence} of {name} after {sequence}")
                    return None
                known = _Profile()  # the sender was restarted
            sequence, numbered_at = new.sequence, now
        alive = known.alive if new.alive is None else tuple(dict.fromkeys(new.alive))
        touches = known.touches | new.touches
        left = new.touches if alive is None else [id for id in alive if id in touches]
        few = {id: touches[id] for id in islice(left, _MAX_MESSAGES)}
        return _Profile(alive, few, sequence, numbered_at, now)


def _read_bundle(datagram: bytes) -> _Bundle:
    """Read the messages of a datagram."""
    bundle = _Bundle()
    messages = osc_messages(datagram, limit=_MAX_MESSAGES + 1)
    if len(messages) > _MAX_MESSAGES:
        bundle.malformed.append(f"bundle must have at most {_MAX_MESSAGES} messages")
    for message in messages[:_MAX_MESSAGES]:
        try:
            address, arguments = read_message(message)
            if address in SERVED:
                _read_contacts(bundle, address, arguments)
                continue
        except InputError as error:
            bundle.malformed.append(str(error))
            continue
        is_idle = arguments[:1] in (("source",), ("fseq",)) or arguments == ("alive",)
        is_idle |= address in _IDLE_ADDRESSES
        bundle.others[address] = not is_idle or bundle.others.get(address, False)
    stated = bundle.profiles.items()
    bundle.profiles = {key: each for key, each in stated if each.alive is not None or each.touches}
    return bundle


def _read_contacts(bundle: _Bundle, address: str, arguments: tuple[Argument, ...]) -> None:
    """Add a message of a profile to a bundle; raises InputError."""
    profile = bundle.profiles.setdefault(address, _Profile())
    match arguments:
        case ("source", str(name), *_):
            bundle.source = name[:_MAX_NAME]
        case ("alive", *ids):
            profile.alive = tuple(map(_whole, ids))
        case ("set", id, int(x) | float(x), int(y) | float(y), *_) if address == CURSORS:
            profile.touches[_whole(id)] = Touch(_whole(id), float(x), float(y))
        case (
            "set",
            id,
            int(x) | float(x),
            int(y) | float(y),
            _,
            int(w) | float(w),
            int(h) | float(h),
            *_,
        ):
            size = float(w), float(h)
            profile.touches[_whole(id)] = Touch(~_whole(id), float(x), float(y), size=size)
        case ("fseq", number, *_):
            profile.sequence = _whole(number)
        case _:
            raise InputError(f"arguments must be as in TUIO 1.1, got {arguments!s:.80}")


def _whole(value: Argument) -> int:
    """Convert a whole number of any type; raises InputError."""
    if not isinstance(value, int | float) or value % 1 != 0:  # NaN and infinity are not
        raise InputError(f"session ids and frame numbers must be whole, got {value!r:.40}")
    return int(value)


HEADER = "# era-haptics TUIO capture 1"
_LINE = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ((?:[0-9a-f]{2})+)", re.ASCII | re.IGNORECASE)
_MAX_LINE = 1 << 18  # characters; a datagram has up to 64 KiB, two digits per byte
MAX_BYTES = 16 << 20  # 100 s of ten fingers at 100 Hz; a quarter of an hour of one finger


@dataclass(frozen=True, slots=True)
class RecordedDatagram:
    """A datagram of a capture."""

    time: float
    """Time sent [s] from the start."""
    payload: bytes


def read_capture(path: Path | str) -> list[RecordedDatagram]:
    """Read a capture; raises InputError with file and line."""
    path = Path(path)
    try:
        with (
            open_regular(path, MAX_BYTES) as file,
            TextIOWrapper(file, "utf-8-sig", newline=None) as stream,
        ):
            return _datagrams_in(path, stream)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the path, which is relative to the "
            "working directory, and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be a TUIO capture, got a binary file") from error
    except LineTooLong as error:
        raise InputError(f"{path}, line {error.line}: {error} of a TUIO capture") from error


def _datagrams_in(path: Path, stream: TextIO) -> list[RecordedDatagram]:
    lines = lines_of(stream, _MAX_LINE)
    if next(lines, "") != HEADER:
        raise InputError(f"{path}, line 1: must be {HEADER!r} for a TUIO capture")
    datagrams: list[RecordedDatagram] = []
    for number, line in enumerate(lines, start=2):
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
