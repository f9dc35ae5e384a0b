"""CAN frames as text of adapters: golden lines, any split, any noise."""

import itertools
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.codec.can_bus.adapter_text import SLCAN, SOCKETCAND, TextFormat, TextReader
from drivers.codec.can_bus.canopen import CanFrame

FRAME = CanFrame(0x181, bytes.fromhex("0102030405060708"))
LINES = {
    SLCAN: b"t18180102030405060708\r",
    SOCKETCAND: b"< frame 181 1.5 0102030405060708 >",
}
frames = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)).map(lambda it: CanFrame(*it))


def slcan_said(frame: CanFrame) -> bytes:
    """A frame as an adapter writes it."""
    return f"t{frame.id:03X}{len(frame.data):X}{frame.data.hex()}\r".encode()


def socketcand_said(frame: CanFrame) -> bytes:
    """A frame as the daemon writes it."""
    return f"< frame {frame.id:03X} 1700000000.123456 {frame.data.hex().upper()} >".encode()


SAID = {SLCAN: slcan_said, SOCKETCAND: socketcand_said}


def pieces(text: bytes, cuts: list[int]) -> Iterator[bytes]:
    """Cut the text at these places."""
    edges = [0, *sorted(cut % (len(text) + 1) for cut in cuts), len(text)]
    return (text[begin:end] for begin, end in itertools.pairwise(edges))


def test_frames_are_encoded_as_text() -> None:
    """One of eight bytes and an empty one, against text by hand."""
    assert SLCAN.encode(FRAME) == b"t18180102030405060708\r"
    assert SLCAN.encode(CanFrame(0x80, b"")) == b"t0800\r"
    assert SOCKETCAND.encode(FRAME) == b"< send 181 8 01 02 03 04 05 06 07 08 >"


@pytest.mark.parametrize("form", SAID)
@given(sent=st.lists(frames, max_size=5), cuts=st.lists(st.integers(0, 1000), max_size=8))
def test_any_split_of_the_stream_gives_the_same_frames(
    form: TextFormat, sent: list[CanFrame], cuts: list[int]
) -> None:
    """For both kinds of adapters."""
    reader = TextReader(form)
    text = b"".join(map(SAID[form], sent))
    assert [frame for piece in pieces(text, cuts) for frame in reader.feed(piece)] == sent


@pytest.mark.parametrize("form", SAID)
@given(noise=st.binary(max_size=600))
def test_reader_resynchronizes_after_noise(form: TextFormat, noise: bytes) -> None:
    """A good frame after the next end of a line or element is understood."""
    reader = TextReader(form)
    list(reader.feed(noise))
    list(reader.feed(b">\r"))
    assert list(reader.feed(LINES[form])) == [FRAME]


@pytest.mark.parametrize(
    "line",
    [
        *(b"t1818010203\r", b"t18190102030405060708090A\r", b"tFFF8" + b"00" * 8 + b"\r"),
        *(
            b"T000001818" + b"00" * 8 + b"\r",
            b"r1810\r",
            b"d18180102030405060708\r",
            b"z\r",
            b"\r",
            b"\x07",
            b"t18\r",
        ),
    ],
)
def test_slcan_line_without_a_frame_is_skipped(line: bytes) -> None:
    """Too short, too long, a large or long identifier, remote and FD frames, answers."""
    reader = TextReader(SLCAN)
    assert list(reader.feed(line)) == []
    assert list(reader.feed(LINES[SLCAN])) == [FRAME]


def test_slcan_timestamp_is_skipped() -> None:
    """Four digits after the data, from adapters that are configured to send them."""
    assert list(TextReader(SLCAN).feed(b"t18180102030405060708ABCD\r")) == [FRAME]


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
    reader = TextReader(SOCKETCAND)
    assert list(reader.feed(element)) == []
    assert list(reader.feed(LINES[SOCKETCAND])) == [FRAME]


def test_unterminated_text_is_discarded() -> None:
    """It takes no memory."""
    for reader in (TextReader(SLCAN), TextReader(SOCKETCAND)):
        for _ in range(100):
            assert list(reader.feed(b"t1818" * 1000)) == []
        assert len(reader._rest) <= 512
