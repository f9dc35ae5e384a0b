"""Frames found in streams of bytes: serial lines, and the text of CAN adapters.

Readers find frames in pieces of any size and after any noise, in bounded memory.
"""

import itertools
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.wires.can_frames import SLCAN, SOCKETCAND, CanFrame, TextReader
from drivers.wires.serial_frames import PAYLOAD_MAX, Frame, FrameReader, encode_frame, frame_length


@dataclass(frozen=True)
class Stream:
    """A kind of stream."""

    open_reader: Callable[[], Any]
    """Makes a reader."""
    encode: Callable[[Any], bytes]
    """Writes a frame as the far end does."""
    frames: st.SearchStrategy[Any]
    """Any frame."""


SERIAL_FRAMES = st.builds(
    Frame,
    kind=st.sampled_from([1, 7, 12, 31, 0x81, 0x9F]),
    address=st.integers(0, 255),
    sequence=st.integers(0, 65535),
    payload=st.binary(max_size=PAYLOAD_MAX),
    version=st.integers(0, 255),
)
CAN_FRAMES = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8))


def slcan_text(frame: CanFrame) -> bytes:
    """Return a frame as an adapter writes it, with LAWICEL's command t."""
    length = len(frame.data)
    text = f"t{frame.id:03X}{length:X}{frame.data.hex()}\r"
    return text.encode()


def socketcand_text(frame: CanFrame) -> bytes:
    """Return a frame as a socketcand server writes it."""
    digits = frame.data.hex().upper()
    text = f"< frame {frame.id:03X} 1700000000.123456 {digits} >"
    return text.encode()


STREAMS = {
    "serial": Stream(FrameReader, encode_frame, SERIAL_FRAMES),
    "slcan": Stream(lambda: TextReader(SLCAN), slcan_text, CAN_FRAMES),
    "socketcand": Stream(lambda: TextReader(SOCKETCAND), socketcand_text, CAN_FRAMES),
}
of_every_kind = pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS)


def read_all(reader: Any, pieces: Iterable[bytes]) -> list[object]:
    """Return the frames that a reader finds in pieces of a stream."""
    frames: list[object] = []
    for piece in pieces:
        frames += reader.feed(piece)
    return frames


@of_every_kind
@given(data=st.data())
def test_reader_finds_the_same_frames_in_pieces_of_any_size(
    stream: Stream, data: st.DataObject
) -> None:
    """However the stream is cut."""
    frames = data.draw(st.lists(stream.frames, max_size=5))
    text = b"".join(map(stream.encode, frames))
    positions = st.integers(0, len(text))
    cuts = sorted(data.draw(st.lists(positions, max_size=8)))
    pieces = []
    for start, end in itertools.pairwise([0, *cuts, len(text)]):
        pieces.append(text[start:end])

    assert read_all(stream.open_reader(), pieces) == frames


@of_every_kind
def test_reader_uses_little_memory_when_a_stream_has_no_frame_end(stream: Stream) -> None:
    """A megabyte without an end is a damaged frame or none."""
    reader = stream.open_reader()

    assert read_all(reader, [b"t1818" * 820] * 256) == []
    assert len(reader.rest) <= 512


def frame_by_hand(kind: int, version: int, address: int, sequence: int, payload: bytes) -> bytes:
    """Return a frame by the specification, with zlib's CRC and COBS for short blocks."""
    body = struct.pack("<BBBH", kind, version, address, sequence) + payload
    checked_body = body + struct.pack("<I", zlib.crc32(body))
    encoded = b""
    for block in checked_body.split(b"\0"):
        encoded += bytes([len(block) + 1]) + block
    return b"\0" + encoded + b"\0"


@given(SERIAL_FRAMES)
def test_serial_frame_has_the_bytes_of_the_specification(frame: Frame) -> None:
    """It has the stated length and is decoded again."""
    data = encode_frame(frame)

    by_hand = frame_by_hand(frame.kind, frame.version, frame.address, frame.sequence, frame.payload)
    assert data == by_hand
    assert len(data) == frame_length(len(frame.payload))
    assert FrameReader().feed(data) == [frame]


def test_serial_reader_counts_damaged_frames_and_reads_the_next() -> None:
    """A wrong CRC, a frame that is too long, and a truncated one."""
    good = frame_by_hand(12, 2, 1, 7, b"")
    wrong_crc = bytearray(frame_by_hand(12, 2, 1, 7, b"abc"))
    wrong_crc[-2] ^= 0x40
    too_long = b"\0" + b"\x01" * 1000 + b"\0"
    truncated = good[:5] + b"\0"
    invalid_frames: list[bytes] = []
    reader = FrameReader(on_invalid=invalid_frames.append)

    for count, data in enumerate((bytes(wrong_crc), too_long, truncated), start=1):
        assert reader.feed(data) == []
        assert len(invalid_frames) == count

    assert len(reader.feed(good)) == 1
