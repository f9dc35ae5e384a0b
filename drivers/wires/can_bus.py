"""CAN buses: the host's side of the wire, and the address of a node.

Requests are frames of words, matched by node and sequence number. Ports carry packed frames
(`drivers.wires.can_frames`): through python-can (`drivers.wires.can_interfaces`), or as text of an
adapter or server (`drivers.wires.can_text`).
"""

import random
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from drivers.errors import WireCounters
from drivers.protocol.definition import (
    BROADCAST,
    BY_NUMBER,
    MAX_WORDS,
    REQUESTS,
    VERSION,
    Message,
)
from drivers.protocol.records import Values
from drivers.urls import ADDRESS, AmplifierUrl, with_fragment
from drivers.wires.can_frames import (
    BITRATE,
    BLOCK,
    CANOPEN,
    ERROR_ID,
    NODE_MAX,
    NUMBER_MAX,
    REPLY,
    REQUEST,
    Assembler,
    CanFrame,
    cob_id,
    frame_time,
    frames_of,
    pack_frames,
    segments,
    unpack_frames,
)
from drivers.wires.wire import (
    Arrival,
    DuplicateAddress,
    OtherHost,
    Reply,
    Wire,
    WireAddress,
    read_event,
    read_reply,
)
from registry import threads

_KEPT = 3 * frames_of(MAX_WORDS)  # frames sent last, which an adapter may echo
_READ_VERSIONS = bytes((0x40, 0x00, 0x20, 5, 0, 0, 0, 0))  # upload of 2000:5, CiA 301 7.2.4.3.5
_VERSIONS_READ = bytes((0x4B, 0x00, 0x20, 5))  # two bytes of data follow
_BUS = (
    "that the amplifier is switched on and acknowledges, bit rate, wiring, termination, and the "
    "baud rate of a serial adapter"
)
_START: int = CANOPEN["nmt"]["start"]
_BITRATES = 10_000, 1_000_000
NODE_FORM = "node must be given as #{}"
NODE_RANGE = "`#NODE` 1 to 127"  # in tables


class _PendingRequest(NamedTuple):
    """A request to a node, under a number, whose reply is awaited."""

    node: int
    number: int
    message: Message

    def is_answered_by(self, node: int, data: bytes) -> bool:
        """Whether a frame of a node is a part of the reply."""
        return node == self.node and data[:1] == bytes([self.number])


class CanWire(Wire):
    """A bus at a bit rate [bit/s]; sequence: before the first request to a node, 0 to 255.

    delay [s]: of a network on the way to the bus.
    """

    def __init__(self, bitrate: int, *, sequence: int, delay: float = 0.0) -> None:
        self.counters = WireCounters()
        self.blocked = f"the adapter takes no frames: check {_BUS}"
        self.is_kept = True
        self.delay = delay
        self._frame_time = frame_time(bitrate)
        self._sequence = sequence
        self._numbers: dict[int, int] = {}  # last ones by node
        self._sent: deque[CanFrame] = deque(maxlen=_KEPT)
        self._pending: _PendingRequest | None = None
        self._requested = BROADCAST  # node of the last request
        self._replies = Assembler(self.counters)
        self._events: dict[int, Assembler] = {}

    def request(self, address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
        """Return the frames of a request, which counts as sent; address 0: a broadcast.

        Hello sets the node operational first, and reads its versions from an object, which one of
        another version has too.
        """
        message = REQUESTS[name]
        number = 0
        if address != BROADCAST:
            number = self._numbers.get(address, self._sequence) % NUMBER_MAX + 1
            self._numbers[address] = number
        words = message.request.append([], values)
        blocks = segments(number, message.number, words)
        frames = [CanFrame(REQUEST + address, block) for block in blocks]
        self._sent.extend(frames)
        if name == "Hello":
            start = CanFrame(cob_id("nmt"), bytes((_START, address)))
            reading = CanFrame(cob_id("sdo_request", address), _READ_VERSIONS)
            frames = [start, reading, *frames]
        self._pending = _PendingRequest(address, number, message) if has_reply else None
        self._requested = address
        self._replies = Assembler(self.counters)
        self.counters.frames_out += len(frames)
        self.takes = len(frames) * self._frame_time
        return pack_frames(frames)

    def received(self, data: bytes) -> list[Arrival]:
        """Return the arrivals that these frames complete."""
        arrivals: list[Arrival] = []
        for frame in unpack_frames(data):
            arrivals += self._arrivals(frame)
        return arrivals

    def withdraw(self) -> None:
        """Give up the request on the wire, so that its reply will count as unexpected."""
        self._pending = None

    def follow(self, before: Wire) -> None:
        """Continue the numbers, since amplifiers discard older ones for 0.1 s."""
        if isinstance(before, CanWire):
            self._numbers.update(before._numbers)

    def transit(self, words: int) -> float:
        """Return how long a request with this number of words takes to arrive [s]."""
        return frames_of(words) * self._frame_time

    def _arrivals(self, frame: CanFrame) -> list[Arrival]:
        node = frame.id & NODE_MAX
        kind = frame.id - node
        if node and kind == REPLY:
            return self._from_amplifier(node, frame.data)
        if node and kind == REQUEST and frame not in self._sent:
            return self._from_host(node, frame.data)
        if kind == cob_id("sdo_answer") and frame.data.startswith(_VERSIONS_READ):
            return self._other_version(node, frame.data)
        if frame.id >= ERROR_ID:
            self.counters.remark = (
                f"the adapter cannot send, or reports errors ({frame.data.hex(' ')}): check {_BUS}"
            )
        elif node and kind not in (REQUEST, cob_id("sdo_request")):
            self._remark_other(node)
        return []  # of other devices, or an echo

    def _remark_other(self, node: int) -> None:
        """Record a frame of a node that is not a reply; frames of its own amplifier matter most."""
        if node == self._requested or not self.counters.remark:
            self.counters.remark = (
                f"frames of node {node} came in place of a reply of node {self._requested}: check "
                "the node and its protocol, and that nothing delays the bus"
            )

    def _from_amplifier(self, node: int, data: bytes) -> list[Arrival]:
        """Take a frame that an amplifier sends as an event or as a part of a reply."""
        now = threads.now()
        if data[:1] == b"\0":
            return self._from_event(node, data, now)
        if node == self._requested and self._replies.contradicts(data):
            self._replies.add(data, now)  # which discards the message
            return [DuplicateAddress(node)]
        pending = self._pending
        if pending is None or not pending.is_answered_by(node, data):
            self.counters.frames_in += 1
            self.counters.unexpected_frames += data[1:2] == b"\0"
            self._remark_other(node)
            return []
        message = self._replies.add(data, now)
        if message is None:
            return []
        self._pending = None
        return [read_reply(pending.message, message.type, message.words)]

    def _from_event(self, node: int, data: bytes, now: float) -> list[Arrival]:
        """Take a frame of an event, which has no number."""
        events = self._events.setdefault(node, Assembler(self.counters, is_numbered=False))
        event = events.add(data, now)
        return [] if event is None else read_event(node, event.type, event.words, self.counters)

    def _other_version(self, node: int, data: bytes) -> list[Arrival]:
        """Take the versions for the reply to Hello, if it is of a node that will not reply."""
        pending = self._pending
        if pending is None or pending.node != node or pending.message.name != "Hello":
            return []
        versions = int.from_bytes(data[4:6], "little")
        if versions >> VERSION & 1:
            return []
        self._pending = None
        return [Reply({"versions": versions})]

    def _from_host(self, node: int, data: bytes) -> list[Arrival]:
        """Record a frame of another host; reading and stopping do not count as driving."""
        self.counters.frames_in += 1
        if len(data) != BLOCK or data[1] != 0:
            return []
        self.counters.unexpected_frames += 1
        self._numbers[node] = data[0]  # the amplifier discards older frames
        message = BY_NUMBER.get(data[2])
        return [OtherHost(node)] if message is not None and message.feeds else []


class CanAddress(WireAddress):
    """A node on a CAN bus; subclasses open the bus in different ways.

    line: name of the bus; delay: of a network in between [s]; settings: other than the bit rate.
    """

    def __init__(
        self, url: AmplifierUrl, line: str, *, delay: float = 0.0, settings: Mapping[str, object]
    ) -> None:
        low, high = _BITRATES
        self.bitrate = url.whole_option("bitrate", BITRATE, high, low=low)
        self.line = line
        self._delay = delay
        self.number = url.whole(url.number, "node", NODE_MAX) if url.number else ADDRESS
        self.settings = {"protocol": "CAN", "bitrate": self.bitrate, **settings}

    @staticmethod
    def with_address(url: str, address: int) -> str:
        """Return a URL with another node."""
        return with_fragment(url, address)

    def make_wire(self) -> CanWire:
        """Make the wire with a random number, so that a reply to an earlier host does not match."""
        sequence = random.randint(0, NUMBER_MAX)  # noqa: S311  no secret
        return CanWire(self.bitrate, sequence=sequence, delay=self._delay)
