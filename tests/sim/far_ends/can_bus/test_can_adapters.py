"""The far end's adapters against python-can's own interfaces, and against text by hand."""

import asyncio
from collections.abc import AsyncIterator
from functools import partial

import can
import pytest

from drivers.wires.can_frames import CanFrame
from model.rig.rig import Rig
from real_wires import make_bench
from sim.far_ends.can_amplifiers import CanBus, SlcanAdapter, SocketcandClient
from sim.faults import Faults
from sim.transport.far_end import TcpEnd, TerminalEnd

TIMEOUT = 60.0  # s; for a loaded machine, not an expectation
FRAME = CanFrame(0x181, bytes.fromhex("0102030405060708"))


class Member:
    """A member of the bus, with the frames `heard`."""

    def __init__(self, bus: CanBus) -> None:
        self.heard: list[CanFrame] = []
        self._bus = bus
        self._listener = self.heard.append
        bus.join(self._listener)

    def send(self, frame: CanFrame) -> None:
        """To all others."""
        self._bus.send(frame, sender=self._listener)

    async def hears(self, count: int) -> list[CanFrame]:
        """Wait for so many frames."""
        async with asyncio.timeout(TIMEOUT):
            while len(self.heard) < count:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
        return self.heard


@pytest.fixture
def bus() -> CanBus:
    """A bus without members."""
    return CanBus()


@pytest.fixture
async def server(bus: CanBus, coarse_rig: Rig) -> AsyncIterator[TcpEnd]:
    """A socketcand server on a free port."""
    device = make_bench(coarse_rig)[1]["main"]
    async with TcpEnd(device, partial(SocketcandClient, bus), faults=Faults()) as end:
        yield end


class Talk:
    """A connection on which text is written by hand."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def says(self, text: str) -> None:
        """The server says this next."""
        async with asyncio.timeout(TIMEOUT):
            assert await self.reader.readexactly(len(text)) == text.encode()

    async def open(self) -> None:
        """Open the bus in raw mode."""
        await self.ask("< open can0 >", "< ok >")
        await self.ask("< rawmode >", "< ok >")

    async def ask(self, text: str, answer: str = "") -> None:
        """Write, and read the answer."""
        self.writer.write(text.encode())
        await self.says(answer)


@pytest.fixture
async def talk(server: TcpEnd) -> AsyncIterator[Talk]:
    """Greeted."""
    talk = Talk(*await asyncio.open_connection("127.0.0.1", server.port))
    await talk.says("< hi >")
    yield talk
    talk.writer.close()


async def test_socketcand_session(bus: CanBus, talk: Talk) -> None:
    """Greeting, open, raw mode, frames each way, echo; elements in pieces and in a row."""
    member = Member(bus)
    await talk.open()
    await talk.ask("< send 123 2 1 F")
    await talk.ask("F >< send 7FF 0 >< echo >", "< echo >")
    assert member.heard == [CanFrame(0x123, b"\x01\xff"), CanFrame(0x7FF, b"")]
    member.send(FRAME)
    async with asyncio.timeout(TIMEOUT):
        text = (await talk.reader.readuntil(b">")).decode()
    assert text.startswith("< frame 181 ")
    assert text.endswith(" 0102030405060708 >")


@pytest.mark.parametrize(
    "nonsense",
    [
        *("< send 123 3 1 2 >", "< send 800 0 >", "< send 00000123 0 >", "< send x 1 1 >"),
        *("< send 123 9 1 2 3 4 5 6 7 8 9 >", "<>", ">"),
        *("a" * 2000, "< send 123 1 100 >", "\x00\xff< send"),
    ],
)
async def test_socketcand_ignores_malformed_frames(bus: CanBus, talk: Talk, nonsense: str) -> None:
    """Whatever is wrong with an element, no frame comes of it, and the next is understood."""
    member = Member(bus)
    await talk.open()
    await talk.ask(nonsense + " >")
    async with asyncio.timeout(TIMEOUT):
        talk.writer.write(b"< send 123 1 5 >< echo >")
        assert (await talk.reader.readuntil(b"< echo >")).endswith(b"< echo >")
    assert member.heard == [CanFrame(0x123, b"\x05")]


async def test_socketcand_refuses_another_bus(talk: Talk) -> None:
    """A client that opens another bus is disconnected."""
    await talk.ask("< open vcan7 >", "< error could not open bus >")
    async with asyncio.timeout(TIMEOUT):
        assert await talk.reader.read() == b""


@pytest.fixture
async def adapter(bus: CanBus, coarse_rig: Rig) -> AsyncIterator[TerminalEnd]:
    """A serial adapter."""
    device = make_bench(coarse_rig)[1]["main"]
    async with TerminalEnd(device, partial(SlcanAdapter, bus), faults=Faults()) as end:
        yield end


async def test_slcan_serves_python_can(bus: CanBus, adapter: TerminalEnd) -> None:
    """Its own interface sets the bit rate, opens the channel, sends and hears."""
    member = Member(bus)

    def connect() -> can.BusABC:
        return can.Bus(
            interface="slcan",
            channel=adapter.port,
            bitrate=500_000,
            sleep_after_open=0,
            ignore_config=True,
        )

    client = await asyncio.to_thread(connect)
    try:
        sent = can.Message(arbitration_id=FRAME.id, data=FRAME.data, is_extended_id=False)
        await asyncio.to_thread(client.send, sent)
        assert await member.hears(1) == [FRAME]
        member.send(FRAME)
        received = None
        async with asyncio.timeout(TIMEOUT):
            while received is None:
                received = await asyncio.to_thread(client.recv, 1.0)
        assert (received.arbitration_id, bytes(received.data)) == (FRAME.id, FRAME.data)
    finally:
        await asyncio.to_thread(client.shutdown)


def answers(adapter_bus: CanBus, text: bytes) -> tuple[bytes, list[CanFrame]]:
    """What an adapter writes to text, and what goes onto the bus."""
    written: list[bytes] = []
    adapter = SlcanAdapter(adapter_bus, written.append)
    member = Member(adapter_bus)
    adapter.receive(text, 0.0)
    adapter.close()
    return b"".join(written), member.heard


@pytest.mark.parametrize(
    ("text", "written", "sent"),
    [
        (b"C\rS6\rO\rt1232AABB\rC\r", b"\r\r\rz\r\r", [CanFrame(0x123, b"\xaa\xbb")]),
        (b"t1230\r", b"\x07", []),  # closed
        (b"S6\rL\rt1230\r", b"\r\r\x07", []),  # listening only
        (b"O\rS6\r", b"\r\x07", []),  # the bit rate of an open channel
        (b"O\rt1233AABB\rt12391\rq\rt8000\r", b"\r\x07\x07\x07\x07", []),
        (b"O\rT000001230\rr1230\r", b"\rZ\rz\r", []),  # no receiver has such identifiers
        (b"V\rN\r", b"V1013\rNE0A1\r", []),
        (b"O\r" + b"x" * 500, b"\r\x07", []),
    ],
)
def test_slcan_replies_like_lawicel(
    bus: CanBus, text: bytes, written: bytes, sent: list[CanFrame]
) -> None:
    """CR for what was done, BELL for what makes no sense, z and Z for frames that were sent."""
    assert answers(bus, text) == (written, sent)
