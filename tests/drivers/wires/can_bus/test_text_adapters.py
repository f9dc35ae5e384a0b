"""CAN adapters that speak text, as they open: socketcand's greeting, slcan's commands."""

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

import pytest

from drivers.errors import LinkError
from drivers.opening import Lines
from drivers.ports import PORT_OPENER
from drivers.wires import can_bus
from drivers.wires.can_bus import SlcanAddress, TextPort
from drivers.wires.can_frames import SLCAN, CanFrame, pack_frames, unpack_frames
from drivers.wires.known import address_of
from registry.limits import GuardLimits
from virtual_lines import in_virtual_time

FRAME = CanFrame(0x185, bytes.fromhex("0102030405060708"))
ELEMENT = b"< frame 185 1.000000 0102030405060708 >"
SLCAN_SPOKEN = b"\rC\rS5\rO\rt18580102030405060708\r\rC\r"


@asynccontextmanager
async def server(*replies: bytes, accepted: asyncio.Event | None = None) -> AsyncIterator[str]:
    """A server that greets with the first text, and replies to each element with the next.

    Its URL, of node 5. After the last text it closes the connection if that is empty.
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
    try:
        yield f"can+socketcand://127.0.0.1:{listening.sockets[0].getsockname()[1]}/can0#5"
    finally:
        listening.close()
        async with asyncio.timeout(60.0):
            await ended.wait()
        await asyncio.sleep(0)  # the connection ends


async def open_port(url: str, on_data: Callable[[bytes], None]) -> None:
    """Open a URL's port, and close it once it has handed something over."""
    done = asyncio.Event()

    def received(data: bytes) -> None:
        on_data(data)
        done.set()

    port = await address_of(url).open_port(received, lambda cause: done.set())
    await done.wait()
    port.close()
    await port.wait_closed()


async def test_frames_amid_the_greeting_do_not_disturb_it() -> None:
    """A bus on which others speak; what follows the last reply at once is handed over, too."""
    heard: list[CanFrame] = []
    long = b"< frame 1FFFFFFF 1.000000 01 >"
    greeting = (b"< hi >", ELEMENT + long + b"< ok >", ELEMENT + b"< ok >" + ELEMENT)
    async with server(*greeting) as url:
        await open_port(url, lambda data: heard.extend(unpack_frames(data)))
    assert heard == [FRAME] * 3


@pytest.mark.parametrize(
    ("replies", "problem"),
    [
        ((b"< error no such bus >",), "no such bus"),
        ((b"< hi >", b"< error could not open bus >"), "could not open"),
        ((b"< hi >", b""), "was lost"),
        ((b"nonsense",), "no reply within"),
    ],
)
async def test_server_that_does_not_open_the_bus_is_told(
    replies: tuple[bytes, ...], problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error, a closed connection, or no reply at all: with the remedy."""
    monkeypatch.setattr(can_bus, "_GREETING_TIMEOUT", 0.2)
    async with server(*replies) as url:
        with pytest.raises(LinkError, match=rf"(?s){problem}.*check address and port"):
            await open_port(url, lambda data: None)


async def test_opening_that_is_given_up_leaves_nothing() -> None:
    """The server has accepted, and says nothing: the connection ends with the caller."""
    lines = Lines()
    limits = GuardLimits(20.0, 1000.0, 1.0)
    accepted = asyncio.Event()
    async with server(b" ", accepted=accepted) as url:  # which ends with its connection
        opening = asyncio.ensure_future(lines.amplifier(url, limits, name="a"))
        await accepted.wait()
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
    await lines.close()


async def test_slcan_is_closed_then_opened_at_its_bit_rate_and_closed_at_the_end() -> None:
    """LAWICEL's commands: C, S5 for 250 kbit/s, O; a frame as t with its bytes in hexadecimal."""
    master, slave = os.openpty()
    try:
        url = f"can+slcan://{os.ttyname(slave)}?bitrate=250000#5"
        port = await address_of(url).open_port(lambda data: None, lambda cause: None)
        port.write(pack_frames([FRAME]))
        port.close()
        await port.wait_closed()
        text = b""
        async with asyncio.timeout(60.0):
            while len(text) < len(SLCAN_SPOKEN):
                text += await asyncio.to_thread(os.read, master, 100)
    finally:
        os.close(master)
        os.close(slave)
    assert text == SLCAN_SPOKEN


@in_virtual_time
async def test_slcan_adapter_that_restarts_is_opened_again_until_it_speaks() -> None:
    """Commands go before frames until one has come, and again when none has come for a second.

    Text with BEL at its end is an error of the adapter, as frames have no such identifier.
    """

    class Below:
        is_blocked = False
        written = b""

        def write(self, data: bytes) -> None:
            self.written += data

    heard: list[CanFrame] = []
    port = TextPort(SLCAN, lambda data: heard.extend(unpack_frames(data)), hello=b"O\r")
    port.below = below = Below()  # type: ignore[assignment]
    for came in (b"\r\nrst:0x1 (POWERON_RESET)\r\n", b"\r\x07", b"t18580102030405060708\r", b"\r"):
        port.write(pack_frames([FRAME]))
        port.received(came)
    await asyncio.sleep(1.1)
    port.write(pack_frames([FRAME]))
    sent = b"t18580102030405060708\r"
    assert below.written == 3 * (b"O\r" + sent) + sent + b"O\r" + sent
    assert heard == [CanFrame(0x800, b"\r\x07"), FRAME]


async def test_text_that_no_adapter_replies_with_is_an_error() -> None:
    """Replies, frames of other kinds and line ends CR LF are none; a modem's or a shell's text is.

    By LAWICEL's CANUSB manual: V, N, F and z.
    """

    class Below:
        is_blocked = False

    async def opener(name: str, on_data: object, on_loss: object) -> object:
        return Below()

    PORT_OPENER.set(opener)  # type: ignore[arg-type]
    heard: list[CanFrame] = []
    port = await SlcanAddress("can+slcan:///dev/ttyACM0#5").open_port(
        lambda data: heard.extend(unpack_frames(data)), lambda cause: None
    )
    replies = b"V1013\rNA123\r\nF40\rz\r\r\nT0000018100\rr1230\rt18580102030405060708\r\n"
    port.received(replies)  # type: ignore[attr-defined]
    assert heard == [FRAME]
    port.received(b"AT\r\nERROR\r\n")  # type: ignore[attr-defined]
    assert [(frame.id, frame.data) for frame in heard[1:]] == [(0x800, b"AT"), (0x800, b"ERROR")]


async def test_line_that_was_cut_off_is_ended_before_the_next_frame() -> None:
    """A port that has not taken all drops the rest of a line: a CR of its own ends that."""

    class Blocked:
        is_blocked = True
        written = b""

        def write(self, data: bytes) -> None:
            self.written += data

    port = TextPort(SLCAN, lambda data: None, cut_off=b"\r")
    port.below = below = Blocked()  # type: ignore[assignment]
    port.write(pack_frames([FRAME]))
    assert below.written == b"\rt18580102030405060708\r"
