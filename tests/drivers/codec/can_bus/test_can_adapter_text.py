"""CAN frames as text of adapters: golden lines, any split, any noise."""

import itertools
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.codec.can_bus.adapter_text import (
    SlcanReader,
    SocketcandReader,
    slcan_line,
    socketcand_element,
)
from drivers.codec.can_bus.canopen import CanFrame

Reader = SlcanReader | SocketcandReader
FRAME = CanFrame(0x181, bytes.fromhex("0102030405060708"))
LINES = {
    SlcanReader: b"t18180102030405060708\r",
    SocketcandReader: b"< frame 181 1.5 0102030405060708 >",
}
frames = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8))


def slcan_said(frame: CanFrame) -> bytes:
    """A frame as an adapter writes it."""
    kind = "d" if frame.fd else "t"
    return f"{kind}{frame.id:03X}{len(frame.data):X}{frame.data.hex()}\r".encode()


def socketcand_said(frame: CanFrame) -> bytes:
    """A frame as the daemon writes it."""
    return f"< frame {frame.id:03X} 1700000000.123456 {frame.data.hex().upper()} >".encode()


SAID: dict[type[Reader], Callable[[CanFrame], bytes]] = {
    SlcanReader: slcan_said,
    SocketcandReader: socketcand_said,
}


def pieces(text: bytes, cuts: list[int]) -> Iterator[bytes]:
    """Cut the text at these places."""
    edges = [0, *sorted(cut % (len(text) + 1) for cut in cuts), len(text)]
    return (text[begin:end] for begin, end in itertools.pairwise(edges))


def test_frames_are_encoded_as_text() -> None:
    """Classic, empty, and CAN FD, against text by hand."""
    fd = CanFrame(0x481, bytes(12), fd=True)
    assert slcan_line(FRAME) == b"t18180102030405060708\r"
    assert slcan_line(CanFrame(0x80, b"")) == b"t0800\r"
    assert slcan_line(fd) == b"b4819" + b"00" * 12 + b"\r"
    assert socketcand_element(FRAME) == b"< send 181 8 01 02 03 04 05 06 07 08 >"
    assert socketcand_element(fd) == b"< fdsend 481 00 12 " + b"00 " * 12 + b">"


@pytest.mark.parametrize("make", SAID)
@given(sent=st.lists(frames, max_size=5), cuts=st.lists(st.integers(0, 1000), max_size=8))
def test_any_split_of_the_stream_gives_the_same_frames(
    make: type[Reader], sent: list[CanFrame], cuts: list[int]
) -> None:
    """For both kinds of adapters."""
    reader = make()
    text = b"".join(map(SAID[make], sent))
    assert [frame for piece in pieces(text, cuts) for frame in reader.feed(piece)] == sent


@pytest.mark.parametrize("make", SAID)
@given(noise=st.binary(max_size=600))
def test_reader_resynchronizes_after_noise(make: type[Reader], noise: bytes) -> None:
    """A good frame after the next end of a line or element is understood."""
    reader = make()
    list(reader.feed(noise))
    list(reader.feed(b">\r"))
    assert list(reader.feed(LINES[make])) == [FRAME]


@pytest.mark.parametrize(
    "line",
    [
        *(b"t1818010203\r", b"t18190102030405060708090A\r", b"tFFF8" + b"00" * 8 + b"\r"),
        *(b"T000001818" + b"00" * 8 + b"\r", b"r1810\r", b"z\r", b"\r", b"\x07", b"t18\r"),
    ],
)
def test_slcan_line_without_a_frame_is_skipped(line: bytes) -> None:
    """Too short, too long, an identifier too large, long identifiers, remote frames, answers."""
    reader = SlcanReader()
    assert list(reader.feed(line)) == []
    assert list(reader.feed(LINES[SlcanReader])) == [FRAME]


def test_slcan_timestamp_is_skipped() -> None:
    """Four digits after the data, from adapters that are configured to send them."""
    assert list(SlcanReader().feed(b"t18180102030405060708ABCD\r")) == [FRAME]


@pytest.mark.parametrize(
    "element",
    [
        *(b"< ok >", b"< error unknown command >", b"< frame 1FFFFFFF 1.5 00 >", b"< frame 181 >"),
        *(b"< frame 181 1.5 0 >", b"< frame 181 x 00 >", b"frame 181 1.5 00 >", b"<<<>"),
        b"< frame 181 1.5 000000000000000000 >",
    ],
)
def test_socketcand_element_without_a_frame_is_skipped(element: bytes) -> None:
    """Answers, long identifiers, missing parts, too much data."""
    reader = SocketcandReader()
    assert list(reader.feed(element)) == []
    assert list(reader.feed(LINES[SocketcandReader])) == [FRAME]


def test_unterminated_text_is_discarded() -> None:
    """It takes no memory."""
    for reader in (SlcanReader(), SocketcandReader()):
        for _ in range(100):
            assert list(reader.feed(b"t1818" * 1000)) == []
        assert len(reader._rest) <= 512
