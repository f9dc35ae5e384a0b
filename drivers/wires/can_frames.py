"""CAN frames without I/O: protocol 4 in frames of eight bytes, and frames as text of adapters.

Byte 0 of a frame is the sequence number, 0 in broadcasts and events, byte 1 the index of the frame.
Frame 0 continues with type, number of words and two words, the others with three words each, low
byte first. Unused words are 0 and ignored. `CANOPEN` has the numbers of CANopen (CiA 301) shared by
amplifiers and hosts. Text frames are for slcan adapters and socketcand servers.
"""

import math
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from drivers.errors import WireCounters
from drivers.protocol.definition import MAX_WORDS

BLOCK: Final = 8
"""Bytes of a classic frame."""
_FRAME_BITS = 47 + 8 * BLOCK
_STUFFED_MAX = (33 + 8 * BLOCK) // 4  # one stuff bit per four at worst

ERROR_ID: Final = 0x800
"""Identifier of an adapter's error report, above those for frames; the data are its code."""
BITRATE: Final = 500_000
"""Default bit rate of a bus [bit/s]."""

CANOPEN: Mapping[str, Any] = {
    "heartbeat_ms": 50,  # of the amplifier
    "device_type": 0,  # no device profile
    "vendor_id": 0,  # not assigned by CiA
    "product_code": 1,
    "revision": 1,
    "cob_ids": {  # plus the node, except NMT
        "nmt": 0x000,
        "emergency": 0x080,
        "sdo_answer": 0x580,
        "sdo_request": 0x600,
        "heartbeat": 0x700,
    },
    "nmt": {
        "start": 1,
        "stop": 2,
        "pre_operational": 128,
        "reset_node": 129,
        "reset_communication": 130,
    },
    "nmt_states": {"BOOT_UP": 0, "STOPPED": 4, "OPERATIONAL": 5, "PRE_OPERATIONAL": 127},
    "emergencies": {  # by fault
        "NONE": {"code": 0x0000, "error_register": 0x00},
        "WATCHDOG": {"code": 0x8130, "error_register": 0x11},
        "OVER_TEMPERATURE": {"code": 0x4310, "error_register": 0x09},
        "OVER_VOLTAGE": {"code": 0x3310, "error_register": 0x05},
        "ARC": {"code": 0x2340, "error_register": 0x03},
        "CHANNEL": {"code": 0xFF01, "error_register": 0x81},
        "INTERNAL": {"code": 0x6100, "error_register": 0x81},
        "INTERLOCK": {"code": 0x9000, "error_register": 0x01},  # external error
        "OVER_CURRENT": {"code": 0x2310, "error_register": 0x03},  # continuous over-current
    },
    "objects": {
        "device_type": 0x1000,
        "error_register": 0x1001,
        "emergency_cob_id": 0x1014,
        "heartbeat_producer": 0x1017,
        "identity": 0x1018,
        "texts": 0x2000,
        "capabilities": 0x2001,
        "status": 0x2002,
    },
}


class CanFrame(NamedTuple):
    """A data frame with an 11-bit identifier."""

    id: int
    data: bytes


def cob_id(kind: str, node: int = 0) -> int:
    """Return the COB-ID of a kind of frame (a key of `cob_ids`) of a node."""
    return int(CANOPEN["cob_ids"][kind]) + node


def frame_time(bitrate: int) -> float:
    """Return the duration of a frame of eight bytes [s], with its pause and the most stuff bits."""
    return (_FRAME_BITS + _STUFFED_MAX) / bitrate


REQUEST = 0x200
"""Identifier of requests; the node is added (0 for a broadcast)."""
REPLY = 0x180
"""Identifier of replies and events; the node is added."""
NODE_MAX = 127
NUMBER_MAX = 255
"""The highest sequence number; 1 follows it."""
LIFE = 0.1
"""Time without a frame [s] after which an incomplete message and the last number are forgotten."""
_FIRST_WORDS = 2  # in frame 0
_NEXT_WORDS = 3  # in every other frame
_PACKED = struct.Struct("<HB8s")


class CanMessage(NamedTuple):
    """A message: its sequence number, type and words."""

    number: int
    type: int
    words: tuple[int, ...]


def frames_of(words: int) -> int:
    """Return how many frames a message of this many words has."""
    further_words = max(words - _FIRST_WORDS, 0)
    return 1 + math.ceil(further_words / _NEXT_WORDS)


def segments(number: int, kind: int, words: Sequence[int]) -> list[bytes]:
    """Return the data of the frames of a message of a type."""
    count = frames_of(len(words))
    capacity = _FIRST_WORDS + _NEXT_WORDS * (count - 1)
    padded = [*words, *[0] * (capacity - len(words))]
    frames = [struct.pack("<BBBB2H", number, 0, kind, len(words), *padded[:_FIRST_WORDS])]
    for index in range(1, count):
        start = _FIRST_WORDS + _NEXT_WORDS * (index - 1)
        frame_words = padded[start : start + _NEXT_WORDS]
        frames.append(struct.pack("<BB3H", number, index, *frame_words))
    return frames


def pack_frames(frames: Iterable[CanFrame]) -> bytes:
    """Return frames as bytes, for a port of frames: identifier, length, data padded to eight."""
    return b"".join(_PACKED.pack(frame.id, len(frame.data), frame.data) for frame in frames)


def unpack_frames(data: bytes) -> list[CanFrame]:
    """Read packed frames."""
    return [CanFrame(can_id, data[:length]) for can_id, length, data in _PACKED.iter_unpack(data)]


class Assembler:
    """Assembles a sender's messages from frames in any order.

    Frames with an older number than the last, or of a complete message, are discarded; a newer
    number discards an incomplete message. Without numbers (is_numbered) frame 0 begins a message.
    Two different frames at the same index come from two senders: the message is discarded.
    Discarded messages count as unexpected when their frame 0 arrives.

    began: when the first frame of the last message came [s]; given_up: number and begin of an
    incomplete message that the present one has replaced, until a reader resets it.
    """

    def __init__(self, counters: WireCounters, *, is_numbered: bool = True) -> None:
        self._counters = counters
        self._is_numbered = is_numbered
        self._number = 0
        self._frames: dict[int, bytes] = {}
        self._is_ended = True
        self._heard = -math.inf
        self.began = -math.inf
        self.given_up: tuple[int, float] | None = None

    def add(self, data: bytes, now: float) -> CanMessage | None:
        """Take the data of a frame at a time [s]; returns the message that it completes."""
        self._counters.frames_in += 1
        if not self._is_frame(data):
            self._counters.invalid_frames += 1
            return None
        index = data[1]
        if self._begins(data, now):
            self.given_up = None if self._is_ended else (self._number, self.began)
            self.began = now
            self._number = data[0]
            self._frames = {}
            self._is_ended = False
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
        """Whether a frame's data differ from an earlier frame of the same number and index."""
        earlier = self._frames.get(data[1]) if len(data) == BLOCK else None
        return earlier is not None and earlier[0] == data[0] and earlier != data

    def _is_frame(self, data: bytes) -> bool:
        if len(data) != BLOCK or bool(data[0]) is not self._is_numbered:
            return False
        if data[1] == 0:
            return data[3] <= MAX_WORDS
        return data[1] < frames_of(MAX_WORDS)

    def _begins(self, data: bytes, now: float) -> bool:
        """Whether a frame is the first received frame of a message."""
        if not self._is_numbered:
            return data[1] == 0
        if self._number == 0 or now - self._heard > LIFE:
            return True
        return 0 < (data[0] - self._number) % NUMBER_MAX <= NUMBER_MAX // 2

    def _whole(self) -> CanMessage | None:
        if 0 not in self._frames:
            return None
        first = self._frames[0]
        kind = first[2]
        word_count = first[3]
        count = frames_of(word_count)
        if any(index not in self._frames for index in range(count)):
            return None
        self._is_ended = True
        body = first[4:] + b"".join(self._frames[index][2:] for index in range(1, count))
        return CanMessage(self._number, kind, struct.unpack_from(f"<{word_count}H", body))


_MAX_LENGTH = 512  # characters without a terminator; ten times the longest frame
_ID_MAX = 0x7FF
_LINE = re.compile(rb"t([0-9A-Fa-f]{3})([0-8])((?:[0-9A-Fa-f]{2})*)")
SLCAN_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bit rates [bit/s] by the number of the command S of LAWICEL."""
_STAMP = 4  # digits of a timestamp, if the adapter is configured to send it
_HEARD = re.compile(
    rb"< frame ([0-9A-Fa-f]{3}) (?:[0-9A-Fa-f]{2} )?[0-9]+\.[0-9]+ "
    rb"((?:[0-9A-Fa-f]{2} ?){0,8}) ?"
)
_SENT = re.compile(rb"< *send ([0-7]?[0-9A-Fa-f]{1,2}) ([0-8])((?: [0-9A-Fa-f]{1,2})*) *")


class TextFormat(NamedTuple):
    """Text format of frames: the terminator, and the conversion of a frame to text and back.

    decode: text from an adapter; decode_sent: text to it; None for anything but a data frame with
    an 11-bit identifier.
    """

    end: re.Pattern[bytes]
    encode: Callable[[CanFrame], bytes]
    decode: Callable[[bytes], CanFrame | None]
    decode_sent: Callable[[bytes], CanFrame | None]


def _slcan_line(frame: CanFrame) -> bytes:
    return f"t{frame.id:03X}{len(frame.data):X}{frame.data.hex().upper()}\r".encode()


def _of_slcan_line(line: bytes) -> CanFrame | None:
    match = _LINE.fullmatch(line)
    if match is None:
        return None
    identifier, length, digits = match.groups()
    count = 2 * int(length)
    if len(digits) not in (count, count + _STAMP):
        return None
    return _frame(identifier, digits[:count])


def _element(frame: CanFrame) -> bytes:
    return f"< send {frame.id:03X} {len(frame.data):X} {frame.data.hex(' ')} >".encode()


def _of_element(element: bytes) -> CanFrame | None:
    match = _HEARD.fullmatch(element, max(element.rfind(b"<"), 0))
    return None if match is None else _frame(*match.groups())


def _of_sent(element: bytes) -> CanFrame | None:
    match = _SENT.fullmatch(element, max(element.rfind(b"<"), 0))
    if match is None:
        return None
    identifier, length, digits = match.groups()
    data = bytes(int(byte, 16) for byte in digits.split())
    return CanFrame(int(identifier, 16), data) if len(data) == int(length) else None


def _frame(identifier: bytes, digits: bytes) -> CanFrame | None:
    number = int(identifier, 16)
    return CanFrame(number, bytes.fromhex(digits.decode())) if number <= _ID_MAX else None


SLCAN = TextFormat(re.compile(rb"[\r\n\x07]"), _slcan_line, _of_slcan_line, _of_slcan_line)
SOCKETCAND = TextFormat(re.compile(rb">"), _element, _of_element, _of_sent)


class TextReader:
    """Reads frames from the text of an adapter; on_other: called with any other text."""

    def __init__(
        self, form: TextFormat, on_other: Callable[[bytes], None] = lambda text: None
    ) -> None:
        self._form = form
        self._on_other = on_other
        self.rest = b""
        """Possible beginning of a text."""

    def feed(self, data: bytes) -> Iterator[CanFrame]:
        """Yield the frames that these bytes complete."""
        *texts, rest = self._form.end.split(self.rest + data)
        self.rest = rest if len(rest) <= _MAX_LENGTH else b""
        for text in texts:
            frame = self._form.decode(text)
            if frame is None:
                self._on_other(text)
            else:
                yield frame
