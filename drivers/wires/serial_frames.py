"""Frames on a serial line and their payloads: bytes in, checked frames out.

    0x00  COBS( type u8 · version u8 · address u8 · sequence u16 · payload · CRC-32 u32 )  0x00

Every integer is little-endian. Bit 7 of the type is set in replies. The CRC is the one of zlib and
Ethernet, over everything before it. COBS leaves no zero inside a frame, so a reader resynchronizes
at the next zero. The leading zero ends preceding noise; empty frames are ignored.

Payloads are words, except in Hello and its reply, which are the same in every version of the
protocol: versions u16 · vendor · product · serial number · firmware, each a length u8 and UTF-8.
"""

import struct
import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cobs import cobs

from drivers.protocol.definition import HELLO, MAX_WORDS, TEXTS
from drivers.protocol.records import Refusal

REPLY_BIT = 0x80
NEUTRAL = 0
"""Version number in frames that all versions share: Hello, its reply, and a rejected version."""

_TYPE_MASK = 0x7F
_HEADER = struct.Struct("<BBBH")
_CRC = struct.Struct("<I")
_OVERHEAD = _HEADER.size + _CRC.size
PAYLOAD_MAX = 2 * MAX_WORDS
"""Bytes; header, payload and CRC stay in one COBS block, so that its overhead is one byte."""
_STUFFED_MAX = _OVERHEAD + PAYLOAD_MAX + 1


class Frame(NamedTuple):
    """A delimited and checked frame with its raw payload.

    kind: message type, with the bit REPLY in replies; address 0..255; sequence 0..65535, which a
    reply repeats from its request; version: of the protocol.
    """

    kind: int
    address: int
    sequence: int
    payload: bytes
    version: int

    @property
    def type(self) -> int:
        """The message type without the reply bit."""
        return self.kind & _TYPE_MASK

    @property
    def is_reply(self) -> bool:
        """Whether it is a reply."""
        return bool(self.kind & REPLY_BIT)


def encode_frame(frame: Frame, words: Sequence[int] = ()) -> bytes:
    """Encode a frame with its delimiters, words behind its payload; ValueError for too many."""
    payload = frame.payload
    length = len(payload) + 2 * len(words)
    if length > PAYLOAD_MAX:
        raise ValueError(f"payload must have at most {PAYLOAD_MAX} bytes, got {length}")
    form = f"<BBBH{len(payload)}s{len(words)}H"
    body = struct.pack(
        form, frame.kind, frame.version, frame.address, frame.sequence, payload, *words
    )
    stuffed: bytes = cobs.encode(body + _CRC.pack(zlib.crc32(body)))
    return b"\0" + stuffed + b"\0"


def frame_length(payload_length: int) -> int:
    """Return the bytes of a frame with a payload of this length, delimiters included."""
    return payload_length + _OVERHEAD + 1 + 2


class FrameReader:
    """Splits a stream of bytes into frames; invalid pieces are skipped.

    Buffers at most one frame. on_invalid: called with each invalid piece, of an overlong one with
    its beginning.
    """

    def __init__(self, *, on_invalid: Callable[[bytes], None] = lambda piece: None) -> None:
        self._on_invalid = on_invalid
        self.rest = b""
        """Possible beginning of a frame."""
        self._is_skipping = False  # to the end of an overlong piece

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that these bytes complete, in order."""
        frames = []
        *ended, rest = (self.rest + data).split(b"\0")
        for piece in ended:
            is_skipped = self._is_skipping or not piece  # a leading zero ends an empty piece
            self._is_skipping = False
            if is_skipped:
                continue
            try:
                content = cobs.decode(piece) if len(piece) <= _STUFFED_MAX else b""
            except cobs.DecodeError:
                content = b""
            body = content[: -_CRC.size]
            crc = content[-_CRC.size :]
            if len(content) < _OVERHEAD or _CRC.unpack(crc) != (zlib.crc32(body),):
                self._on_invalid(piece[:_STUFFED_MAX])
                continue
            kind, version, address, sequence = _HEADER.unpack_from(body)
            frames.append(Frame(kind, address, sequence, body[_HEADER.size :], version))
        if len(rest) > _STUFFED_MAX and not self._is_skipping:
            self._on_invalid(rest[:_STUFFED_MAX])
            self._is_skipping = True
        self.rest = b"" if self._is_skipping else rest
        return frames


def pack_words(words: Sequence[int]) -> bytes:
    """Return the payload of words."""
    return struct.pack(f"<{len(words)}H", *words)


def unpack_words(payload: bytes) -> tuple[int, ...]:
    """Return the words of a payload; Refusal for half a word."""
    if len(payload) % 2:
        raise Refusal("payload must have an even number of bytes", "BAD_LENGTH")
    return struct.unpack(f"<{len(payload) // 2}H", payload)


def words_of(frame: Frame) -> Sequence[int]:
    """Return the words of a frame; Refusal for half a word.

    A Hello is empty. Its reply has the words of its record, up to the end of its texts.
    """
    if frame.kind == HELLO:
        return ()
    if frame.kind != HELLO | REPLY_BIT:
        return unpack_words(frame.payload)
    versions = int.from_bytes(frame.payload[:2], "little")
    words = [versions]
    texts = frame.payload[2:]
    for _ in TEXTS:
        if texts:
            length = texts[0]
            text = texts[1 : 1 + length]
            texts = texts[1 + length :]
            padded = text + b"\0" * (len(text) % 2)
            words += [length, *struct.unpack(f">{len(padded) // 2}H", padded)]
    return words


def payload_of(kind: int, words: Sequence[int]) -> bytes:
    """Return the payload of words; in a reply to Hello each text begins with a byte, its length."""
    if kind != HELLO | REPLY_BIT:
        return pack_words(words)
    payload = pack_words(words[:1])
    text_words = words[1:]
    for _ in TEXTS:
        length = text_words[0]
        end = 1 + (length + 1) // 2
        text = struct.pack(f">{end - 1}H", *text_words[1:end])
        payload += bytes([length]) + text[:length]
        text_words = text_words[end:]
    return payload
