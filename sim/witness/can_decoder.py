"""Messages on a CAN bus, in the text of an adapter.

Of NMT, boot-up and what resets a node are decoded; heartbeats, emergencies and SDO, which other
masters read, concern no rule.
"""

from collections import deque

from drivers.codec.can_bus.canopen import CANOPEN, cob_id
from drivers.codec.can_bus.segments import NODE_MAX, REPLY, REQUEST, Assembler, frames_of
from drivers.codec.can_bus.segments import Message as Words
from drivers.protocol.serial_payload import HELLO as HELLO_NUMBER
from drivers.protocol.table import BY_NUMBER, EVENT, MAX_WORDS, NAK
from drivers.statistics import WireCounters
from sim.witness.can_text import CanFrame, SlcanText, SocketcandText
from sim.witness.capture import Direction
from sim.witness.decoded import (
    HELLO,
    BootUp,
    Damaged,
    DecodedFrame,
    Message,
    OtherHost,
    Request,
    event_of,
    nak_of,
    reply_of,
    request_of,
)

_BLOCK = 8  # bytes of every frame of a message
_KEPT = 3 * frames_of(MAX_WORDS)  # frames of the host, which an adapter may echo
_NMT_START: int = CANOPEN["nmt"]["start"]


class CanDecoder:
    """Decodes the text of an adapter of this kind."""

    def __init__(self, kind: str) -> None:
        reader = SlcanText if kind == "slcan" else SocketcandText
        self._text = {"amplifier": reader("amplifier"), "host": reader("host")}
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=_KEPT)
        self._senders: dict[tuple[int, bool], _Sender] = {}  # by identifier, and whether numbered
        self._incomplete: int | None = None  # number of a message that another one has ended

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        seen: list[DecodedFrame] = []
        for text in self._text[direction].feed(data):
            if text.is_damaged:
                seen.append((text.raw, Damaged("a malformed frame line")))
            elif text.frame is not None:
                take = self._from_host if direction == "amplifier" else self._from_bus
                message = take(time, text.frame)
                if self._incomplete is not None:
                    seen.append((b"", Damaged(f"message {self._incomplete} without all frames")))
                    self._incomplete = None
                seen.append((text.raw, message))
        return seen

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""
        return self._text[direction].has_partial_frame

    def _from_host(self, time: float, frame: CanFrame) -> Message | None:
        node, kind = frame.identifier & NODE_MAX, frame.identifier & ~NODE_MAX
        self._sent.append((frame.identifier, frame.data))
        if frame.identifier == cob_id("nmt") and len(frame.data) == 2:
            return None if frame.data[0] == _NMT_START else BootUp(frame.data[1])
        if kind != REQUEST:
            return None
        sender = self._sender(frame.identifier, frame.data)
        words = self._add(sender, time, frame.data)
        if not isinstance(words, Words):
            return words
        key = (node, words.number, words.type) if node else None
        if words.type == HELLO_NUMBER and node:
            return Request(HELLO, node, key, begun=sender.begun)
        found = request_of(words.type, words.words, node, key)
        return Request(found.name, node, key, found.values, found.problem, sender.begun)

    def _from_bus(self, time: float, frame: CanFrame) -> Message | None:
        node, kind = frame.identifier & NODE_MAX, frame.identifier & ~NODE_MAX
        if frame.identifier == cob_id("heartbeat", node) and frame.data == b"\0":
            return BootUp(node)
        if kind == REQUEST and node and (frame.identifier, frame.data) not in self._sent:
            is_first = len(frame.data) == _BLOCK and frame.data[1] == 0
            known = BY_NUMBER.get(frame.data[2]) if is_first else None
            return None if known is None else OtherHost(node, known.name)
        if kind != REPLY or not node:
            return None
        words = self._add(self._sender(frame.identifier, frame.data), time, frame.data)
        if not isinstance(words, Words):
            return words
        if words.number == 0:
            if words.type == EVENT:
                return event_of(words.words, node)
            return Damaged(f"a message of type {words.type} without a number")
        if words.type == NAK:
            return nak_of(words.words, node, (node, words.number, *words.words[:1]))
        if words.type not in BY_NUMBER and words.type != HELLO_NUMBER:
            return Damaged(f"a reply of unknown type {words.type}")
        name = HELLO if words.type == HELLO_NUMBER else BY_NUMBER[words.type].name
        return reply_of(name, words.words, node, (node, words.number, words.type))

    def _add(self, sender: "_Sender", time: float, data: bytes) -> Words | Damaged | None:
        self._incomplete = sender.ended_by(data)
        return sender.add(time, data)

    def _sender(self, identifier: int, data: bytes) -> "_Sender":
        is_numbered = data[:1] != b"\0"
        known = self._senders.get((identifier, is_numbered))
        if known is None:
            known = self._senders[identifier, is_numbered] = _Sender(is_numbered=is_numbered)
        return known


class _Sender:
    """Messages of one identifier; begun: time of the first frame of the last one [s]."""

    def __init__(self, *, is_numbered: bool) -> None:
        self.begun = 0.0
        self._counters = WireCounters()
        self._assembler = Assembler(self._counters, is_numbered=is_numbered)
        self._number: int | None = None  # of the last frame
        self._is_whole = True

    def ended_by(self, data: bytes) -> int | None:
        """Return the number of a message that is not whole and that a frame ends; None for none."""
        is_other = data[:1] != bytes([self._number or 0])
        return self._number if is_other and not self._is_whole else None

    def add(self, time: float, data: bytes) -> Words | Damaged | None:
        """Take the data of a frame; returns the message that it completes."""
        if len(data) != _BLOCK:
            return Damaged(f"a frame of {len(data)} bytes, must be {_BLOCK}")
        if data[0] != self._number or (self._is_whole and data[1] == 0):
            self._number, self._is_whole, self.begun = data[0], False, time
        before = self._counters.invalid_frames, self._counters.unexpected_frames
        words = self._assembler.add(data, time)
        if words is not None:
            self._is_whole = True
        elif self._counters.invalid_frames > before[0]:
            return Damaged("a frame that fits no message")
        elif self._counters.unexpected_frames > before[1]:
            self._is_whole = True  # an older one, or a copy
        return words
