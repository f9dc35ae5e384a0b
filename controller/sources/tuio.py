"""TUIO 1.1 cursors and blobs (/tuio/2Dcur, /tuio/2Dblb) over UDP, as touch tables send them.

A bundle contains the name of its sender (source), the active session ids (alive), the changed
positions (set) and a sequence number (fseq), each for one profile; see tuio.org, "TUIO 1.1 Protocol
Specification". A blob also has a width and a height, relative to the sensor, which distinguish a
hand from a finger. Numbers of any type are accepted, and additional arguments are ignored. A
malformed message is counted, and the other messages of its bundle are read.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import islice, product
from typing import TypeAlias

from controller.sources.osc import Argument, osc_messages, read_message
from controller.sources.touch import Touch, TouchFrame
from controller.sources.udp_source import Datagram, Peer, UdpSource
from model.errors import InputError
from registry import threads
from registry.limits import MAX_CONTACTS

CURSORS = "/tuio/2Dcur"
BLOBS = "/tuio/2Dblb"
SERVED = (CURSORS, BLOBS)
"""Addresses of the supported profiles."""

_Key: TypeAlias = tuple[str, int]
"""Profile and session id of a contact."""

_KeyPair: TypeAlias = tuple[_Key, _Key]
"""Keys of a contact's cursor and blob; the same key twice for a contact that has only one."""

_NEAR = 0.02  # of the sensor: a cursor this close to the center of a small blob is the same contact
_PARTED = 4.0  # at this multiple of the distance they separate again; fast movement stays below it
_APART_IDS = 1 << 32  # added to the id of a contact with a duplicate id, above all ids of senders

# Unsupported addresses of TUIO 1.1 and 2.0; custom profiles have other addresses.
_PROFILE = re.compile(r"/(?:tuio/)?(tuio2|(?:2|25|3)D(?:cur|obj|blb))(?=/|$)")
_IDLE_ADDRESSES = ("/tuio2/frm", "/tuio2/alv")  # without a position

_MAX_MESSAGES = 256  # per datagram: some 4 ms, and ten times the maximum number of contacts
_MAX_NAME = 100  # characters; the rest is cut off
_MAX_SENDERS = 16
_SOURCE = b"source\0\0"  # OSC string, NUL-padded
# The reference client also takes a drop by more than 100 for a restart of the sender.
_LATE_FRAMES = 100
# Senders such as the reference implementation are silent while fingers rest; some repeat the alive
# message once a second.
DEFAULT_TIMEOUT = 3.0  # s
RESTART_PAUSE = 0.5
"""Time [s] without a datagram after which a sender may have been restarted.

Reordered frames are never this late.
"""

MUTE_AFTER = 10.0
"""Time [s] without cursors after which a sender that should send counts as mute."""

_MIN_REPEATS = 20  # consecutive frames without cursors, of a sender that repeats frames at rest


class _Advance(Enum):
    """How far a bundle advances the frame number of its sender, in the same profile."""

    UNNUMBERED = "no number, or a redundant bundle"
    SAME = "another part of the same frame"
    NEXT = "at most 100 frames later"
    LATER = "more than 100 frames later"
    EARLIER = "at most 100 frames earlier"
    FAR_EARLIER = "more than 100 frames earlier"


@dataclass
class _Profile:
    """Contacts of a profile, from a bundle or from all bundles of a sender."""

    alive: tuple[int, ...] | None = None  # until stated
    touches: dict[int, Touch] = field(default_factory=dict)  # by session id
    sequence: int = -1  # negative until numbered
    numbered_at: float = -math.inf  # s; when that number arrived
    last_heard: float = -math.inf  # s

    def advance_to(self, update: "_Profile") -> _Advance:
        """Return how far the frame number of an update advances."""
        advance = update.sequence - self.sequence
        if update.sequence < 0:
            return _Advance.UNNUMBERED
        if advance == 0:
            return _Advance.SAME
        if advance > 0:
            return _Advance.NEXT if advance <= _LATE_FRAMES else _Advance.LATER
        return _Advance.EARLIER if advance >= -_LATE_FRAMES else _Advance.FAR_EARLIER


@dataclass
class _Bundle:
    """Parsed messages of a bundle."""

    source: str | None = None
    profiles: dict[str, _Profile] = field(default_factory=dict)  # by address
    malformed: list[str] = field(default_factory=list)  # reasons for rejecting messages
    # Whether messages at unsupported addresses carry touches, by address.
    unsupported: dict[str, bool] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether it has all active contacts of its profiles, with their positions."""
        for profile in self.profiles.values():
            if profile.alive is None or not profile.touches.keys() >= {*profile.alive}:
                return False
        return bool(self.profiles)


_BundleKind: TypeAlias = tuple[Peer, bytes, bool, bool]
"""Sender, its name, and whether a bundle has cursors and blobs."""


@dataclass
class _Sender:
    """State of a sender."""

    last_heard: float
    peer: Peer  # its host and port
    former: Peer | None = None  # its previous host and port
    profiles: dict[str, _Profile] = field(default_factory=dict)  # by address
    ids: dict[_Key, int] = field(default_factory=dict)  # of its contacts, if it sends blobs
    resting: int = 0  # consecutive frames without contacts

    def has_paused(self, now: float) -> bool:
        """Whether it has been silent for so long that it may have been restarted."""
        return now - self.last_heard >= RESTART_PAUSE

    def continues_with(self, bundle: _Bundle) -> bool:
        """Whether the frame numbers of a bundle, if any, follow the latest ones."""
        for address, update in bundle.profiles.items():
            profile = self.profiles.get(address)
            if profile is not None:
                advance = profile.advance_to(update)
                if advance not in (_Advance.UNNUMBERED, _Advance.NEXT):
                    return False
        return True

    def take(self, changed: Mapping[str, _Profile], peer: Peer, now: float) -> None:
        """Store the profiles that a bundle from a peer has changed."""
        self.profiles |= changed
        self.last_heard = now
        if self.peer != peer:
            self.former = self.peer
            self.peer = peer

    def contacts(self, *, since: float) -> dict[_KeyPair, Touch]:
        """Return the touches of profiles received since a time [s], by cursor and blob.

        A contact that is both a cursor and a blob is a cursor with the blob's size, and keeps its
        id as long as the cursor or the blob is alive.
        """
        received: dict[_Key, Touch] = {}
        for address, profile in self.profiles.items():
            if profile.last_heard > since:
                for number, touch in profile.touches.items():
                    received[address, number] = touch
        if BLOBS not in self.profiles:
            return {(key, key): touch for key, touch in received.items()}
        blobs = _blobs_of_cursors(received, self.ids)
        unpaired = [key for key in received if key not in blobs.values()]
        unpaired.sort(key=lambda key: key not in self.ids)
        contacts: dict[_KeyPair, Touch] = {}
        ids = set[int]()
        for key in unpaired:
            blob_key = blobs.get(key, key)
            touch = received[key]
            id = self.ids.get(key, self.ids.get(blob_key, touch.id))
            while id in ids:
                id += _APART_IDS
            ids.add(id)
            contacts[key, blob_key] = replace(touch, id=id, size=received[blob_key].size)
        return contacts

    def remember(self, contacts: Mapping[_KeyPair, Touch]) -> None:
        """Remember the ids of the contacts in a frame, and whether there are any."""
        if BLOBS in self.profiles:
            self.ids = {}
            for keys, touch in contacts.items():
                self.ids |= dict.fromkeys(keys, touch.id)
        self.resting = 0 if contacts else self.resting + 1


def _blobs_of_cursors(
    touches: Mapping[_Key, Touch], former_ids: Mapping[_Key, int]
) -> dict[_Key, _Key]:
    """Match blobs to cursors: first the previous matches, then the nearest ones.

    former_ids: ids of contacts. Compares at most the maximum number of contacts.
    """
    cursors = [key for key in touches if key[0] == CURSORS][:MAX_CONTACTS]
    blobs = [key for key in touches if key[0] == BLOBS][:MAX_CONTACTS]
    candidates = []
    for cursor, blob in product(cursors, blobs):
        were_paired = cursor in former_ids and former_ids[cursor] == former_ids.get(blob)
        distance = _relative_distance(touches[cursor], touches[blob])
        if distance <= (_PARTED if were_paired else 1.0):
            candidates.append((not were_paired, distance, cursor, blob))
    pairs: dict[_Key, _Key] = {}
    for _, _, cursor, blob in sorted(candidates):
        if cursor not in pairs and blob not in pairs.values():
            pairs[cursor] = blob
    return pairs


def _relative_distance(cursor: Touch, blob: Touch) -> float:
    """Return the distance of a cursor from the center of a blob, relative to the blob's radius."""
    radius = max(_NEAR, min(blob.size or (0.0,)) / 2)
    return math.dist((cursor.x, cursor.y), (blob.x, blob.y)) / radius


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
        self._unsupported: set[str] = set()  # profiles received
        self._senders: dict[str, _Sender] = {}

    @property
    def problem(self) -> str | None:
        """Why no contacts arrive although the port is bound, and the remedy."""
        if not self.is_mute(since=self.opened, now=threads.now()):
            return None
        instead = ""
        if self._unsupported:
            instead = f" ({', '.join(sorted(self._unsupported))} arrives instead)"
        return (
            f"no {' or '.join(SERVED)} on UDP {self.host}:{self.port} for {MUTE_AFTER:g} s"
            f"{instead}; start the sender, and "
            "configure it to send TUIO 1.1 cursors or blobs to this address"
        )

    def read(self, datagram: bytes, peer: Peer, arrived: float) -> TouchFrame | None:
        """Return the frame that a datagram, arriving at a time [s], completes, or None.

        A contact that is alive but was never set is omitted; positions can be NaN.
        """
        bundle = _read_bundle(datagram)
        self._count(bundle, peer)
        if not bundle.profiles:
            return None
        name = self._name(bundle, peer, arrived)
        sender = self._sender(name, peer, arrived)
        if sender is None:
            return None
        changed: dict[str, _Profile] = {}
        for address, update in bundle.profiles.items():
            profile = sender.profiles.get(address, _Profile())
            updated = self._updated(profile, update, name, arrived)
            if updated is not None:
                changed[address] = updated
        if not changed:
            return None
        sender.take(changed, peer, arrived)
        contacts = sender.contacts(since=arrived - self.timeout)
        sender.remember(contacts)
        touches = tuple(contacts.values())
        origin = f"tuio:{peer[0]}:{peer[1]}"
        return TouchFrame(name, arrived, touches, self.timeout, origin=origin)

    def drop_superseded(self, waiting: Sequence[Datagram]) -> list[Datagram]:
        """Return the waiting datagrams, except those superseded by a newer bundle of their kind.

        Bundles of the same sender and profiles have the same kind. A bundle supersedes older
        ones if it is complete: it has all active contacts, with their positions.
        """
        current = []  # newest first
        is_complete: dict[_BundleKind, bool] = {}  # whether the newest bundle of a kind is
        for datagram in reversed(waiting):
            kind = _kind_of(datagram)
            if is_complete.get(kind, False):
                continue
            current.append(datagram)
            if kind not in is_complete:
                is_known = len(is_complete) < _MAX_SENDERS
                is_complete[kind] = is_known and _read_bundle(datagram.data).is_complete
        return current[::-1]

    def is_mute(self, *, since: float, now: float) -> bool:
        """Whether nothing was received since a time [s] although it should have been.

        Either no sender exists, or a sender that repeats frames without cursors has stopped.
        """
        if not self._senders:
            return now - since >= MUTE_AFTER
        last = max(self._senders.values(), key=lambda sender: sender.last_heard)
        return last.resting >= _MIN_REPEATS and now - last.last_heard >= MUTE_AFTER

    def _count(self, bundle: _Bundle, peer: Peer) -> None:
        """Count the unusable messages of a bundle: unsupported profiles and malformed messages."""
        place = f"{peer[0]}:{peer[1]}"
        for address, has_touches in bundle.unsupported.items():
            reason = "other_address"
            profile = _PROFILE.match(address)
            if profile:
                reason = f"profile_{profile[1]}"
                self._unsupported.add(profile[0])
            if has_touches:
                detail = f"{address:.80} of {place} arrives, {' and '.join(SERVED)} are served"
                self.rejects.count(reason, detail)
        for problem in bundle.malformed:
            self.rejects.count("malformed", f"message from {place}: {problem}")

    def _name(self, bundle: _Bundle, peer: Peer, now: float) -> str:
        """Return the name of a sender: host and source, and the port where these are not unique.

        A known name from another port is a restarted program, or a program that uses another port
        for each datagram and continues its frame numbers. It is a second program if its frame
        numbers do not continue the latest ones, or if the former port is heard again.
        """
        host, port = peer
        if bundle.source is None:
            return f"tuio:{host}:{port}"
        name_with_port = f"tuio:{host}:{port}/{bundle.source}"
        if name_with_port in self._senders:
            return name_with_port
        name = f"tuio:{host}/{bundle.source}"
        sender = self._senders.get(name)
        if sender is None or sender.peer == peer:
            return name
        is_same_program = sender.has_paused(now) or sender.continues_with(bundle)
        if sender.former != peer and is_same_program:
            return name
        ports = f"ports {sender.peer[1]} and {port}"
        self.rejects.count("same_name", f"{name} comes from {ports}; rename one of the programs")
        return name_with_port

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
        if self._senders[idle].has_paused(now):
            return idle
        counts = Counter(sender.peer for sender in self._senders.values())
        ((busiest, count),) = counts.most_common(1)
        if count <= counts[peer] + 1:
            return None
        return oldest(name for name, sender in self._senders.items() if sender.peer == busiest)

    def _updated(
        self, profile: _Profile, update: _Profile, name: str, now: float
    ) -> _Profile | None:
        """Update a profile of a sender from a bundle; None if a newer frame came before.

        Bundles without a number and redundant bundles (-1) are never late; a frame split over
        several bundles repeats its number.
        """
        sequence = profile.sequence
        numbered_at = profile.numbered_at
        if update.sequence >= 0:
            sequence = update.sequence
            numbered_at = now
        match profile.advance_to(update):
            case _Advance.EARLIER if now - profile.numbered_at < RESTART_PAUSE:
                detail = f"frame {update.sequence} of {name} after {profile.sequence}"
                self.rejects.count("late", detail)
                return None
            case _Advance.EARLIER | _Advance.FAR_EARLIER:
                profile = _Profile()  # the sender was restarted
        alive = profile.alive
        if update.alive is not None:
            alive = tuple(dict.fromkeys(update.alive))
        touches = profile.touches | update.touches
        ids: Iterable[int] = update.touches
        if alive is not None:
            ids = [id for id in alive if id in touches]
        active_touches = {id: touches[id] for id in islice(ids, _MAX_MESSAGES)}
        return _Profile(alive, active_touches, sequence, numbered_at, now)


def _kind_of(datagram: Datagram) -> _BundleKind:
    """Return the kind of a bundle without decoding it."""
    _, _, after_source = datagram.data.partition(_SOURCE)
    name = after_source.partition(b"\0")[0]
    has_cursors = CURSORS.encode() in datagram.data
    has_blobs = BLOBS.encode() in datagram.data
    return datagram.peer, name, has_cursors, has_blobs


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
        has_touches = not is_idle and address not in _IDLE_ADDRESSES
        bundle.unsupported[address] = has_touches or bundle.unsupported.get(address, False)
    for address, profile in tuple(bundle.profiles.items()):
        if profile.alive is None and not profile.touches:
            del bundle.profiles[address]
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
