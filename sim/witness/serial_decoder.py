"""Messages of a serial line."""

from drivers.codec.serial_line.frame import NEUTRAL, Frame, FrameReader
from drivers.protocol.records import Refusal
from drivers.protocol.serial_payload import HELLO as HELLO_NUMBER
from drivers.protocol.serial_payload import unpack_identity, unpack_words
from drivers.protocol.table import BY_NUMBER, EVENT, NAK, REFUSALS, VERSION
from sim.witness.capture import Direction
from sim.witness.decoded import (
    HELLO,
    Damaged,
    DecodedFrame,
    Message,
    Reply,
    Request,
    event_of,
    nak_of,
    reply_of,
    request_of,
)

_MAX_REST = 512  # bytes kept of a frame that does not end


class SerialDecoder:
    """Decodes both directions."""

    def __init__(self) -> None:
        self._rest: dict[Direction, bytes] = {"amplifier": b"", "host": b""}

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        *pieces, rest = (self._rest[direction] + data).split(b"\0")
        self._rest[direction] = rest[-_MAX_REST:]
        return [(b"\0" + one + b"\0", _decode(direction, one)) for one in pieces if one]

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""
        return bool(self._rest[direction])


def _decode(direction: Direction, piece: bytes) -> Message:
    frames = FrameReader().feed(piece + b"\0")
    if not frames:
        return Damaged("a frame of invalid length or checksum")
    (frame,) = frames
    if frame.is_reply != (direction == "host") and frame.type != EVENT:
        return Damaged("a frame of the wrong direction")
    try:
        return _request(frame) if direction == "amplifier" else _from_amplifier(frame)
    except Refusal as refusal:
        if direction == "amplifier":
            return Request(f"type {frame.type}", frame.address, _key(frame), problem=str(refusal))
        return Reply(frame.address, _key(frame), problem=str(refusal))


def _key(frame: Frame) -> tuple[int, int, int] | None:
    return (frame.address, frame.sequence, frame.type) if frame.address else None


def _request(frame: Frame) -> Message:
    if frame.type == HELLO_NUMBER:
        return Request(HELLO, frame.address, _key(frame))
    if frame.version != VERSION:
        return Damaged(f"protocol version {frame.version}")
    return request_of(frame.type, unpack_words(frame.payload), frame.address, _key(frame))


def _from_amplifier(frame: Frame) -> Message:
    words = () if frame.type == HELLO_NUMBER else unpack_words(frame.payload)
    version = NEUTRAL if frame.type == HELLO_NUMBER else VERSION
    if frame.type == NAK:
        nak = nak_of(words, frame.address, (frame.address, frame.sequence, *words[:1]))
        if frame.version == VERSION or nak.refusal == REFUSALS["UNSUPPORTED_VERSION"]:
            return nak
    if frame.version != version:
        return Damaged(f"protocol version {frame.version}")
    if frame.type == EVENT:
        return event_of(words, frame.address)
    if frame.type == HELLO_NUMBER:
        return Reply(frame.address, _key(frame), unpack_identity(frame.payload))
    if frame.type not in BY_NUMBER:
        return Damaged(f"a reply of unknown type {frame.type}")
    return reply_of(BY_NUMBER[frame.type].name, words, frame.address, _key(frame))
