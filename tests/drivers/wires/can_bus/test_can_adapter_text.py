"""CAN frames as text of adapters: golden lines, and what is no frame."""

import pytest

from drivers.wires.can_frames import SLCAN, SOCKETCAND, CanFrame, TextFormat, TextReader

FRAME = CanFrame(0x181, bytes.fromhex("0102030405060708"))
LINES = {
    SLCAN: b"t18180102030405060708\r",
    SOCKETCAND: b"< frame 181 1.5 0102030405060708 >",
}
NO_LINES = (
    *(b"t1818010203", b"t18190102030405060708090A", b"tFFF8" + b"00" * 8, b"t18"),
    *(b"T000001818" + b"00" * 8, b"r1810", b"d18180102030405060708", b"z", b"", b"\x07"),
)
"""Too short, too long, a large or long identifier, remote and FD frames, replies."""
NO_ELEMENTS = (
    *(b"< ok >", b"< error unknown command >", b"< frame 1FFFFFFF 1.5 00 >", b"< frame 181 >"),
    *(b"< frame 181 1.5 0 >", b"< frame 181 x 00 >", b"frame 181 1.5 00 >", b"<<<>"),
    *(b"< frame 181 1.5 000000000000000000 >", b"< fdframe 181 00 1.5 00 >"),
)
"""Replies, long identifiers, missing parts, too much data, FD frames."""


def test_frames_are_encoded_as_text() -> None:
    """One of eight bytes and an empty one, against text by hand."""
    assert SLCAN.encode(FRAME) == b"t18180102030405060708\r"
    assert SLCAN.encode(CanFrame(0x80, b"")) == b"t0800\r"
    assert SOCKETCAND.encode(FRAME) == b"< send 181 8 01 02 03 04 05 06 07 08 >"


@pytest.mark.parametrize(
    ("form", "text"),
    [*((SLCAN, line + b"\r") for line in NO_LINES), *((SOCKETCAND, each) for each in NO_ELEMENTS)],
)
def test_text_without_a_frame_is_skipped(form: TextFormat, text: bytes) -> None:
    """The next frame is understood."""
    reader = TextReader(form)
    assert list(reader.feed(text)) == []
    assert list(reader.feed(LINES[form])) == [FRAME]


def test_slcan_timestamp_is_skipped() -> None:
    """Four digits after the data, from adapters that are configured to send them."""
    assert list(TextReader(SLCAN).feed(b"t18180102030405060708ABCD\r")) == [FRAME]
