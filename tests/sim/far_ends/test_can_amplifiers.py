"""Far ends of protocol 4 on real ports: CAN, its adapters, and Modbus with masters of others.

Bytes are written by hand, frames as identifier and data in hexadecimal digits, and some are lost;
adapters are compared with the interfaces of python-can.
"""

import asyncio
import contextlib
import os
import socket
import struct
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial

import can
import pytest

from drivers.errors import LinkError
from drivers.protocol.definition import REFUSALS
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_frames import Frame, FrameReader, encode_frame
from model.rig.rig import Rig
from real_wires import MASTERS, drive, far_side, make_bench, until
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import CanAmplifiers, CanBus, SlcanAdapter, SocketcandClient
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import Faults
from sim.transport.far_end import TcpEnd, TerminalEnd


@pytest.mark.parametrize("name", MASTERS)
async def test_foreign_master_drives_it(name: str, coarse_rig: Rig) -> None:
    """Reads by both functions, writes, a set, and an exception, over a real line."""
    line, make = MASTERS[name]
    async with far_side(SimulatedWire(f"modbus-{line}"), coarse_rig) as far:
        assert await asyncio.to_thread(drive, make, far.url) == "era-haptics"


TIMEOUT = 60.0  # s; of a busy machine
IDENTITY = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 1065, 66)  # read of 66 registers, TCP
IDENTITY_SIZE = 9 + 2 * 66
Client = tuple[asyncio.StreamReader, asyncio.StreamWriter]


def tcp_end(rig: Rig, port: int = 0) -> TcpEnd:
    """The amplifier of a rig on a TCP port."""
    device = make_bench(rig)[1]["main"]
    registers = ModbusAmplifiers({1: device}, lambda data: None, is_rtu=False)
    return TcpEnd(device, registers.of_connection, port=port)


@asynccontextmanager
async def client(end: TcpEnd) -> AsyncIterator[Client]:
    """A connection to it."""
    reader, writer = await asyncio.open_connection("127.0.0.1", end.port)
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


async def ask(one: Client, request: bytes, size: int) -> bytes:
    """What a client receives for bytes that it sends."""
    one[1].write(request)
    return await asyncio.wait_for(one[0].readexactly(size), TIMEOUT)


async def test_connections_share_the_registers_of_a_unit(coarse_rig: Rig) -> None:
    """What one client has written, tag 7 to Stop, the other reads: another unit says nothing."""
    async with tcp_end(coarse_rig) as end, client(end) as one, client(end) as other:
        write = struct.pack(">HHHBBHHBHH", 2, 0, 11, 1, 16, 256 * 8, 2, 4, 7, 0)
        assert (await ask(one, write, 12))[6:] == write[6:12]
        look = struct.pack(">HHHBBHH", 3, 0, 6, 1, 3, 256 * 8 + 128, 3)
        elsewhere = struct.pack(">HHHBBHH", 4, 0, 6, 9, 3, 256 * 8 + 128, 3)
        reply = await ask(other, elsewhere + look, 15)
        assert struct.unpack(">HHHBBBHHH", reply) == (3, 0, 9, 1, 3, 6, 7, 0, 5)


async def test_client_that_does_not_read_is_disconnected(coarse_rig: Rig) -> None:
    """Its replies fill no memory, and others are served."""
    async with tcp_end(coarse_rig) as end, client(end) as other:
        loop = asyncio.get_running_loop()
        with socket.socket() as deaf:
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            deaf.setblocking(False)
            await loop.sock_connect(deaf, ("127.0.0.1", end.port))

            async def ask_on() -> None:
                while True:
                    await loop.sock_sendall(deaf, IDENTITY * 50)
                    await asyncio.sleep(0)

            with pytest.raises(OSError, match=r"reset|pipe"):
                await asyncio.wait_for(ask_on(), TIMEOUT)
        assert len(await ask(other, IDENTITY, IDENTITY_SIZE)) == IDENTITY_SIZE
        assert len(end.connections) == 1


async def test_seventeenth_connection_is_closed_at_once(coarse_rig: Rig) -> None:
    """The first ones go on."""
    async with tcp_end(coarse_rig) as end, contextlib.AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(client(end)) for _ in range(17)]
        assert await asyncio.wait_for(clients[16][0].read(), TIMEOUT) == b""
        assert len(await ask(clients[0], IDENTITY, IDENTITY_SIZE)) == IDENTITY_SIZE
        assert len(end.connections) == 16


async def test_port_in_use_is_refused(coarse_rig: Rig) -> None:
    """LinkError with the port and what to do."""
    async with tcp_end(coarse_rig) as end:
        with pytest.raises(LinkError, match=f"port {end.port}: .*choose another"):
            await tcp_end(coarse_rig, end.port).__aenter__()


async def test_frame_of_unknown_function_ends_with_silence(coarse_rig: Rig) -> None:
    """Over RTU its length is not known: exception 1 comes once the line was silent."""
    device, got = make_bench(coarse_rig)[1]["main"], b""
    async with TerminalEnd(device, partial(ModbusAmplifiers, {1: device}, is_rtu=True)) as end:
        fd = os.open(end.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(fd)
        os.write(fd, _with_check(bytes([1, 0x41, 1, 2, 3])))
        async with asyncio.timeout(TIMEOUT):
            while len(got) < 5:
                with contextlib.suppress(BlockingIOError):
                    got += os.read(fd, 5)
                await asyncio.sleep(0.001)
        os.close(fd)
    assert got == _with_check(bytes([1, 0xC1, 1]))


def _with_check(body: bytes) -> bytes:
    """A frame with its CRC-16, bit by bit as the specification of Modbus has it."""
    check = 0xFFFF
    for byte in body:
        check ^= byte
        for _ in range(8):
            check = check >> 1 ^ (0xA001 if check & 1 else 0)
    return body + check.to_bytes(2, "little")


def on_a_line() -> Callable[..., list[Frame]]:
    """An amplifier on a serial line: what comes back for the kind and the bytes of a request."""
    replies, reader = list[Frame](), FrameReader()
    end = SerialAmplifiers(
        {1: SimulatedAmplifier("a", channels=2)}, lambda data: replies.extend(reader.feed(data))
    )

    def ask(kind: int, payload: str, version: int = 4) -> list[Frame]:
        replies.clear()
        end.receive(encode_frame(Frame(kind, 1, 9, bytes.fromhex(payload), version)), 0.0)
        return replies

    return ask


@pytest.mark.parametrize(
    ("kind", "payload", "version", "code"),
    [
        (99, "00", 2, "UNSUPPORTED_VERSION"),  # also unknown, with half a word
        (99, "0000", 4, "UNKNOWN_TYPE"),
        (3, "0000", 4, "BAD_VALUE"),  # session 0, and a word is missing
        (3, "0100 FA00", 4, "BAD_LENGTH"),
        (3, "0100 FA00 0000 0000", 4, "BAD_LENGTH"),
        (6, "0100 0000 0000", 4, "BAD_TOKEN"),  # in the wrong state as well
        (6, "0100 0100 0000", 4, "WRONG_STATE"),  # of another session as well
    ],
)
def test_first_fault_wins_while_disarmed(kind: int, payload: str, version: int, code: str) -> None:
    """Version, type, words, state."""
    (reply,) = on_a_line()(kind, payload, version)
    assert (reply.kind, reply.payload[2]) == (0x9F, REFUSALS[code])


def test_session_wins_over_what_a_request_asks_for() -> None:
    """While armed by session 7: a set of session 8 that is cut short, an Arm of another host."""
    ask = on_a_line()
    ask(3, "0700 FA00 0000")
    for kind, payload, code in (
        (5, "0800 0100 0200 0100", "WRONG_SESSION"),
        (5, "0700 0100 0200 0100", "BAD_LENGTH"),
        (3, "0800 D007 0000", "WRONG_SESSION"),
    ):
        assert ask(kind, payload)[-1].payload[2] == REFUSALS[code]


def test_echo_of_an_event_gets_no_reply() -> None:
    """Of an adapter that hears what it sends: neither Nak nor anything else."""
    assert on_a_line()(30, "00" * 8, 3) == []


SET = (  # session 1234, token 7: layer 0 along 0 ms, channel 0 at 100 Hz and half level
    "201 0200050a34120700",
    "201 0201020001000000",
    "201 020200000000d007",
    "201 0203881300000000",
)
COMMIT = ("200 0000060334120700", "200 0001000000000000")


@pytest.mark.parametrize("lost", range(4))
def test_set_without_one_of_its_frames_is_not_played(lost: int) -> None:
    """No reply, nothing to commit; the repetition under a newer number is."""
    far, sent = SimulatedAmplifier("a", channels=1), list[bytes]()
    end = CanAmplifiers({1: far}, sent.append)

    def put(now: float, *frames: str) -> tuple[list[bytes], float]:
        """Send frames; returns what comes back at once, and what it plays then."""
        sent.clear()
        pairs = ((int(each[:3], 16), bytes.fromhex(each[4:])) for each in frames)
        end.receive(pack_frames(CanFrame(*pair) for pair in pairs), now)
        back = [*sent]
        end.tick(now)
        return back, far.playback.level(0, now)

    end.start(0.0)
    put(0.0, "000 0100", "201 010003033412fa00", "201 0101000000000000")  # starts it, and arms it
    assert put(0.1, *SET[:lost], *SET[lost + 1 :], *COMMIT) == ([], 0.0)
    assert put(0.11, *(f"201 03{each[6:]}" for each in SET), *COMMIT)[1] == 0.5


FRAME = CanFrame(0x181, bytes.fromhex("0102030405060708"))


@pytest.fixture
def bus_of_adapters() -> CanBus:
    """A bus without members."""
    return CanBus()


@pytest.fixture
async def server(bus_of_adapters: CanBus, coarse_rig: Rig) -> AsyncIterator[TcpEnd]:
    """A socketcand server on a free port."""
    device = make_bench(coarse_rig)[1]["main"]
    async with TcpEnd(device, partial(SocketcandClient, bus_of_adapters), faults=Faults()) as end:
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


async def test_socketcand_session(bus_of_adapters: CanBus, talk: Talk) -> None:
    """Greeting, open, raw mode, frames each way, echo; elements in pieces and in a row."""
    heard: list[CanFrame] = []
    bus_of_adapters.join(heard.append)
    await talk.open()
    await talk.ask("< send 123 2 1 F")
    await talk.ask("F >< send 7FF 0 >< echo >", "< echo >")
    assert heard == [CanFrame(0x123, b"\x01\xff"), CanFrame(0x7FF, b"")]
    bus_of_adapters.send(FRAME, sender=heard.append)
    async with asyncio.timeout(TIMEOUT):
        text = (await talk.reader.readuntil(b">")).decode()
    assert text.startswith("< frame 181 ")
    assert text.endswith(" 0102030405060708 >")


@pytest.mark.parametrize(
    "nonsense",
    [
        "< send 123 3 1 2 >",
        "< send 800 0 >",
        "< send 00000123 0 >",
        "< send x 1 1 >",
        "< send 123 9 1 2 3 4 5 6 7 8 9 >",
        "<>",
        ">",
        "a" * 2000,
        "< send 123 1 100 >",
        "\x00\xff< send",
    ],
)
async def test_socketcand_ignores_malformed_frames(
    bus_of_adapters: CanBus, talk: Talk, nonsense: str
) -> None:
    """Whatever is wrong with an element, no frame comes of it, and the next is understood."""
    heard: list[CanFrame] = []
    bus_of_adapters.join(heard.append)
    await talk.open()
    await talk.ask(nonsense + " >")
    async with asyncio.timeout(TIMEOUT):
        talk.writer.write(b"< send 123 1 5 >< echo >")
        assert (await talk.reader.readuntil(b"< echo >")).endswith(b"< echo >")
    assert heard == [CanFrame(0x123, b"\x05")]


async def test_socketcand_refuses_another_bus(talk: Talk) -> None:
    """A client that opens another bus is disconnected."""
    await talk.ask("< open vcan7 >", "< error could not open bus >")
    async with asyncio.timeout(TIMEOUT):
        assert await talk.reader.read() == b""


@pytest.fixture
async def adapter(bus_of_adapters: CanBus, coarse_rig: Rig) -> AsyncIterator[TerminalEnd]:
    """A serial adapter."""
    device = make_bench(coarse_rig)[1]["main"]
    async with TerminalEnd(device, partial(SlcanAdapter, bus_of_adapters), faults=Faults()) as end:
        yield end


async def test_slcan_serves_python_can(bus_of_adapters: CanBus, adapter: TerminalEnd) -> None:
    """Its own interface sets the bit rate, opens the channel, sends and hears."""
    heard: list[CanFrame] = []
    bus_of_adapters.join(heard.append)

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
        await until(lambda: heard)
        assert heard == [FRAME]
        bus_of_adapters.send(FRAME, sender=heard.append)
        received = None
        async with asyncio.timeout(TIMEOUT):
            while received is None:
                received = await asyncio.to_thread(client.recv, 1.0)
        assert (received.arbitration_id, bytes(received.data)) == (FRAME.id, FRAME.data)
    finally:
        await asyncio.to_thread(client.shutdown)


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
    bus_of_adapters: CanBus, text: bytes, written: bytes, sent: list[CanFrame]
) -> None:
    """CR for what was done, BELL for what makes no sense, z and Z for frames that were sent."""
    answered, heard = list[bytes](), list[CanFrame]()
    bus_of_adapters.join(heard.append)
    adapter = SlcanAdapter(bus_of_adapters, answered.append)
    adapter.receive(text, 0.0)
    adapter.close()
    assert (b"".join(answered), heard) == (written, sent)
