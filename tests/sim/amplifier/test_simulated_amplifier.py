"""The simulated amplifier of protocol 4 against the protocol page, its clock, and its far ends.

2^32 steps of the clock in 20 s are 214 748 364.8 a second; a step of the high word is 20 s / 65536
= 305.18 us. Far ends are on real ports: CAN, its adapters, and Modbus with masters of others. Bytes
are written by hand, frames as identifier and data in hexadecimal digits, and some are lost;
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
from typing import Any

import can
import pytest

from drivers.errors import LinkError
from drivers.protocol.definition import FAULTS, STATES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_frames import Frame, FrameReader, encode_frame
from kit.wires import make_bench, until
from model.rig.rig import Rig
from sim.amplifier.amplifier_clock import AmplifierClock, Crystal
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.far_ends.simulated_bus import CanBus, SlcanAdapter, SocketcandClient
from sim.faults import Faults
from sim.transport.far_end import FarEnd
from sim.transport.serving import TcpEnd, TerminalEnd

PER_SECOND = 214_748_364.8


def test_crystal_and_rate_multiply() -> None:
    """At +40 ppm the clock gains 40 us in a second; a rate of -400 words leaves 1.6 ns of them."""
    clock = AmplifierClock(Crystal(error=40e-6), since=100.0)
    assert clock.seconds(101.0) - 101.0 == pytest.approx(40e-6, abs=1e-10)
    clock.steer(-400, 101.0)
    # (1 + 4e-5) (1 - 4e-5) = 1 - 1.6e-9
    assert clock.seconds(111.0) - 111.0 == pytest.approx(40e-6 - 16e-9, abs=1e-10)
    assert clock.reading(111.0) == round((11.0 + 40e-6 - 16e-9) * PER_SECOND) % (1 << 32)


def test_shift_moves_the_high_word_on() -> None:
    """A shift of 3 moves the clock on by 3 steps of its high word, over its end too."""
    clock = AmplifierClock()
    clock.shift(3)
    assert clock.reading(0.0) == 0x0003_0000
    clock.shift(65_534)
    assert clock.reading(0.0) == 0x0001_0000


SESSION = 7


class Requests:
    """An amplifier of two channels, the requests that it handles and the events that it sends."""

    def __init__(self, *, is_armed: bool = True) -> None:
        self.amplifier = SimulatedAmplifier("a", channels=2)
        self.events: list[tuple[str, int]] = []
        """The state and latch of each event once it is armed."""
        self.event_times: list[float] = []
        """When each event was sent [s]."""
        if is_armed:
            self.arm(0.0)
        self.amplifier.listeners.append(self._note)

    def _note(self, event: Values, time: float) -> None:
        self.events.append((state_name(event), event["latch"]))
        self.event_times.append(time)

    def ask(self, time: float, name: str, **values: Any) -> Values:
        """Return the reply to a request at a time [s]."""
        return self.amplifier.handle(name, values, time)

    def arm(self, time: float, session: int = SESSION, watchdog: int = 250, shift: int = 0) -> str:
        """Arm; return the state."""
        reply = self.ask(time, "Arm", session=session, watchdog=watchdog, shift=shift)
        return state_name(reply)

    def ping(self, time: float, rate: int = 0) -> Values:
        """Feed the watchdog and set the rate of the clock."""
        return self.ask(time, "Ping", session=SESSION, rate=rate)

    def status(self, time: float) -> Values:
        """Return the status."""
        return self.ask(time, "GetStatus")

    def play(
        self, time: float, token: int, *tones: tuple[int, int], layer: int = 0, now: bool = True
    ) -> Values:
        """Send a set of one layer with channels and levels [1e-4] of tones of 100 Hz."""
        commands = tuple(Command(channel, 2000, level, 0) for channel, level in tones)
        return self.send(time, token, LayerSet(layer, 0, 0, commands), now=now)

    def send(self, time: float, token: int, layer_set: LayerSet, *, now: bool = True) -> Values:
        """Send a set of one layer in one part; return the status that replies."""
        (part,) = parts(pack_layers((layer_set,)), session=SESSION, token=token, now=now)
        return self.amplifier.handle("Set", part, time)


def state_name(values: Values) -> str:
    """Return the name of the state in a status or an event."""
    return next(name for name, code in STATES.items() if code == values["state"])


def test_heat_derates_and_then_trips() -> None:
    """Above 70 degrees C half of every level, reported as inexact; above 85 a fault until cool."""
    requests = Requests()
    requests.play(0.0, 1, (0, 5000))
    requests.amplifier.set_temperature(71.0, 0.1)
    assert requests.status(0.13)["levels"] == [2500, 0]
    assert requests.play(0.13, 2, (1, 8000), layer=1)["exact"] == 0
    assert requests.status(0.14)["levels"] == [2500, 4000]

    requests.amplifier.set_temperature(86.0, 0.2)
    assert requests.status(0.21)["fault"] == FAULTS["OVER_TEMPERATURE"]
    assert state_name(requests.ask(0.22, "Clear", latch=1)) == "FAULT"
    requests.amplifier.set_temperature(60.0, 0.3)
    assert state_name(requests.ask(0.31, "Clear", latch=1)) == "SWITCH_ON_DISABLED"


def test_set_that_waits_for_an_onset_is_derated_too() -> None:
    """It was sent at 0.2 s, the heat came at 0.25 s, and the onset ends at 0.4 s: half of 8000."""
    requests = Requests(is_armed=False)
    requests.arm(0.0, watchdog=2000)
    onset = Envelope(1000, ((2000, 0),) * 2)  # three steps of 0.1 s
    beginning = LayerSet(0, 20, 0, (Command(0, 2000, 2000, 0, onset=onset),))
    following = LayerSet(0, 20, 0, (Command(0, 2000, 8000, 0),), after=True)
    requests.send(0.1, 1, beginning)
    requests.send(0.2, 2, following)

    requests.amplifier.set_temperature(75.0, 0.25)

    assert requests.status(0.9)["levels"] == [4000, 0]


@pytest.mark.parametrize(
    ("temperature", "state", "level"),
    [(69.0, "OPERATION_ENABLED", 5000), (84.0, "OPERATION_ENABLED", 2500), (120.0, "FAULT", 0)],
)
def test_hot_amplifier_derates_or_trips_when_it_is_armed(
    temperature: float, state: str, level: int
) -> None:
    """It obeys the thresholds of 70 and 85 degrees C before it cools, and not on the way down."""
    requests = Requests()
    requests.amplifier.set_temperature(temperature, 0.1)
    requests.amplifier.restart(0.2)

    requests.ask(0.3, "Arm", session=SESSION, watchdog=1000, shift=0)
    if state == "OPERATION_ENABLED":
        requests.play(0.4, 1, (0, 5000))

    status = requests.status(0.6)
    assert state_name(status) == state
    assert status["levels"] == [level, 0]


def test_open_interlock_trips_and_prevents_arming() -> None:
    """It is neither cleared nor armed until the interlock is closed."""
    requests = Requests()
    requests.amplifier.set_interlock(moment=0.1, is_open=True)
    requests.amplifier.tick(0.2)
    assert requests.events == [("FAULT_REACTION_ACTIVE", 1), ("FAULT", 1)]
    assert state_name(requests.ask(0.2, "Clear", latch=1)) == "FAULT"

    requests.amplifier.set_interlock(moment=0.3, is_open=False)
    requests.ask(0.3, "Clear", latch=1)
    assert requests.arm(0.3, session=8) == "OPERATION_ENABLED"


def test_high_voltage_is_on_while_armed_and_then_discharges() -> None:
    """1800 V: 1273 V rms at full level, and 2 pi f/2 C U = 400 uA in a capacitor of 1 nF.

    20 ms after disarming 1800/e V are left. An amplifier that was never armed has none.
    """
    requests = Requests()
    requests.play(0.0, 1, (0, 10000))
    first_channel = requests.ask(0.01, "GetMeasured")["channels"][0]
    assert first_channel["channel_voltage"] == pytest.approx(12727.9, abs=1)
    assert first_channel["channel_current"] == pytest.approx(399.9, abs=1)

    requests.ask(0.1, "Disarm", ramp=0)
    assert requests.status(0.12)["high_voltage"] == 662
    assert Requests(is_armed=False).ask(0.0, "Stop", ramp=5)["high_voltage"] == 0


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


async def ask(connection: Client, request: bytes, size: int) -> bytes:
    """Return the bytes that a client receives for a request."""
    reader, writer = connection
    writer.write(request)
    return await asyncio.wait_for(reader.readexactly(size), TIMEOUT)


async def test_client_that_does_not_read_is_disconnected(coarse_rig: Rig) -> None:
    """Its replies fill no memory, and other clients are served."""
    async with tcp_end(coarse_rig) as end, client(end) as well_behaved:
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
        assert len(await ask(well_behaved, IDENTITY, IDENTITY_SIZE)) == IDENTITY_SIZE
        assert len(end.connections) == 1


async def test_seventeenth_connection_is_closed_immediately(coarse_rig: Rig) -> None:
    """The first connections continue."""
    async with tcp_end(coarse_rig) as end, contextlib.AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(client(end)) for _ in range(17)]
        assert await asyncio.wait_for(clients[16][0].read(), TIMEOUT) == b""
        assert len(await ask(clients[0], IDENTITY, IDENTITY_SIZE)) == IDENTITY_SIZE
        assert len(end.connections) == 16


async def test_port_in_use_is_refused(coarse_rig: Rig) -> None:
    """The error names the port and the remedy."""
    async with tcp_end(coarse_rig) as end:
        with pytest.raises(LinkError, match=f"port {end.port}: .*choose another"):
            await tcp_end(coarse_rig, end.port).__aenter__()


async def test_frame_of_unknown_function_ends_with_silence(coarse_rig: Rig) -> None:
    """On RTU its length is unknown: exception 1 is sent after a silence of the line."""
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
    """Return a function that sends a request on a serial line and returns the replies."""
    replies, reader = list[Frame](), FrameReader()
    end = SerialAmplifiers(
        {1: SimulatedAmplifier("a", channels=2)}, lambda data: replies.extend(reader.feed(data))
    )

    def ask(kind: int, payload: str, version: int = 4) -> list[Frame]:
        replies.clear()
        end.receive(encode_frame(Frame(kind, 1, 9, bytes.fromhex(payload), version)), 0.0)
        return replies

    return ask


def test_echo_of_an_event_gets_no_reply() -> None:
    """An adapter may hear its own frames; the amplifier ignores them."""
    assert on_a_line()(30, "00" * 8, 3) == []


SET = (  # session 1234, token 7: layer 0 along 0 ms, channel 0 at 100 Hz and half level
    "201 0200050a34120700",
    "201 0201020001000000",
    "201 020200000000d007",
    "201 0203881300000000",
)
COMMIT = ("200 0000060334120700", "200 0001000000000000")


class CanNode:
    """An amplifier of one channel on CAN, armed by session 1234."""

    def __init__(self) -> None:
        self.amplifier = SimulatedAmplifier("a", channels=1)
        self.replies: list[bytes] = []
        self.end = CanAmplifiers({1: self.amplifier}, self.replies.append)
        self.end.start(0.0)
        self.send(0.0, "000 0100", "201 010003033412fa00", "201 0101000000000000")
        self.replies.clear()

    def send(self, time: float, *frames: str) -> None:
        """Send frames, each an identifier and data in hexadecimal digits."""
        packed = []
        for frame in frames:
            identifier, data = frame.split()
            packed.append(CanFrame(int(identifier, 16), bytes.fromhex(data)))
        self.end.receive(pack_frames(packed), time)

    def level(self, time: float) -> float:
        """Return the level that it plays."""
        self.end.tick(time)
        return self.amplifier.playback.level(0, time)


@pytest.mark.parametrize("lost", range(4))
def test_set_without_one_of_its_frames_is_not_played(lost: int) -> None:
    """No reply, and nothing to commit; the repetition under a newer number plays."""
    node = CanNode()
    node.send(0.1, *SET[:lost], *SET[lost + 1 :], *COMMIT)
    assert node.replies == []
    assert node.level(0.1) == 0.0

    repeated = [frame.replace("201 02", "201 03", 1) for frame in SET]
    node.send(0.11, *repeated, *COMMIT)

    assert node.level(0.11) == 0.5


FRAME = CanFrame(0x181, bytes.fromhex("0102030405060708"))


def on_bus(
    adapter: Callable[..., FarEnd], *texts: str
) -> tuple[CanBus, list[bytes], list[CanFrame]]:
    """Write texts to an adapter; return its bus, its replies and the frames on the bus."""
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


async def test_slcan_serves_python_can(coarse_rig: Rig) -> None:
    """python-can's interface sets the bit rate, opens the channel, sends and receives."""
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
    """CR confirms a command, BELL rejects one, and z and Z confirm frames."""
    _, answered, heard = on_bus(SlcanAdapter, text)
    assert (b"".join(answered), heard) == (written.encode(), sent)
