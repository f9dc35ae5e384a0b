"""Messages of protocol 4 as CAN frames of eight bytes, and back; no I/O.

Byte 0 is the sequence number, 0 in broadcasts and events; byte 1 the index of the frame. Frame 0
goes on with type, number of words and two words, the others with three words each, low byte first.
Words that are not used are 0 and ignored.
"""

import math
import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from drivers.errors import WireCounters
from drivers.protocol.definition import MAX_WORDS
from drivers.wires.can_bus.canopen import BLOCK, CanFrame

REQUEST = 0x200
"""Identifier of requests; the node is added, none for a broadcast."""
REPLY = 0x180
"""Identifier of replies and events; the node is added."""
NODE_MAX = 127
NUMBER_MAX = 255
"""The sequence number before 1."""
LIFE = 0.1
"""Time without a frame [s] after which an incomplete message and the last number are forgotten."""
_FIRST, _EACH = 2, 3  # words
_PACKED = struct.Struct("<HB8s")


class Message(NamedTuple):
    """A message: its sequence number, type and words."""

    number: int
    type: int
    words: tuple[int, ...]


def frames_of(words: int) -> int:
    """Return how many frames a message of this many words has."""
    return 1 + -(-max(words - _FIRST, 0) // _EACH)


def segments(number: int, kind: int, words: Sequence[int]) -> list[bytes]:
    """Return the data of the frames of a message of a type."""
    count = frames_of(len(words))
    padded = [*words, *[0] * (_FIRST + _EACH * (count - 1) - len(words))]
    first = struct.pack("<BBBB2H", number, 0, kind, len(words), *padded[:_FIRST])
    rest = (
        struct.pack("<BB3H", number, index, *padded[_EACH * index - 1 : _EACH * index + 2])
        for index in range(1, count)
    )
    return [first, *rest]


def pack_frames(frames: Iterable[CanFrame]) -> bytes:
    """Return frames as bytes, for a port of frames: identifier, length, data padded to eight."""
    return b"".join(_PACKED.pack(frame.id, len(frame.data), frame.data) for frame in frames)


def unpack_frames(data: bytes) -> list[CanFrame]:
    """Read packed frames."""
    return [CanFrame(can_id, data[:length]) for can_id, length, data in _PACKED.iter_unpack(data)]


class Assembler:
    """Messages of one sender from their frames, in any order.

    A frame whose number is older than the last, or whose message is complete, is discarded; one
    of a newer number discards what is incomplete. Without numbers (is_numbered) frame 0 begins a
    message. Two frames of one place that differ are of two senders: the message is discarded.
    Whole messages that are discarded count as unexpected, by their frames 0.

    began: when the first frame of the last message came [s]; given_up: number and begin of a
    message that another one ended before it was whole, until that is taken.
    """

    def __init__(self, counters: WireCounters, *, is_numbered: bool = True) -> None:
        self._counters = counters
        self._is_numbered = is_numbered
        self._number = 0
        self._frames: dict[int, bytes] = {}
        self._is_ended = True
        self._heard = self.began = -math.inf
        self.given_up: tuple[int, float] | None = None

    def add(self, data: bytes, now: float) -> Message | None:
        """Take the data of a frame at a time [s]; returns the message that it completes."""
        self._counters.frames_in += 1
        if not self._is_frame(data):
            self._counters.invalid_frames += 1
            return None
        index = data[1]
        if self._begins(data, now):
            self.given_up = None if self._is_ended else (self._number, self.began)
            self.began = now
            self._number, self._frames, self._is_ended = data[0], {}, False
        elif self._is_ended or data[0] != self._number:
            self._counters.unexpected_frames += index == 0
            return None
        self._heard = now
        if self._frames.setdefault(index, data) != data:
            self._counters.invalid_frames += 1
            self._is_ended = True
            return None
        return self._whole()

    def contradicts(self, data: bytes) -> bool:
        """Whether the data of a frame differ from those of the same number and index before."""
        known = self._frames.get(data[1]) if len(data) == BLOCK else None
        return known is not None and known[0] == data[0] and known != data

    def _is_frame(self, data: bytes) -> bool:
        if len(data) != BLOCK or bool(data[0]) is not self._is_numbered:
            return False
        return data[3] <= MAX_WORDS if data[1] == 0 else data[1] < frames_of(MAX_WORDS)

    def _begins(self, data: bytes, now: float) -> bool:
        """Whether a frame is the first that comes of a message."""
        if not self._is_numbered:
            return data[1] == 0
        if self._number == 0 or now - self._heard > LIFE:
            return True
        return 0 < (data[0] - self._number) % NUMBER_MAX <= NUMBER_MAX // 2

    def _whole(self) -> Message | None:
        if 0 not in self._frames:
            return None
        head = self._frames[0]
        count = frames_of(head[3])
        if any(index not in self._frames for index in range(count)):
            return None
        self._is_ended = True
        body = head[4:] + b"".join(self._frames[index][2:] for index in range(1, count))
        return Message(self._number, head[2], struct.unpack_from(f"<{head[3]}H", body))
