"""Mutated frames for both ends of Modbus: `python tests/support/modbus_fuzz.py 1000000`."""

import random
import struct
import sys
import time
from collections.abc import Iterator, Sequence

from drivers.backends.modbus_frames import AnswerReader, make_telegram
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import FrameError
from drivers.guard import Guard, GuardLimits
from drivers.protocol import modbus_map
from drivers.protocol.messages import (
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    LoadEnvelope,
    Ping,
    Request,
    Stage,
    State,
    Stop,
)
from drivers.statistics import WireCounters
from sim.amplifier import SimulatedAmplifier
from sim.modbus_frames import PAUSE, Reader, RtuReader, TcpReader, crc, rtu_frame, tcp_frame
from sim.modbus_frames import Request as Asked
from sim.modbus_unit import ModbusUnit
from sim.shaped_tone import ShapedTone

BATCH = 500  # frames, from one set of good ones
REVIVAL = 10  # frames, after which it is armed again, for most of what comes stops or disarms it
EPOCH = 100.0  # s; any


class Station:
    """A simulated amplifier whose clock stands where it is put."""

    is_answering = True

    def __init__(self) -> None:
        self.amplifier = SimulatedAmplifier("main", channels=4)
        self.now = EPOCH

    def exchange(self, request: Request) -> object:
        """Its answer."""
        return self.amplifier.handle(request, self.now)

    broadcast = exchange

    def is_within_limits(self) -> bool:
        """Whether nothing plays that it could not be asked for, and nothing unless it is armed."""
        can = self.amplifier.capabilities
        for output in self.amplifier.outputs:
            for tone in output:
                if not can.frequency_min <= tone.frequency <= can.frequency_max:
                    return False
                if not isinstance(tone, ShapedTone) and not 0 <= tone.level <= can.level_max:
                    return False
        levels = self.amplifier.status(self.now).levels
        if not all(0 <= level <= can.level_max + 1e-9 for level in levels):
            return False
        return self.amplifier.state is State.OPERATION_ENABLED or not any(
            tone.silent_from > self.now + can.ramp_max
            for output in self.amplifier.outputs
            for tone in output
        )


def requests(numbers: random.Random) -> list[Request]:
    """One of every kind, with numbers of any size within the limits."""
    amplifier = SimulatedAmplifier("main", channels=4)
    guard = Guard(GuardLimits(10.0, 600.0, 1.0), amplifier.capabilities)
    shape = guard.check_envelope(
        Envelope(
            1, 0.005, tuple(Knot(numbers.random(), 90.0) for _ in range(numbers.randrange(32)))
        )
    )
    commands = tuple(
        DriveCommand(channel, numbers.uniform(20, 600), numbers.random() / 4, 0.0)
        for channel in range(4)
    )
    token = numbers.randrange(1, 65536)
    safe = guard.check(CommandSet(token, commands, ramp=0.1, valid_for=1.0))
    return [
        *(Hello(), GetCaps(), GetStatus(), GetFaults(), Ping(), Clear(), Arm(0.5), Arm(2.0)),
        *(Stage(safe), Apply(safe), Commit(token), LoadEnvelope(shape), Stop(0.1), Disarm(0.1)),
    ]


def frames(numbers: random.Random, *, is_rtu: bool) -> list[bytes]:
    """A good frame of each request."""
    made = []
    for tag, request in enumerate(requests(numbers), start=1):
        exchange = modbus_map.to_exchange(request, tag=tag, channels=4)
        telegram = make_telegram(
            exchange.read, exchange.write, unit=1, transaction=tag, is_rtu=is_rtu
        )
        made.append(telegram.frame)
    return made


def mutated(numbers: random.Random, frame: bytes, others: Sequence[bytes]) -> bytes:
    """A frame with something done to it; sometimes nothing."""
    data = bytearray(frame)
    match numbers.randrange(9):
        case 0:
            for _ in range(numbers.randint(1, 4)):
                data[numbers.randrange(len(data))] ^= 1 << numbers.randrange(8)
        case 1:
            del data[numbers.randrange(len(data)) :]
        case 2:
            at = numbers.randrange(len(data))
            data[at:at] = numbers.randbytes(numbers.randint(1, 8))
        case 3:
            at = numbers.randrange(len(data))
            del data[at : at + numbers.randint(1, 6)]
        case 4:
            data += numbers.choice(others)[numbers.randrange(4) :]
        case 5:
            data = bytearray(numbers.randbytes(numbers.randint(1, 300)))
        case 6:
            at = numbers.randrange(len(data))
            data[at : at + 2] = numbers.choice((b"\xff\xff", b"\x00\x00", b"\x7f\xff", b"\x80\x00"))
        case 7:
            data = data * 2
        case _:
            pass
    return bytes(data)


def mended(numbers: random.Random, data: bytes, *, is_rtu: bool) -> bytes:
    """Mostly with a CRC or a header that fits, so that what is mutated gets further."""
    if len(data) < 9 or numbers.random() < 0.2:
        return data
    if is_rtu:
        return data[:-2] + struct.pack("<H", crc(data[:-2]))
    return data[:2] + struct.pack(">HHB", 0, min(len(data) - 6, 254), 1) + data[7:]


def without_check(numbers: random.Random, data: bytes, *, is_rtu: bool) -> bytes:
    """Often without the check of its block, where a block with one is written by function 23."""
    begin = 1 if is_rtu else 7
    if len(data) > begin + 15 and data[begin] == 23 and numbers.random() < 0.7:
        changed = bytearray(data)
        changed[begin + 12 : begin + 14] = b"\0\0"
        return bytes(changed)
    return data


def pieces(numbers: random.Random, data: bytes) -> Iterator[bytes]:
    """In one piece, or in some."""
    while data:
        size = numbers.choice((len(data), len(data), numbers.randint(1, len(data))))
        yield data[:size]
        data = data[size:]


def attack_far_end(count: int, *, is_rtu: bool, seed: int) -> tuple[int, int, int]:
    """So many mutated frames to the amplifier; how many were understood, dropped, and played.

    AssertionError where something plays beyond its limits; any other exception is a mistake too.
    """
    numbers = random.Random(seed)
    station = Station()
    unit = ModbusUnit(station)
    reader: Reader = RtuReader() if is_rtu else TcpReader()
    played = 0
    token = 0
    for number in range(count):
        if number % BATCH == 0:
            good = frames(numbers, is_rtu=is_rtu)
        if number % REVIVAL == 0:
            for request in (Clear(), Arm(2.0)):
                station.exchange(request)
        data = mutated(numbers, numbers.choice(good), good)
        data = without_check(numbers, data, is_rtu=is_rtu)
        data = mended(numbers, data, is_rtu=is_rtu)
        for piece in pieces(numbers, data):
            for request in reader.feed(piece, station.now):
                if request.unit == 0:
                    unit.hear(request.pdu)
                else:
                    answer(unit, request, is_rtu=is_rtu)
        station.now += numbers.choice((0.0, 0.0, 0.001, 0.02, 2 * PAUSE))
        station.amplifier.tick(station.now)
        assert station.is_within_limits(), data.hex(" ")
        now = station.amplifier.status(station.now).token
        played += now not in (0, token)
        token = now
    return reader.counters.good, reader.counters.bad, played


def answer(unit: ModbusUnit, request: Asked, *, is_rtu: bool) -> None:
    """The far end's answer must be one that a frame can hold."""
    pdu = unit.answer(request.pdu)
    if pdu is not None:
        assert 2 <= len(pdu) <= 253
        assert pdu[0] & 0x7F == request.pdu[0] & 0x7F
        frame = rtu_frame(request.unit, pdu) if is_rtu else tcp_frame(request, pdu)
        assert len(frame) <= 260


def attack_host(count: int, *, is_rtu: bool, seed: int) -> tuple[int, int]:
    """So many mutated answers to the host; how many became a message, and how many none.

    What it takes is a message with every value in range, or FrameError says why it is none.
    """
    numbers = random.Random(seed)
    station = Station()
    unit = ModbusUnit(station)
    counters = WireCounters()
    reader = AnswerReader(is_rtu=is_rtu, counters=counters)
    taken = none = 0
    for number in range(count):
        if number % BATCH == 0:
            asked = requests(numbers)
        tag = numbers.randrange(1, 65536)
        request = numbers.choice(asked)
        exchange = modbus_map.to_exchange(request, tag=tag, channels=4)
        transaction = 0 if is_rtu else tag
        telegram = make_telegram(
            exchange.read, exchange.write, unit=1, transaction=transaction, is_rtu=is_rtu
        )
        pdu = unit.answer(telegram.frame[1:-2] if is_rtu else telegram.frame[7:])
        assert pdu is not None
        own = rtu_frame(1, pdu) if is_rtu else tcp_frame(Asked(1, b"", tag), pdu)
        data = mended(numbers, mutated(numbers, own, [own]), is_rtu=is_rtu)
        answers = [one for part in pieces(numbers, data) for one in reader.feed(part, telegram)]
        reader.clear()
        for one in answers:
            if one.exception or not modbus_map.is_of(one.registers, tag=tag):
                none += 1
                continue
            try:
                modbus_map.to_reply(request, one.registers)
                modbus_map.condition(request, one.registers)
                modbus_map.faults_beyond(request, one.registers)
                taken += 1
            except FrameError:
                none += 1
    return taken, none


def main() -> None:
    """So many frames at each end of each wire."""
    count = int(sys.argv[1])
    for is_rtu in (True, False):
        wire = "RTU" if is_rtu else "TCP"
        begin = time.perf_counter()
        good, bad, played = attack_far_end(count, is_rtu=is_rtu, seed=count)
        middle = time.perf_counter()
        taken, none = attack_host(count, is_rtu=is_rtu, seed=count)
        end = time.perf_counter()
        sys.stdout.write(
            f"Modbus {wire} far end: {count} mutated frames in {middle - begin:.0f} s; "
            f"{good} understood, {bad} dropped, {played} sets played, none beyond limits\n"
            f"Modbus {wire} host: {count} mutated answers in {end - middle:.0f} s; "
            f"{taken} taken, {none} none\n"
        )


if __name__ == "__main__":
    main()
