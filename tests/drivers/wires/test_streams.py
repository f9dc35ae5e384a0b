"""Readers of streams without a length: frames in any pieces, after any noise, in bounded memory.

Frames of serial lines by their specification.
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
from drivers.wires.serial_frames import (
    PAYLOAD_MAX,
    Frame,
    FrameReader,
    encode_frame,
    frame_length,
)


@dataclass(frozen=True)
class Stream:
    """A kind of stream.

    feed: makes a reader, its method; sent: a frame as the far end writes it; frame, frames: one
    frame, and any; end: ends what noise may have begun.
    """

    feed: Callable[[], Callable[[bytes], Iterable[object]]]
    sent: Callable[[Any], bytes]
    frame: object
    frames: st.SearchStrategy[Any]
    end: bytes


def slcan_sent(frame: CanFrame) -> bytes:
    """A frame as a serial adapter writes it."""
    return f"t{frame.id:03X}{len(frame.data):X}{frame.data.hex()}\r".encode()


def socketcand_sent(frame: CanFrame) -> bytes:
    """A frame as the daemon writes it."""
    return f"< frame {frame.id:03X} 1700000000.123456 {frame.data.hex().upper()} >".encode()


CAN_FRAMES = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8))
FRAMES = st.builds(
    Frame,
    kind=st.sampled_from([1, 7, 12, 31, 0x81, 0x9F]),
    address=st.integers(0, 255),
    sequence=st.integers(0, 65535),
    payload=st.binary(max_size=PAYLOAD_MAX),
    version=st.integers(0, 255),
)
CAN_FRAME = CanFrame(0x181, bytes(range(8)))
STREAMS = {
    "serial": Stream(
        *(lambda: FrameReader().feed, encode_frame, Frame(12, 1, 1, b"x", 3), FRAMES, b"\0")
    ),
    "slcan": Stream(lambda: TextReader(SLCAN).feed, slcan_sent, CAN_FRAME, CAN_FRAMES, b"\r"),
    "socketcand": Stream(
        *(lambda: TextReader(SOCKETCAND).feed, socketcand_sent, CAN_FRAME, CAN_FRAMES, b">")
    ),
}
of_every_kind = pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS)


@of_every_kind
@given(data=st.data())
def test_any_split_of_the_stream_gives_the_same_frames(stream: Stream, data: st.DataObject) -> None:
    """However it is cut."""
    frames = data.draw(st.lists(stream.frames, max_size=5))
    text = b"".join(map(stream.sent, frames))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(text)), max_size=8)))
    pieces = itertools.starmap(slice, itertools.pairwise([0, *cuts, len(text)]))
    feed = stream.feed()
    assert [one for piece in pieces for one in feed(text[piece])] == frames


@of_every_kind
def test_stream_without_an_end_takes_no_memory(stream: Stream) -> None:
    """A megabyte is one frame that is damaged, or none."""
    feed = stream.feed()
    assert [one for _ in range(256) for one in feed(b"t1818" * 820)] == []
    reader = feed.__self__  # type: ignore[attr-defined]
    assert len(reader.rest) <= 512


def cobs_by_hand(data: bytes) -> bytes:
    """COBS of blocks below 254 bytes, by its definition."""
    return b"".join(bytes([len(part) + 1]) + part for part in data.split(b"\0"))


def frame_by_hand(kind: int, version: int, address: int, sequence: int, payload: bytes) -> bytes:
    """A frame from the specification, without the code under test."""
    body = struct.pack("<BBBH", kind, version, address, sequence) + payload
    return b"\0" + cobs_by_hand(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


@given(FRAMES)
def test_frame_equals_its_specification(frame: Frame) -> None:
    """Bytes and length; it is decoded again."""
    wire = encode_frame(frame)
    head = (frame.kind, frame.version, frame.address, frame.sequence)
    assert wire == frame_by_hand(*head, frame.payload)
    assert len(wire) == frame_length(len(frame.payload))
    assert FrameReader().feed(wire) == [frame]


def test_damaged_frames_are_counted() -> None:
    """By CRC, length and truncation; the next good frame is understood."""
    good = frame_by_hand(12, 2, 1, 7, b"")
    bad_crc = bytearray(frame_by_hand(12, 2, 1, 7, b"abc"))
    bad_crc[-2] ^= 0x40
    too_long, truncated = b"\0" + b"\x01" * 1000 + b"\0", good[:5] + b"\0"
    damaged = (bytes(bad_crc), too_long, truncated)
    invalid: list[bytes] = []
    reader = FrameReader(on_invalid=invalid.append)
    for count, data in enumerate(damaged, start=1):
        assert reader.feed(data) == []
        assert len(invalid) == count
    assert len(reader.feed(good)) == 1
