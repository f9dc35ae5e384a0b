"""Messages of a serial line."""

from drivers.codec.serial_line.frame import NEUTRAL, FrameReader, unpack_identity, unpack_words
from drivers.protocol.records import Refusal
from drivers.protocol.table import EVENT, REFUSALS, VERSION
from drivers.protocol.table import HELLO as HELLO_NUMBER
from sim.witness.capture import Direction
from sim.witness.decoded import (
    DecodedFrame,
    Decoder,
    Message,
    Reply,
    Request,
    damaged,
    request_of,
    sent_by_amplifier,
)

_MAX_REST = 512  # bytes kept of a frame that does not end


class SerialDecoder(Decoder):
    """Decodes frames between zero bytes."""

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        *pieces, rest = (self.rest[direction] + data).split(b"\0")
        self.rest[direction] = rest[-_MAX_REST:]
        return [(b"\0" + one + b"\0", _decode(direction, one)) for one in pieces if one]


def _decode(direction: Direction, piece: bytes) -> Message:
    frames = FrameReader().feed(piece + b"\0")
    if not frames:
        return damaged("a frame of invalid length or checksum")
    (frame,) = frames
    if frame.is_reply != (direction == "host") and frame.type != EVENT:
        return damaged("a frame of the wrong direction")
    key = (frame.address, frame.sequence, frame.type) if frame.address else None
    is_hello = frame.type == HELLO_NUMBER
    message: Message
    try:
        words = () if is_hello else unpack_words(frame.payload)
        if direction == "amplifier":
            message = request_of(frame.type, words, frame.address, key)
        elif is_hello:
            message = Reply(frame.address, key, unpack_identity(frame.payload))
        else:
            message = sent_by_amplifier(frame.type, words, frame.address, frame.sequence)
    except Refusal as refusal:
        if direction == "amplifier":
            return Request(f"type {frame.type}", frame.address, key, problem=str(refusal))
        return Reply(frame.address, key, problem=str(refusal))
    is_other = frame.version != (NEUTRAL if is_hello else VERSION)
    if is_other and getattr(message, "refusal", 0) != REFUSALS["UNSUPPORTED_VERSION"]:
        return damaged(f"protocol version {frame.version}")
    return message
