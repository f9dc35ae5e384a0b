"""CAN frames as text: adapters with LAWICEL's commands (slcan), and socketcand servers."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from unittest.mock import AsyncMock, Mock

import pytest

from drivers.errors import LinkError
from drivers.ports import PORT_OPENER
from drivers.wires import can_text
from drivers.wires.can_frames import (
    SLCAN,
    SOCKETCAND,
    CanFrame,
    TextFormat,
    TextReader,
    pack_frames,
    unpack_frames,
)
from drivers.wires.can_text import SlcanAddress, TextPort
from drivers.wires.wire import address_of
from kit.clock import in_virtual_time

FRAME = CanFrame(0x185, bytes.fromhex("0102030405060708"))
SLCAN_LINE = b"t18580102030405060708\r"
ELEMENT = b"< frame 185 1.000000 0102030405060708 >"
RECEIVED = {SLCAN: SLCAN_LINE, SOCKETCAND: ELEMENT}
"""The frame as it is received in each format."""


# Format


def test_text_format_encodes_a_frame() -> None:
    """With eight bytes and without data, against text written by hand."""
    assert SLCAN.encode(FRAME) == SLCAN_LINE
    assert SLCAN.encode(CanFrame(0x80, b"")) == b"t0800\r"
    assert SOCKETCAND.encode(FRAME) == b"< send 185 8 01 02 03 04 05 06 07 08 >"


SKIPPED_LINES = {
    "too short": b"t1818010203",
    "too long": b"t18190102030405060708090A",
    "large identifier": b"tFFF8" + b"00" * 8,
    "without data": b"t18",
    "long identifier": b"T000001818" + b"00" * 8,
    "remote": b"r1810",
    "CAN FD": b"d18180102030405060708",
    "reply": b"z",
    "empty": b"",
    "error": b"\x07",
}
SKIPPED_ELEMENTS = {
    "reply": b"< ok >",
    "error": b"< error unknown command >",
    "long identifier": b"< frame 1FFFFFFF 1.5 00 >",
    "without data": b"< frame 181 >",
    "half a byte": b"< frame 181 1.5 0 >",
    "no time": b"< frame 181 x 00 >",
    "no start": b"frame 181 1.5 00 >",
    "only starts": b"<<<>",
    "too long": b"< frame 181 1.5 000000000000000000 >",
    "CAN FD": b"< fdframe 181 00 1.5 00 >",
}
SKIPPED = [
    *((SLCAN, line + b"\r") for line in SKIPPED_LINES.values()),
    *((SOCKETCAND, element) for element in SKIPPED_ELEMENTS.values()),
]


@pytest.mark.parametrize(("text_format", "text"), SKIPPED)
def test_text_reader_skips_text_that_is_no_frame(text_format: TextFormat, text: bytes) -> None:
    """The next frame is understood."""
    reader = TextReader(text_format)

    assert list(reader.feed(text)) == []
    assert list(reader.feed(RECEIVED[text_format])) == [FRAME]


# socketcand


@asynccontextmanager
async def server(*replies: bytes, accepted: asyncio.Event | None = None) -> AsyncIterator[str]:
    """Start a server that sends the first text, and replies to each element with the next.

    An empty last text closes the connection. Yields a URL of node 5.
    """
    ended = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if accepted is not None:
            accepted.set()
        with suppress(EOFError, ConnectionError):
            for reply in replies:
                writer.write(reply)
                if reply:
                    await reader.readuntil(b">")
            if replies[-1]:
                await reader.read()
        writer.close()
        ended.set()

    listening = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = listening.sockets[0].getsockname()[1]
    try:
        yield f"can+socketcand://127.0.0.1:{port}/can0#5"
    finally:
        listening.close()
        async with asyncio.timeout(60.0):
            await ended.wait()
        await asyncio.sleep(0)  # the connection ends


async def frames_from(url: str) -> list[CanFrame]:
    """Return the first frames that come from a URL's port."""
    frames: list[CanFrame] = []
    done = asyncio.Event()

    def receive(data: bytes) -> None:
        frames.extend(unpack_frames(data))
        done.set()

    port = await address_of(url).open_port(receive, lambda cause: done.set())
    await done.wait()
    port.close()
    await port.wait_closed()
    return frames


async def test_socketcand_greeting_may_be_interrupted_by_frames() -> None:
    """Others use the bus; frames that follow the last reply immediately are received, too."""
    extended = b"< frame 1FFFFFFF 1.000000 01 >"
    replies = (b"< hi >", ELEMENT + extended + b"< ok >", ELEMENT + b"< ok >" + ELEMENT)
    async with server(*replies) as url:
        assert await frames_from(url) == [FRAME] * 3


@pytest.mark.parametrize(
    ("replies", "problem"),
    [
        ((b"< error no such bus >",), "no such bus"),
        ((b"< hi >", b"< error could not open bus >"), "could not open"),
        ((b"< hi >", b""), "was lost"),
        ((b"nonsense",), "no reply within"),
    ],
)
async def test_socketcand_server_that_does_not_open_the_bus_is_reported_with_a_remedy(
    replies: tuple[bytes, ...], problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error, a closed connection, or no reply at all."""
    monkeypatch.setattr(can_text, "GREETING_TIMEOUT", 0.2)
    async with server(*replies) as url:
        with pytest.raises(LinkError, match=rf"(?s){problem}.*check address and port"):
            await frames_from(url)


# slcan


async def test_slcan_adapter_is_closed_then_opened_at_its_bit_rate_and_closed_at_the_end() -> None:
    """LAWICEL's commands C, S5 for 250 kbit/s, O; a frame is t with its bytes in hexadecimal."""
    expected = b"\rC\rS5\rO\r" + SLCAN_LINE + b"\rC\r"
    far, near = os.openpty()
    try:
        url = f"can+slcan://{os.ttyname(near)}?bitrate=250000#5"
        port = await address_of(url).open_port(lambda data: None, lambda cause: None)
        port.write(pack_frames([FRAME]))
        port.close()
        await port.wait_closed()

        sent = b""
        async with asyncio.timeout(60.0):
            while len(sent) < len(expected):
                sent += await asyncio.to_thread(os.read, far, 100)
    finally:
        os.close(far)
        os.close(near)
    assert sent == expected


class AdapterText:
    """A port to a text adapter: the text that it sends and the frames that it receives."""

    def __init__(self, *, is_blocked: bool = False, **options: bytes) -> None:
        self.frames: list[CanFrame] = []
        self.port = TextPort(SLCAN, self._receive, **options)
        self._write = Mock()
        self.port.below = Mock(is_blocked=is_blocked, write=self._write)

    def _receive(self, data: bytes) -> None:
        self.frames.extend(unpack_frames(data))

    @property
    def sent(self) -> bytes:
        """All text written so far."""
        return b"".join(call.args[0] for call in self._write.call_args_list)


@in_virtual_time
async def test_slcan_adapter_that_restarts_is_opened_again_until_a_frame_arrives() -> None:
    """Commands precede frames until one has arrived, and again after a second without one.

    Text with BEL at its end is an error of the adapter, and becomes a frame with an identifier
    that no frame has.
    """
    adapter = AdapterText(hello=b"O\r")
    for text in (b"\r\nrst:0x1 (POWERON_RESET)\r\n", b"\r\x07", SLCAN_LINE, b"\r"):
        adapter.port.write(pack_frames([FRAME]))
        adapter.port.received(text)
    await asyncio.sleep(1.1)

    adapter.port.write(pack_frames([FRAME]))

    opened_and_sent = b"O\r" + SLCAN_LINE
    assert adapter.sent == 3 * opened_and_sent + SLCAN_LINE + opened_and_sent
    assert adapter.frames == [CanFrame(0x800, b"\r\x07"), FRAME]


async def test_slcan_text_that_is_no_reply_of_an_adapter_is_an_error() -> None:
    """V, N, F and z are replies by LAWICEL's CANUSB manual; the text of a modem is none."""
    PORT_OPENER.set(AsyncMock(return_value=Mock(is_blocked=False)))
    frames: list[CanFrame] = []
    address = SlcanAddress("can+slcan:///dev/ttyACM0#5")
    port = await address.open_port(
        lambda data: frames.extend(unpack_frames(data)), lambda cause: None
    )
    assert isinstance(port, TextPort)

    port.received(b"V1013\rNA123\r\nF40\rz\r\r\nT0000018100\rr1230\r" + SLCAN_LINE + b"\n")
    port.received(b"AT\r\nERROR\r\n")

    assert frames == [FRAME, CanFrame(0x800, b"AT"), CanFrame(0x800, b"ERROR")]
