"""Readers of streams without a length: frames in any pieces, after any noise, in bounded memory."""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.codec.can_bus.adapter_text import SLCAN, SOCKETCAND, TextReader
from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.serial_line.frame import PAYLOAD_MAX, Frame, FrameReader, encode_frame


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
@given(noise=st.binary(max_size=2000))
def test_noise_gives_no_frame_and_leaves_the_reader_usable(stream: Stream, noise: bytes) -> None:
    """Random bytes give none, or one of text by chance; the next good frame is understood."""
    feed = stream.feed()
    if stream.end == b"\0":
        assert list(feed(noise)) == []
    else:
        list(feed(noise))
    list(feed(stream.end))
    assert list(feed(stream.sent(stream.frame))) == [stream.frame]


@of_every_kind
def test_stream_without_an_end_takes_no_memory(stream: Stream) -> None:
    """A megabyte is one frame that is damaged, or none."""
    feed = stream.feed()
    assert [one for _ in range(256) for one in feed(b"t1818" * 820)] == []
    reader = feed.__self__  # type: ignore[attr-defined]
    assert len(reader._rest) <= 512
