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
from contextlib import asynccontextmanager, closing
from functools import partial

import can
import pytest

from drivers.errors import LinkError
from drivers.protocol.definition import REFUSALS
from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from drivers.wires.serial_frames import Frame, FrameReader, encode_frame
from model.rig.rig import Rig
from real_wires import MASTERS, drive, make_bench
from registry import threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import CanAmplifiers, CanBus, SlcanAdapter, SocketcandClient
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.faults import Faults
from sim.transport.far_end import FarEnd, TcpEnd, TerminalEnd, make_terminal


@asynccontextmanager
async def served(line: str) -> AsyncIterator[str]:
    """An amplifier of four channels as unit 1 on a pseudo-terminal or a TCP port; its URL."""
    amplifiers = {1: SimulatedAmplifier("a", channels=4)}

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        end = ModbusAmplifiers(amplifiers, writer.write, is_rtu=False)
        while data := await reader.read(4096):
            end.receive(data, threads.now())
        writer.close()

    if line == "tcp":
        async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            yield f"modbus+tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}/1"
        return
    terminal = make_terminal(lambda data: end.receive(data, threads.now()))
    end = ModbusAmplifiers(amplifiers, terminal.write, is_rtu=True)
    with closing(terminal):
        terminal.listen()
        yield f"modbus+rtu://{terminal.port}#1"


@pytest.mark.parametrize("name", MASTERS)
async def test_foreign_master_drives_it(name: str) -> None:
    """Reads by both functions, writes, a set, and an exception, over a real line."""
    line, make = MASTERS[name]
    async with served(line) as url:
        assert await asyncio.to_thread(drive, make, url) == "era-haptics"


TIMEOUT = 60.0  # s; of a busy machine
IDENTITY = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 1065, 66)  # read of 66 registers, TCP
IDENTITY_SIZE = 9 + 2 * 66
HELLO = encode_frame(Frame(kind=1, address=1, sequence=1, payload=b"", version=0))

Client = tuple[asyncio.StreamReader, asyncio.StreamWriter]


def tcp_end(rig: Rig, port: int = 0) -> TcpEnd:
    """The amplifier of a rig on a TCP port."""
    device = make_bench(rig)[1]["main"]
    registers = ModbusAmplifiers({1: device}, lambda data: None, is_rtu=False)
    return TcpEnd(device, registers.of_connection, port=port)


def terminal_end(rig: Rig, make_end: Callable[..., FarEnd]) -> TerminalEnd:
    """The amplifier of a rig on a pseudo-terminal."""
    device = make_bench(rig)[1]["main"]
    return TerminalEnd(device, partial(make_end, {1: device}))


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


async def read(fd: int, size: int) -> bytes:
    """So many bytes of a terminal."""
    data = b""
    async with asyncio.timeout(TIMEOUT):
        while len(data) < size:
            with contextlib.suppress(BlockingIOError):
                data += os.read(fd, size - len(data))
            await asyncio.sleep(0.001)
    return data


def opened(port: str) -> int:
    """The host's side of a terminal, raw."""
    fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(fd)
    return fd


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
    async with terminal_end(coarse_rig, partial(ModbusAmplifiers, is_rtu=True)) as end:
        fd = opened(end.port)
        os.write(fd, _with_check(bytes([1, 0x41, 1, 2, 3])))
        assert await read(fd, 5) == _with_check(bytes([1, 0xC1, 1]))
        os.close(fd)


def _with_check(body: bytes) -> bytes:
    """A frame with its CRC-16, bit by bit as the specification of Modbus has it."""
    check = 0xFFFF
    for byte in body:
        check ^= byte
        for _ in range(8):
            check = check >> 1 ^ (0xA001 if check & 1 else 0)
    return body + check.to_bytes(2, "little")


NAK = 0x9F


class OnALine:
    """An amplifier on a serial line; state by the word of its status."""

    def __init__(self) -> None:
        self.amplifier = SimulatedAmplifier("a", channels=2)
        self.replies: list[Frame] = []
        reader = FrameReader()
        self.end = SerialAmplifiers(
            {1: self.amplifier}, lambda data: self.replies.extend(reader.feed(data))
        )

    def ask(self, kind: int, payload: str, *, version: int = 4) -> Frame:
        """The reply to a request with these bytes, in hexadecimal."""
        self.replies.clear()
        self.end.receive(encode_frame(Frame(kind, 1, 9, bytes.fromhex(payload), version)), 0.0)
        return self.replies[-1]


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
    reply = OnALine().ask(kind, payload, version=version)
    assert (reply.kind, reply.payload[2]) == (NAK, REFUSALS[code])


def test_session_wins_over_what_a_request_asks_for() -> None:
    """While armed by session 7: a set of session 8 that is cut short, an Arm of another host."""
    line = OnALine()
    line.ask(3, "0700 FA00 0000")
    assert line.ask(5, "0800 0100 0200 0100").payload[2] == REFUSALS["WRONG_SESSION"]
    assert line.ask(5, "0700 0100 0200 0100").payload[2] == REFUSALS["BAD_LENGTH"]
    assert line.ask(3, "0800 D007 0000").payload[2] == REFUSALS["WRONG_SESSION"]


def test_echo_of_an_event_gets_no_reply() -> None:
    """Of an adapter that hears what it sends: neither Nak nor anything else."""
    line = OnALine()
    line.end.receive(encode_frame(Frame(30, 1, 9, bytes(8), 3)), 0.0)
    assert line.replies == []


START = (0x000, "0100")
ARM = ((0x201, "010003033412fa00"), (0x201, "0101000000000000"))  # session 1234, 250 ms
SET = (  # session 1234, token 7: layer 0 along 0 ms, channel 0 at 100 Hz and half level
    (0x201, "0200050a34120700"),
    (0x201, "0201020001000000"),
    (0x201, "020200000000d007"),
    (0x201, "0203881300000000"),
)
COMMIT = ((0x200, "0000060334120700"), (0x200, "0001000000000000"))


class Bus:
    """Amplifiers of one channel from node 1 on, and the frames that they have sent."""

    def __init__(self, *names: str) -> None:
        self.far = [SimulatedAmplifier(name, channels=1) for name in names]
        self.sent: list[tuple[int, str]] = []
        self.end = CanAmplifiers(dict(enumerate(self.far, 1)), self._note)
        self.end.start(0.0)

    def _note(self, data: bytes) -> None:
        self.sent.extend((frame.id, frame.data.hex()) for frame in unpack_frames(data))

    def put(self, now: float, *frames: tuple[int, str]) -> list[tuple[int, str]]:
        """Send frames at a time [s]; returns what comes back at once."""
        self.sent.clear()
        self.end.receive(pack_frames(CanFrame(i, bytes.fromhex(data)) for i, data in frames), now)
        return [*self.sent]

    def level(self, at: float, of: int = 0) -> float:
        """What an amplifier plays."""
        self.end.tick(at)
        return self.far[of].playback.level(0, at)


@pytest.fixture
def bus() -> Bus:
    """One amplifier, operational."""
    bus = Bus("a")
    bus.put(0.0, START)
    return bus


@pytest.mark.parametrize("lost", range(4))
def test_set_without_one_of_its_frames_is_not_played(bus: Bus, lost: int) -> None:
    """No reply, nothing to commit; the repetition under a newer number is."""
    bus.put(0.0, *ARM)
    kept = [*SET[:lost], *SET[lost + 1 :]]
    assert bus.put(0.1, *kept, *COMMIT) == []
    assert bus.level(0.1) == 0.0
    bus.put(0.11, *((can_id, f"03{data[2:]}") for can_id, data in SET), *COMMIT)
    assert bus.level(0.11) == 0.5


FRAME = CanFrame(0x181, bytes.fromhex("0102030405060708"))


class Member:
    """A member of the bus, with the frames `heard`."""

    def __init__(self, bus_of_adapters: CanBus) -> None:
        self.heard: list[CanFrame] = []
        self._bus = bus_of_adapters
        self._listener = self.heard.append
        bus_of_adapters.join(self._listener)

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
    member = Member(bus_of_adapters)
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
    member = Member(bus_of_adapters)
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
async def adapter(bus_of_adapters: CanBus, coarse_rig: Rig) -> AsyncIterator[TerminalEnd]:
    """A serial adapter."""
    device = make_bench(coarse_rig)[1]["main"]
    async with TerminalEnd(device, partial(SlcanAdapter, bus_of_adapters), faults=Faults()) as end:
        yield end


async def test_slcan_serves_python_can(bus_of_adapters: CanBus, adapter: TerminalEnd) -> None:
    """Its own interface sets the bit rate, opens the channel, sends and hears."""
    member = Member(bus_of_adapters)

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
    bus_of_adapters: CanBus, text: bytes, written: bytes, sent: list[CanFrame]
) -> None:
    """CR for what was done, BELL for what makes no sense, z and Z for frames that were sent."""
    assert answers(bus_of_adapters, text) == (written, sent)
