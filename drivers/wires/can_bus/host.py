"""The host's side of a CAN bus: frames of words, matched by node and sequence number.

Its bytes are packed frames (`drivers.wires.can_bus.frames`), for a port that takes frames.
"""

from collections import deque

from drivers.errors import WireCounters
from drivers.protocol.definition import (
    BROADCAST,
    BY_NUMBER,
    HELLO,
    IDENTITY,
    MAX_WORDS,
    MESSAGES,
    NAK,
    VERSION,
)
from drivers.protocol.records import Refusal, Values
from drivers.wires.can_bus.canopen import (
    BLOCK,
    CANOPEN,
    ERROR_ID,
    CanFrame,
    cob_id,
    frame_time,
)
from drivers.wires.can_bus.frames import (
    NODE_MAX,
    NUMBER_MAX,
    REPLY,
    REQUEST,
    Assembler,
    frames_of,
    pack_frames,
    segments,
    unpack_frames,
)
from drivers.wires.wire import (
    Arrival,
    Broken,
    OtherHost,
    Reply,
    Several,
    Wire,
    read_event,
    read_nak,
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
        self._pending: tuple[int, int, int] | None = None  # node, number, type
        self._requested = BROADCAST  # node of the last request
        self._replies = Assembler(self.counters)
        self._events: dict[int, Assembler] = {}

    def request(self, address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
        """Return the frames of a request, which is on the wire from now on; address 0: of all.

        Hello sets the node operational first, and reads its versions from an object, which one of
        another version has too.
        """
        number, kind, words = 0, HELLO, list[int]()
        if address != BROADCAST:
            number = self._numbers.get(address, self._sequence) % NUMBER_MAX + 1
            self._numbers[address] = number
        if name != "Hello":
            kind, words = MESSAGES[name].number, MESSAGES[name].request.append([], values)
        frames = [CanFrame(REQUEST + address, data) for data in segments(number, kind, words)]
        self._sent.extend(frames)
        if name == "Hello":
            start = CanFrame(cob_id("nmt"), bytes((_START, address)))
            frames[:0] = start, CanFrame(cob_id("sdo_request", address), _READ_VERSIONS)
        self._pending = (address, number, kind) if has_reply else None
        self._requested = address
        self._replies = Assembler(self.counters)
        self.counters.frames_out += len(frames)
        self.takes = len(frames) * self._frame_time
        return pack_frames(frames)

    def received(self, data: bytes) -> list[Arrival]:
        """Return what these frames complete."""
        return [arrival for frame in unpack_frames(data) for arrival in self._arrivals(frame)]

    def withdraw(self) -> None:
        """Take the request off the wire: its reply will be unexpected."""
        self._pending = None

    def follow(self, before: Wire) -> None:
        """Number requests on: within 0.1 s amplifiers discard what is older."""
        if isinstance(before, CanWire):
            self._numbers.update(before._numbers)

    def transit(self, words: int) -> float:
        """Return how long a request of so many words takes to arrive [s]."""
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
        """Note a frame of a node that is no reply; what its amplifier sends says the most."""
        if node == self._requested or not self.counters.remark:
            self.counters.remark = (
                f"frames of node {node} came in place of a reply of node {self._requested}: check "
                "the node and its protocol, and that nothing delays the bus"
            )

    def _from_amplifier(self, node: int, data: bytes) -> list[Arrival]:
        now = threads.now()
        if data[:1] == b"\0":
            events = self._events.setdefault(node, Assembler(self.counters, is_numbered=False))
            event = events.add(data, now)
            return [] if event is None else read_event(node, event.type, event.words, self.counters)
        if node == self._requested and self._replies.contradicts(data):
            self._replies.add(data, now)  # which discards the message
            return [Several(node)]
        if self._pending is None or (node, *data[:1]) != self._pending[:2]:
            self.counters.frames_in += 1
            self.counters.unexpected_frames += data[1:2] == b"\0"
            self._remark_other(node)
            return []
        message = self._replies.add(data, now)
        if message is None:
            return []
        kind, self._pending = self._pending[2], None
        try:
            if message.type == NAK:
                return [read_nak(message.words)]
            if message.type != kind:
                return [Broken(f"type of the reply must be {kind}, got {message.type}")]
            record = IDENTITY if kind == HELLO else BY_NUMBER[kind].reply
            return [Reply(record.read(message.words)[0])]  # what follows is ignored
        except Refusal as refusal:
            return [Broken(str(refusal))]

    def _other_version(self, node: int, data: bytes) -> list[Arrival]:
        """Take the versions for the reply to Hello, if it is of a node that will not reply."""
        versions = int.from_bytes(data[4:6], "little")
        if self._pending is None or self._pending[::2] != (node, HELLO) or versions >> VERSION & 1:
            return []
        self._pending = None
        return [Reply({"versions": versions})]

    def _from_host(self, node: int, data: bytes) -> list[Arrival]:
        """Note a frame of another host; one that reads or stops does not drive the amplifier."""
        self.counters.frames_in += 1
        if len(data) != BLOCK or data[1] != 0:
            return []
        self.counters.unexpected_frames += 1
        self._numbers[node] = data[0]  # the amplifier discards what is older
        message = BY_NUMBER.get(data[2])
        return [OtherHost(node)] if message is not None and message.feeds else []
