"""Far ends of protocol 4 on real ports: CAN, its adapters, and Modbus with masters of others.

Bytes are written by hand, frames as identifier and data in hexadecimal digits, and some are lost;
adapters are compared with the interfaces of python-can.
"""

import asyncio
import contextlib
import os
import re
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
from sim.transport.far_end import FarEnd, TcpEnd, TerminalEnd


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


def on_bus(
    adapter: Callable[..., FarEnd], *texts: str
) -> tuple[CanBus, list[bytes], list[CanFrame]]:
    """Write texts to an adapter: its bus, what it has written, and what goes onto the bus."""
    bus, written, heard = CanBus(), list[bytes](), list[CanFrame]()
    bus.join(heard.append)
    end = adapter(bus, written.append)
    for text in texts:
        end.receive(text.encode("latin-1"), 0.0)
    return bus, written, heard


def test_socketcand_session() -> None:
    """Greeting, open, raw mode, frames each way, echo; elements in pieces and in a row.

    A client that opens another bus is disconnected.
    """
    texts = "< open can0 >< rawmode >< send 123 2 1 F", "F >< send 7FF 0 >< echo >"
    bus, written, heard = on_bus(SocketcandClient, *texts)
    assert written == [b"< hi >", b"< ok >", b"< ok >", b"< echo >"]
    assert heard == [CanFrame(0x123, b"\x01\xff"), CanFrame(0x7FF, b"")]
    bus.send(FRAME, sender=heard.append)
    assert re.fullmatch(rb"< frame 181 [\d.]+ 0102030405060708 >", written[-1])
    _, refused, _ = on_bus(SocketcandClient, "< open vcan7 >")
    assert refused == [b"< hi >", b"< error could not open bus >", b""]  # which ends it


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
def test_socketcand_ignores_malformed_frames(nonsense: str) -> None:
    """Whatever is wrong with an element, no frame comes of it, and the next is understood."""
    opened = "< open can0 >< rawmode >"
    _, written, heard = on_bus(
        SocketcandClient, f"{opened}{nonsense} >", "< send 123 1 5 >< echo >"
    )
    assert written[-1] == b"< echo >"
    assert heard == [CanFrame(0x123, b"\x05")]


async def test_slcan_serves_python_can(coarse_rig: Rig) -> None:
    """Its own interface sets the bit rate, opens the channel, sends and hears."""
    bus, heard, device = CanBus(), list[CanFrame](), make_bench(coarse_rig)[1]["main"]
    bus.join(heard.append)
    async with TerminalEnd(device, partial(SlcanAdapter, bus), faults=Faults()) as end:
        how = {"bitrate": 500_000, "sleep_after_open": 0, "ignore_config": True}
        client = await asyncio.to_thread(can.Bus, end.port, "slcan", **how)
        try:
            sent = can.Message(arbitration_id=FRAME.id, data=FRAME.data, is_extended_id=False)
            await asyncio.to_thread(client.send, sent)
            await until(lambda: heard)
            assert heard == [FRAME]
            bus.send(FRAME, sender=heard.append)
            received = await asyncio.to_thread(client.recv, TIMEOUT)
            assert (received.arbitration_id, bytes(received.data)) == (FRAME.id, FRAME.data)
        finally:
            await asyncio.to_thread(client.shutdown)


@pytest.mark.parametrize(
    ("text", "written", "sent"),
    [
        ("C\rS6\rO\rt1232AABB\rC\r", "\r\r\rz\r\r", [CanFrame(0x123, b"\xaa\xbb")]),
        ("t1230\r", "\x07", []),  # closed
        ("S6\rL\rt1230\r", "\r\r\x07", []),  # listening only
        ("O\rS6\r", "\r\x07", []),  # the bit rate of an open channel
        ("O\rt1233AABB\rt12391\rq\rt8000\r", "\r\x07\x07\x07\x07", []),
        ("O\rT000001230\rr1230\r", "\rZ\rz\r", []),  # no receiver has such identifiers
        ("V\rN\r", "V1013\rNE0A1\r", []),
        ("O\r" + "x" * 500, "\r\x07", []),
    ],
)
def test_slcan_replies_like_lawicel(text: str, written: str, sent: list[CanFrame]) -> None:
    """CR for what was done, BELL for what makes no sense, z and Z for frames that were sent."""
    _, answered, heard = on_bus(SlcanAdapter, text)
    assert (b"".join(answered), heard) == (written.encode(), sent)
