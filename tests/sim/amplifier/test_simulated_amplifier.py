"""The simulated amplifier of protocol 4 against the protocol page, its clock, and its far ends.

2^32 steps of the clock in 20 s are 214 748 364.8 a second; a step of the high word is 20 s / 65536
= 305.18 us. Far ends are on real ports: CAN, its adapters, and Modbus with masters of others. Bytes
are written by hand, frames as identifier and data in hexadecimal digits, and some are lost;
adapters are compared with the interfaces of python-can.
"""

import asyncio
import contextlib
import math
import os
import re
import socket
import struct
import tty
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.errors import LinkError
from drivers.protocol.definition import FAULTS, REFUSALS, STATES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_frames import Frame, FrameReader, encode_frame
from kit.courses import Step, Taken, courses, fits, follow
from kit.plates import make_paper_rig
from kit.wires import MASTERS, drive, far_side, make_bench, on_amplifiers, until
from model.rig.rig import Rig
from sim.amplifier.amplifier_clock import AmplifierClock, Crystal
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.bench import Bench
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.far_ends.simulated_bus import CanBus, SlcanAdapter, SocketcandClient
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import Faults
from sim.transport.far_end import FarEnd
from sim.transport.serving import TcpEnd, TerminalEnd

PER_SECOND = 214_748_364.8


def test_clock_goes_round_in_20_s() -> None:
    """A clock without errors shows a quarter of its span after 5 s, and again after 25.

    So a high word of 0x4000 comes at 5 s, behind the end of a turn at 25 s, and at 5 s at once.
    """
    clock = AmplifierClock()
    assert [clock.reading(time) for time in (0.0, 5.0, 20.0, 25.0)] == [0, 1 << 30, 0, 1 << 30]
    assert clock.seconds(25.0) == 25.0
    moments = [clock.reaches(0x4000, time) for time in (0.0, 6.0, 5.0)]
    assert moments == pytest.approx([5.0, 25.0, 5.0], abs=1e-11)


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


def test_clock_starts_again_with_its_supply() -> None:
    """After a restart the clock shows 0 and runs as fast as its crystal, which stays warm."""
    clock = AmplifierClock(Crystal(error=20e-6, warm_up=1e-6, ahead=7.0))
    assert clock.reading(0.0) == round(7 * PER_SECOND)
    clock.steer(1000, 1.0)
    clock.restart(500.0)
    assert clock.reading(500.0) == clock.rate == 0
    assert clock.seconds(501.0) == pytest.approx(1 + 30e-6, abs=1e-9)


@pytest.mark.parametrize("rate", [0, 500, -32768])
def test_moment_of_a_high_word(rate: int) -> None:
    """The clock has a high word from its moment on, and the one before just until then."""
    clock = AmplifierClock(Crystal(error=-50e-6, warm_up=1e-6, ahead=3.3), since=1e5)
    clock.steer(rate, 1e5 + 2)
    now = 1e5 + 2.5
    high = ((clock.reading(now) >> 16) + 1638) % 65536
    moment = clock.reaches(high, now)
    assert clock.reading(moment) >> 16 == high
    assert clock.reading(moment - 10e-9) >> 16 == high - 1
    # 1637 to 1638 steps of 20 s / 65536, by a clock that is at most 3.4 per mille fast or slow.
    assert 1637 * 20 / 65536 * 0.996 < moment - now < 1638 * 20 / 65536 * 1.004


ARM = {"session": 7, "watchdog": 250, "shift": 0}


def armed() -> SimulatedAmplifier:
    """An amplifier armed by session 7 at time 0, watchdog 0.25 s."""
    amplifier = SimulatedAmplifier("a", channels=2)
    amplifier.handle("Arm", ARM, 0.0)
    return amplifier


def tone(channel: int = 0, frequency: int = 2000, level: int = 5000, **other: object) -> Command:
    """A tone of 100 Hz at half level unless told otherwise."""
    return Command(channel, frequency, level, 0, **other)  # type: ignore[arg-type]


def part_of(token: int, *layers: LayerSet, now: bool = True) -> Values:
    """The only part of a set of session 7."""
    (part,) = parts(pack_layers(layers), session=7, token=token, now=now)
    return part


def levels(amplifier: SimulatedAmplifier, at: float) -> list[int]:
    """Levels of the status at a time, in 1e-4."""
    return list(amplifier.handle("GetStatus", {}, at)["levels"])


@dataclass(kw_only=True)
class Handled(Taken):
    """An amplifier that handles requests; reply: the last one, at a time [s].

    handle: of the name of an amplifier, for several; events: the name of the state, the latch and
    the time of each.
    """

    amplifier: SimulatedAmplifier
    handle: Callable[[str, str, Values, float], Values]
    reply: Values = field(default_factory=dict)
    at: float = 0.0
    events: list[tuple[str, int, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Note all events."""
        self.amplifier.listeners.append(
            lambda event, at: self.events.append((_named("state", event), event["latch"], at))
        )

    @property
    def ahead(self) -> int:
        """By how much the clock of the last reply is ahead of one without errors [2^-32 turns]."""
        return int(self.reply["clock"]) - round(self.at * PER_SECOND)

    def asks(self, name: str, at: float, of: str = "", **values: Any) -> None:
        """Handle a request at a time."""
        self.at, self.reply = at, self.handle(of, name, values, at)

    def plays(
        self, token: int, at: float, tone: Sequence[int], layer: int = 0, valid_for: int = 0
    ) -> None:
        """Handle a set that plays a tone at once: channel, frequency and level."""
        one = LayerSet(layer, 0, valid_for, (Command(*tone, 0),))
        self.reply = self.handle("", "Set", part_of(token, one), at)

    def renews(self, token: int, at: float, valid_for: int) -> None:
        """Handle a set that renews the first layer."""
        self.handle("", "Set", part_of(token, LayerSet(0, 0, valid_for, renew=True)), at)

    async def is_refused(self, code: str, step: Step) -> None:
        """Require that a step is refused with a code."""
        with pytest.raises(Refusal) as caught:
            await self.take(step)
        assert caught.value.code == code

    def replies(self, **expected: Any) -> None:
        """Require values of the last reply, states and faults by name."""
        found = {what: _named(what, self.reply) for what in expected}
        assert fits(found, expected), found


def _named(what: str, values: Values) -> Any:
    """A value, a state or fault by its name."""
    names = {"state": STATES, "fault": FAULTS}.get(what, {})
    return next((name for name, code in names.items() if code == values[what]), values[what])


@asynccontextmanager
async def handled(*names: str, is_armed: bool = True) -> AsyncIterator[Handled]:
    """An amplifier of two channels, armed by session 7 at time 0 with a watchdog of 0.25 s.

    names: those of amplifiers at the paper's plate instead.
    """
    if not names:
        one = armed() if is_armed else SimulatedAmplifier("a", channels=2)
        yield Handled(amplifier=one, handle=lambda _, *request: one.handle(*request))
        return
    bench = Bench(on_amplifiers(make_paper_rig(12, 9), names), now=0.0)
    yield Handled(
        amplifier=bench.amplifiers[names[0]],
        handle=lambda of, name, values, at: bench.exchange(of or names[0], name, values, now=at),
    )


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_amplifier_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], handled)


def test_temperature_follows_the_mean_square_level() -> None:
    """Half level on both channels: a quarter of 30 K, 1 - 1/e of it after 120 s."""
    amplifier = SimulatedAmplifier("a", channels=2)
    amplifier.handle("Arm", {"session": 7, "watchdog": 2000, "shift": 0}, 0.0)
    amplifier.handle("Set", part_of(1, LayerSet(0, 0, 0, (tone(0), tone(1)))), 0.0)
    for second in range(1, 121):
        status = amplifier.handle("Ping", {"session": 7, "rate": 0}, float(second))
    assert status["temperature"] == pytest.approx(250 + 75 * (1 - 1 / math.e), abs=1)


def play_from(
    amplifier: SimulatedAmplifier, token: int, level: int, at: float, moment: int
) -> None:
    """Stage a set of channel 0 at a time [s], and commit it for a high word of the clock."""
    one = LayerSet(0, 0, 0, (tone(level=level),))
    amplifier.handle("Set", part_of(token, one, now=False), at)
    amplifier.handle("Commit", {"session": 7, "token": token, "at": moment % 65536}, at)


@pytest.mark.parametrize(
    ("moment", "waits"), [(99, False), (100, False), (101, True), (1738, True), (1739, False)]
)
def test_moments_beyond_half_a_second_are_now(moment: int, waits: bool) -> None:
    """The present high word, one that has passed, or one more than 1638 steps ahead: at once."""
    amplifier, at = armed(), 100.5 * 20 / 65536
    play_from(amplifier, 1, 5000, at, moment)
    assert (levels(amplifier, at) == [0, 0]) is waits


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
