"""Messages on a CAN bus, in the text of an adapter: socketcand over TCP, slcan on a serial port.

Of NMT, boot-up and what resets a node are decoded; heartbeats, emergencies and SDO, which other
masters read, concern no rule. Other text is ignored.
"""

import re
from collections import deque

from drivers.errors import WireCounters
from drivers.judge.watching.capture import Direction
from drivers.judge.watching.decoded import (
    DecodedFrame,
    Decoder,
    Message,
    Notice,
    damaged,
    request_of,
    sent_by_amplifier,
)
from drivers.protocol.definition import EVENT, MAX_WORDS, NAMES
from drivers.wires.can_frames import (
    BLOCK,
    CANOPEN,
    NODE_MAX,
    REPLY,
    REQUEST,
    SLCAN,
    SOCKETCAND,
    Assembler,
    CanFrame,
    cob_id,
    frames_of,
)
from drivers.wires.can_frames import Message as Words

_MAX_REST = 512  # bytes kept of text that does not end
_KEPT = 3 * frames_of(MAX_WORDS)  # frames of the host, which an adapter may echo
_NMT_START: int = CANOPEN["nmt"]["start"]
_FORMS = {"slcan": SLCAN, "socketcand": SOCKETCAND}
_IS_FRAME = re.compile(rb"t|< (?:send|frame) [0-9A-Fa-f]{1,3} ")  # with an 11-bit identifier


class CanDecoder(Decoder):
    """Decodes the text of an adapter of this kind."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self._form = _FORMS[kind]
        self._sent: deque[CanFrame] = deque(maxlen=_KEPT)
        self._counters = WireCounters()
        # Messages of a sender, by its identifier and whether they are numbered.
        self._senders: dict[tuple[int, bool], Assembler] = {}

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        *pieces, rest = self._form.end.split(self.rest[direction] + data)
        self.rest[direction] = rest[-_MAX_REST:]
        decode = self._form.decode_sent if direction == "amplifier" else self._form.decode
        seen: list[DecodedFrame] = []
        for piece in map(bytes.strip, pieces):
            frame = decode(piece)
            if frame is None:
                if _IS_FRAME.match(piece):
                    seen.append((piece, damaged("a malformed frame line")))
                continue
            sender = self._sender(frame)
            take = self._from_host if direction == "amplifier" else self._from_bus
            message = take(time, frame, sender)
            if sender.given_up is not None:
                number, started_at = sender.given_up
                seen.append((b"", damaged(f"message {number} without all frames", started_at)))
                sender.given_up = None
            seen.append((piece, message))
        return seen

    def _sender(self, frame: CanFrame) -> Assembler:
        is_numbered = frame.data[:1] != b"\0"
        made = Assembler(self._counters, is_numbered=is_numbered)
        return self._senders.setdefault((frame.id, is_numbered), made)

    def _words(self, time: float, frame: CanFrame, sender: Assembler) -> Words | Notice | None:
        """Take a frame; returns the message that it completes, or that it fits none."""
        before = self._counters.invalid_frames
        words = sender.add(frame.data, time)
        return (
            damaged("a frame that fits no message")
            if self._counters.invalid_frames > before
            else words
        )

    def _from_host(self, time: float, frame: CanFrame, sender: Assembler) -> Message | None:
        node, kind = frame.id & NODE_MAX, frame.id & ~NODE_MAX
        self._sent.append(frame)
        if frame.id == cob_id("nmt") and len(frame.data) == 2:
            return None if frame.data[0] == _NMT_START else Notice("boot", frame.data[1])
        words = self._words(time, frame, sender) if kind == REQUEST else None
        if not isinstance(words, Words):
            return words
        key = (node, words.number, words.type) if node else None
        return request_of(words.type, words.words, node, key, sender.began)

    def _from_bus(self, time: float, frame: CanFrame, sender: Assembler) -> Message | None:
        node, kind = frame.id & NODE_MAX, frame.id & ~NODE_MAX
        if frame.id == cob_id("heartbeat", node) and frame.data == b"\0":
            return Notice("boot", node)
        if kind == REQUEST and node and frame not in self._sent:
            is_first = len(frame.data) == BLOCK and frame.data[1] == 0
            name = NAMES.get(frame.data[2]) if is_first else None
            return Notice("other host", node, text=name) if name else None
        words = self._words(time, frame, sender) if kind == REPLY and node else None
        if not isinstance(words, Words):
            return words
        if words.number == 0 and words.type != EVENT:
            return damaged(f"a message of type {words.type} without a number")
        return sent_by_amplifier(words.type, words.words, node, words.number)
