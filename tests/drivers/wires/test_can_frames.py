"""Messages of protocol 4 in CAN frames, and the buses and adapters that carry these.

Bytes are worked out by hand from the protocol page. Frames as text of adapters, the greeting of
socketcand and the commands of slcan, a transmit queue of python-can that is full, error frames,
losses.
"""

import asyncio
import errno
import os
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import AsyncMock, Mock

import can
import pytest

from drivers.errors import LinkError, WireCounters
from drivers.opening import Lines
from drivers.ports import PORT_OPENER
from drivers.protocol.definition import MESSAGES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers
from drivers.wires import can_interfaces, can_text
from drivers.wires.can_frames import (
    SLCAN,
    SOCKETCAND,
    Assembler,
    CanFrame,
    CanMessage,
    TextFormat,
    TextReader,
    frames_of,
    pack_frames,
    segments,
    unpack_frames,
)
from drivers.wires.can_interfaces import BusPort, Interface, Outbox
from drivers.wires.can_text import SlcanAddress, TextPort
from drivers.wires.wire import address_of
from kit.clock import in_virtual_time
from kit.courses import Taken, courses, follow
from kit.wires import hanging_interface, until
from registry.limits import GuardLimits

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


SET = ("1300050a34120700", "1301020081000100", "130200002000d007", "13038813d8dc0000")
"""Session 1234, token 7, part 0 of 1; layer 1 along 1 ms: channel 2, 100 Hz, 0.5, -90 degrees."""
REQUESTS: dict[str, tuple[int, Values, tuple[str, ...]]] = {
    "GetStatus": (0x11, {}, ("1100090000000000",)),
    "Arm": (
        0x12,
        {"session": 0x1234, "watchdog": 250, "shift": 0},
        ("120003033412fa00", "1201000000000000"),
    ),
    "Set": (
        0x13,
        {
            **{"session": 0x1234, "token": 7, "index": 0, "parts": 1, "now": 0},
            "stream": pack_layers(
                [LayerSet(1, ramp=1, valid_for=0, commands=(Command(2, 2000, 5000, -9000),))]
            ),
        },
        SET,
    ),
    "Commit": (
        0,
        {"session": 0x1234, "token": 7, "at": 0x0102},
        ("0000060334120700", "0001020100000000"),
    ),  # a broadcast
}


@pytest.mark.parametrize("name", REQUESTS)
def test_requests_have_the_bytes_of_the_protocol_page(name: str) -> None:
    """Number, index, type, count and two words, then three words each, low byte first."""
    number, values, expected = REQUESTS[name]
    message = MESSAGES[name]
    made = segments(number, message.number, message.request.pack(values))
    assert [data.hex() for data in made] == [*expected]


@pytest.mark.parametrize("words", [0, 1, 2, 3, 5, 6, 119, 120])
def test_frames_of_every_length_hold_all_words(words: int) -> None:
    """Two words in the first frame and three in each other; 120 words are 41 frames."""
    made = segments(9, 5, range(words))
    assert len(made) == frames_of(words) == 1 + max(0, -(-(words - 2) // 3))
    whole = Assembler(WireCounters())
    *_, last = (whole.add(data, 0.0) for data in reversed(made))
    assert last == CanMessage(9, 5, tuple(range(words)))


_FIRST, _SECOND = segments(5, 5, range(5))
_EVENT, _END = segments(0, 30, [4, 0, 255, 1])
_OTHER_EVENT, _ = segments(0, 30, [5, 0, 255, 1])
_MINE, _YOURS = segments(6, 5, range(8)), segments(6, 5, range(1, 9))
ASSEMBLED: dict[str, tuple[bool, Sequence[tuple[bytes, float, CanMessage | None]], int]] = {
    # Newer is one that follows by at most 127; after 0.1 s without a frame any is.
    **{
        f"{number} after {last}": (
            True,
            [
                (*segments(last, 9, []), 0.0, CanMessage(last, 9, ())),
                (*segments(number, 9, []), 0.05, CanMessage(number, 9, ()) if is_taken else None),
                (*segments(number, 9, []), 0.2, CanMessage(number, 9, ())),
            ],
            0,
        )
        for last, number, is_taken in (
            *((1, 2, True), (255, 1, True), (1, 128, True)),
            *((1, 129, False), (2, 1, False), (1, 255, False)),
        )
    },
    # A frame 0.11 s later is no part of it, though its number is the same.
    "incomplete": (True, [(_FIRST, 0.0, None), (_SECOND, 0.11, None)], 0),
    # Two that differ under one number and index are believed neither way.
    "of two senders": (
        True,
        [(each, 0.0, None) for each in (_MINE[0], _YOURS[0], *_MINE[1:], *_YOURS[1:])],
        1,
    ),
    # An event that lost its end is followed by a whole one; none has a number.
    "without a number": (
        False,
        [
            *((each, 0.0, None) for each in (_END, _OTHER_EVENT, _EVENT)),
            (_END, 0.0, CanMessage(0, 30, (4, 0, 255, 1))),
        ],
        0,
    ),
}
"""Frames with the times at which they come [s], and the message that each completes.

Whether they are numbered, and how many are invalid.
"""


@pytest.mark.parametrize("case", ASSEMBLED)
def test_frames_make_the_message_that_was_sent_or_none(case: str) -> None:
    """Numbers wrap from 255 to 1; what is incomplete, late or of two senders makes none."""
    is_numbered, frames, invalid = ASSEMBLED[case]
    counters = WireCounters()
    whole = Assembler(counters, is_numbered=is_numbered)
    assert [whole.add(data, at) for data, at, _ in frames] == [expected for *_, expected in frames]
    assert counters.invalid_frames == invalid


SOCKETCAN = Interface(is_watched=True, sends_at_once=True, full_code=105, bus_off=0x40)
"""ENOBUFS of Linux, and CAN_ERR_BUSOFF of linux/can/error.h."""
BURST = [CanFrame(0x201, bytes([number])) for number in range(22)]
COMMIT = [CanFrame(0x200, b"commit")]
FRAMES = {
    **{"burst": BURST, "commit": COMMIT, "commit and burst": COMMIT + BURST},
    "stop": [CanFrame(0x201, b"stop")],
}


class Adapter(can.BusABC):
    """An adapter with room for some frames; incoming: what is received next."""

    def __init__(self) -> None:
        self.room = 10  # txqueuelen of Linux
        self.taken: list[bytes] = []
        self.incoming: list[can.Message] = []
        self.ends = os.pipe()
        super().__init__(channel="0")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if not self.room:
            raise can.CanOperationError("no buffer space", error_code=errno.ENOBUFS)
        self.room -= 1
        self.taken.append(bytes(msg.data))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self.incoming.pop(0) if self.incoming else None), False

    def fileno(self) -> int:
        return self.ends[0]


@asynccontextmanager
async def opened(
    heard: Callable[[bytes], None] = lambda data: None, interface: Interface = SOCKETCAN
) -> AsyncIterator[tuple[BusPort, Adapter, list[str]]]:
    """A port, its adapter, and its losses; heard: called with what it receives."""
    adapter, losses = Adapter(), list[str]()
    port = BusPort(adapter, "can0", heard, losses.append, interface)
    try:
        yield port, adapter, losses
    finally:
        port.close()
        await port.wait_closed()
        for each in adapter.ends:
            os.close(each)


@dataclass(kw_only=True)
class OnABus(Taken):
    """A port of a bus, its adapter, and its losses."""

    port: BusPort
    adapter: Adapter
    losses: list[str]
    burst: list[bytes] = field(default_factory=lambda: [frame.data for frame in BURST])

    def writes(self, *names: str) -> None:
        """Write frames by their names, each at once."""
        for name in names:
            self.port.write(pack_frames(FRAMES[name]))

    def hears_errors(self, *classes: int) -> None:
        """Let the adapter give error frames of these classes."""
        self.adapter.incoming += [
            can.Message(arbitration_id=each, is_error_frame=True) for each in classes
        ]
        self.port.poll()

    def is_unplugged(self) -> None:
        """Let the adapter be gone for the next frame."""
        unplugged = can.CanOperationError("No such device", error_code=errno.ENODEV)
        self.adapter.send = Mock(side_effect=unplugged)  # type: ignore[method-assign]


@asynccontextmanager
async def on_a_bus() -> AsyncIterator[OnABus]:
    """A port that is open."""
    async with opened() as (port, adapter, losses):
        yield OnABus(port=port, adapter=adapter, losses=losses)


COURSES = courses(Path(__file__).with_name("bus.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_port_of_a_bus_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], on_a_bus)


async def test_reader_thread_hands_over_frames_in_order_until_the_adapter_is_gone() -> None:
    """Frames that came before are handed over first; the thread ends, and the loss is told once."""
    heard: list[bytes] = []
    reads_in_thread = replace(SOCKETCAN, is_watched=False, sends_at_once=False)
    async with opened(heard.append, reads_in_thread) as (port, adapter, losses):
        port.poll()  # left to the thread
        frames = [CanFrame(0x181, bytes([number])) for number in range(3)]
        adapter.incoming += [
            *(can.Message(arbitration_id=0x181, is_extended_id=False, data=f.data) for f in frames),
            can.Message(arbitration_id=0x40, is_error_frame=True),
        ]
        await until(lambda: bool(losses))
        assert heard == [pack_frames([frame]) for frame in frames]
    assert len(losses) == 1


def _caused_by(cause: can.CanError) -> can.CanError:
    error = can.CanOperationError()
    error.__cause__ = cause
    return error


FULL: dict[str, can.CanError] = {
    "socketcan": can.CanOperationError("Transmit buffer full"),
    "socketcan queue": can.CanOperationError("Failed to transmit", errno.ENOBUFS),
    "pcan": can.CanOperationError("Failed to send: The transmit queue is full."),
    "pcan controller": can.CanOperationError("Transmit buffer in CAN controller is full"),
    "kvaser": can.CanOperationError("Function canWrite failed", -13),
    "vector": can.CanOperationError("xlCanTransmit failed", 11),
    "systec": _caused_by(can.CanError("Function UcanWriteCanMsgEx", 11)),
    "usb2can": can.CanOperationError("could not send message", 9),
    "ixxat": can.CanTimeoutError("Function canChannelSendMessage"),
}
"""The error of python-can 4.6 and of the vendor's library for a full transmit queue."""


async def losses_after(
    interface: str, error: can.CanError, monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    """Send a frame to a bus whose first `send` fails; returns the losses once it is sent again."""
    adapter, losses = Adapter(), list[str]()
    send = Mock(side_effect=[error, None])
    monkeypatch.setattr(adapter, "send", send)
    monkeypatch.setattr(can, "Bus", Mock(return_value=adapter))
    monkeypatch.setattr(can_interfaces, "FULL_TIMEOUT", 60.0)
    bus = {"interface": interface, "channel": 0, "bitrate": 500_000}
    port = await can_interfaces.open_bus("can0", bus, lambda data: None, losses.append)
    with suppress(LinkError):
        port.write(pack_frames(FRAMES["stop"]))
    await until(lambda: send.call_count == 2 or bool(losses))
    port.close()
    await port.wait_closed()
    for each in adapter.ends:
        os.close(each)
    return losses


@pytest.mark.parametrize("case", FULL)
async def test_full_queue_of_any_interface_is_no_loss(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frame is sent again once there may be room."""
    assert await losses_after(case.split()[0], FULL[case], monkeypatch) == []


async def test_code_of_another_interface_is_a_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """11 is a full queue of Vector, and any error of another interface."""
    assert len(await losses_after("gs_usb", FULL["vector"], monkeypatch)) == 1


async def test_only_error_frames_of_linux_report_bus_off() -> None:
    """Other interfaces have their own identifiers of error frames."""
    async with opened(interface=Interface(is_watched=True)) as (port, adapter, losses):
        adapter.incoming.append(can.Message(arbitration_id=0x40, is_error_frame=True))
        port.poll()
        assert not losses


async def test_thread_sends_a_stop_next_after_a_call_that_hangs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a real interface only the broadcast stays ahead of it; the rest of the set is dropped."""
    monkeypatch.setattr(can_interfaces, "FULL_TIMEOUT", 60.0)
    bus = {"interface": "hanging", "channel": "stop first"}
    with (
        hanging_interface() as adapter,
        can.Bus(interface="virtual", channel="stop first") as other,
    ):
        port = await can_interfaces.open_bus("can0", bus, lambda data: None, pytest.fail)
        adapter.hangs = True
        for name in ("burst", "commit", "burst"):
            port.write(pack_frames(FRAMES[name]))
            await until(lambda: adapter.sending == 1)
        port.write(pack_frames(FRAMES["stop"]))
        assert port.is_blocked
        adapter.resume()
        heard = [await asyncio.to_thread(other.recv, 60.0) for _ in range(3)]
        assert [bytes(message.data) for message in heard] == [b"\0", b"commit", b"stop"]
        await until(lambda: not port.is_blocked)
        port.close()
        await port.wait_closed()
        assert other.recv(0.0) is None


@pytest.mark.parametrize(
    ("taken_at", "following"), [(0.02, BURST[1]), (0.05, None)], ids=["soon", "late"]
)
def test_rest_of_a_set_is_dropped_if_the_adapter_took_too_long_for_a_frame(
    taken_at: float, following: CanFrame | None
) -> None:
    """A request is given up after 30 ms without progress; a newer one is sent however late."""
    outbox = Outbox()
    outbox.put(BURST, 0.0)
    first = outbox.first(0.001)
    assert first is BURST[0]
    outbox.taken(first, taken_at)
    assert outbox.first(taken_at) is following
    outbox.put(FRAMES["stop"], taken_at)
    assert outbox.first(taken_at) is FRAMES["stop"][0]


FRAME_AS_TEXT = CanFrame(0x185, bytes.fromhex("0102030405060708"))
ELEMENT = b"< frame 185 1.000000 0102030405060708 >"
SLCAN_SPOKEN = b"\rC\rS5\rO\rt18580102030405060708\r\rC\r"


def written(port: TextPort) -> bytes:
    """All that was written to a mock port below."""
    return b"".join(data for ((data,), _) in port.below.write.call_args_list)


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
    assert heard == [FRAME_AS_TEXT] * 3


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
    monkeypatch.setattr(can_text, "GREETING_TIMEOUT", 0.2)
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
        port.write(pack_frames([FRAME_AS_TEXT]))
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

    heard: list[CanFrame] = []
    port = TextPort(SLCAN, lambda data: heard.extend(unpack_frames(data)), hello=b"O\r")
    port.below = Mock(is_blocked=False)
    for came in (b"\r\nrst:0x1 (POWERON_RESET)\r\n", b"\r\x07", b"t18580102030405060708\r", b"\r"):
        port.write(pack_frames([FRAME_AS_TEXT]))
        port.received(came)
    await asyncio.sleep(1.1)
    port.write(pack_frames([FRAME_AS_TEXT]))
    sent = b"t18580102030405060708\r"
    assert written(port) == 3 * (b"O\r" + sent) + sent + b"O\r" + sent
    assert heard == [CanFrame(0x800, b"\r\x07"), FRAME_AS_TEXT]


async def test_text_that_no_adapter_replies_with_is_an_error() -> None:
    """Replies, frames of other kinds and line ends CR LF are none; a modem's or a shell's text is.

    By LAWICEL's CANUSB manual: V, N, F and z.
    """
    PORT_OPENER.set(AsyncMock(return_value=Mock(is_blocked=False)))
    heard: list[CanFrame] = []
    port = await SlcanAddress("can+slcan:///dev/ttyACM0#5").open_port(
        lambda data: heard.extend(unpack_frames(data)), lambda cause: None
    )
    replies = b"V1013\rNA123\r\nF40\rz\r\r\nT0000018100\rr1230\rt18580102030405060708\r\n"
    port.received(replies)  # type: ignore[attr-defined]
    assert heard == [FRAME_AS_TEXT]
    port.received(b"AT\r\nERROR\r\n")  # type: ignore[attr-defined]
    assert [(frame.id, frame.data) for frame in heard[1:]] == [(0x800, b"AT"), (0x800, b"ERROR")]


async def test_line_that_was_cut_off_is_ended_before_the_next_frame() -> None:
    """A port that has not taken all drops the rest of a line: a CR of its own ends that."""

    port = TextPort(SLCAN, lambda data: None, cut_off=b"\r")
    port.below = Mock(is_blocked=True)
    port.write(pack_frames([FRAME_AS_TEXT]))
    assert written(port) == b"\rt18580102030405060708\r"
