"""Far ends of protocol 4 on real ports, asked with bytes written by hand."""

import asyncio
import contextlib
import os
import socket
import struct
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial

import pytest

from drivers.errors import LinkError
from drivers.protocol.definition import REFUSALS
from drivers.wires.serial_frames import Frame, FrameReader, encode_frame
from model.rig.rig import Rig
from real_wires import make_bench
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.far_end import FarEnd, TcpEnd, TerminalEnd

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
        self.amplifier = Amplifier("a", channels=2)
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
