"""Damaged frames for every codec: whatever comes in, no exception, no hang, nothing beyond limits.

    python tests/support/mutation.py [COUNT]        a million per codec unless told otherwise

A codec is one entry: good telegrams to begin with, and what takes damaged ones apart. Half of the
damaged ones get a right checksum again, so that what lies behind the checksum is reached as well.
"""

import random
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from drivers.codec.serial_line.exchanges import decode_reply, decode_request, encode_request
from drivers.codec.serial_line.frame import Frame, FrameReader, encode_frame
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import FrameError
from drivers.guard import Guard, GuardLimits
from drivers.protocol.messages import (
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Feature,
    GetBlock,
    GetReading,
    GetSensors,
    GetStatus,
    Hello,
    LoadEnvelope,
    Measure,
    Ping,
    Request,
    Stage,
    Stop,
)
from fake_device import SESSION

WIDE = Capabilities(
    *(16, 20.0, 600.0, 0.05, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 63, 0.001, 0.1),
    features=Feature.WHOLE,
)


def sample_requests() -> list[Request]:
    """Requests of every kind that carries something."""
    guard = Guard(GuardLimits(20.0, 600.0, 1.0), WIDE)
    shape = guard.check_envelope(Envelope(5, 0.005, (Knot(0.1, 90.0), Knot(1.0, -90.0))))
    commands = (
        DriveCommand(0, 110.0, 0.2, onset=5),
        DriveCommand(3, 250.5, 1.0, -90.0, keep_phase=True),
        *(DriveCommand(channel, 40.0 * channel, 0.1) for channel in range(4, 10)),
    )
    wanted = guard.check(CommandSet(513, commands, ramp=0.02, valid_for=0.5))
    return [
        *(Hello(), GetStatus(), Ping(SESSION), Arm(0.25, SESSION), Stop(0.005)),
        *(Commit(513, SESSION), Stage(wanted, SESSION), Apply(wanted, SESSION)),
        *(Clear(1), LoadEnvelope(shape), GetSensors(1), GetReading(1), GetBlock(1, 70_000)),
        Measure(1234, 0.2, (110.0, 250.5)),
    ]


@dataclass(frozen=True)
class Codec:
    """telegrams: good ones; take: takes any bytes and returns what they ask for, where they do.

    mend: puts a right checksum onto damaged bytes.
    """

    telegrams: Sequence[bytes]
    take: Callable[[bytes], Sequence[object]]
    mend: Callable[[bytes], bytes]


def _serial() -> Codec:
    frames = [
        encode_request(request, address=1, sequence=number)
        for number, request in enumerate(sample_requests())
    ]
    reader = FrameReader()

    def take(data: bytes) -> list[object]:
        asked: list[object] = []
        for frame in reader.feed(data):
            for decode in (decode_request, lambda frame: decode_reply(frame, frames[0])):
                try:
                    asked.append(decode(frame))
                except FrameError:
                    continue
        return asked

    def mend(data: bytes) -> bytes:
        kind, version, address, payload = data[0], data[1], data[2], data[5:]
        return encode_frame(Frame(kind, address, 7, payload[:240], version))

    bodies = [bytes([one.kind, one.version, one.address, 7, 0]) + one.payload for one in frames]
    return Codec(
        telegrams=bodies,
        take=take,
        mend=mend,
    )


def _modbus(*, is_rtu: bool) -> Codec:
    from modbus_fuzz import ModbusEnds

    ends = ModbusEnds(sample_requests(), is_rtu=is_rtu)
    return Codec(ends.telegrams, ends.take, ends.mend)


def _can() -> Codec:
    from can_fuzz import CanEnds

    ends = CanEnds(sample_requests())
    return Codec(ends.telegrams, ends.take, ends.mend)


def _can_text() -> Codec:
    from can_fuzz import CanTexts

    texts = CanTexts()
    return Codec(texts.telegrams, texts.take, texts.mend)


CODECS: Mapping[str, Callable[[], Codec]] = {
    "serial": _serial,
    "modbus rtu": lambda: _modbus(is_rtu=True),
    "modbus tcp": lambda: _modbus(is_rtu=False),
    "can": _can,
    "can as text": _can_text,
}


def damage(data: bytes, chance: random.Random) -> bytes:
    """One to four bytes changed, inserted, removed, or a piece repeated; never empty."""
    damaged = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(damaged))
        match chance.randrange(5):
            case 0:
                damaged[at] ^= 1 << chance.randrange(8)
            case 1:
                damaged[at] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
            case 2:
                damaged.insert(at, chance.randrange(256))
            case 3 if len(damaged) > 8:
                del damaged[at : at + chance.randint(1, 4)]
            case _:
                damaged[at:at] = damaged[at : at + 10]
    return bytes(damaged).ljust(5, b"\0")


def is_within_limits(asked: object) -> bool:
    """Whether every number of what was asked for is one that the protocol allows."""
    match asked:
        case Apply(command_set=one) | Stage(command_set=one):
            channels = [command.channel for command in one.commands]
            return (
                1 <= one.token <= 65535
                and 0 <= one.ramp <= 1
                and 0 <= one.valid_for <= 60
                and len(set(channels)) == len(channels)
                and all(
                    0 <= command.channel <= 15
                    and 0 <= command.frequency <= 3276.75
                    and 0 <= command.level <= 1
                    and -180 <= command.phase < 180
                    for command in one.commands
                )
            )
        case LoadEnvelope(envelope=envelope):
            return len(envelope.knots) <= 32 and all(
                0 <= knot.level <= 1 and -180 <= knot.phase < 180 for knot in envelope.knots
            )
        case Arm(watchdog=watchdog):
            return 0.1 <= watchdog <= 2
        case Stop(ramp=ramp):
            return 0 <= ramp <= 1
        case Measure(window=window, frequencies=frequencies):
            return 0.001 <= window <= 10 and 1 <= len(frequencies) <= 16
        case GetSensors(first=first) | GetReading(first=first) | GetBlock(sensor=first):
            return 0 <= first <= 31
        case _:
            return True


def attack(codec: Codec, count: int, *, seed: int) -> int:
    """Feed so many damaged telegrams; returns how many were understood all the same.

    Raises AssertionError for a command beyond limits, and whatever the codec raises.
    """
    chance = random.Random(seed)
    understood = 0
    for number in range(count):
        damaged = damage(chance.choice(codec.telegrams), chance)
        for asked in codec.take(codec.mend(damaged) if number % 2 else damaged):
            understood += 1
            assert is_within_limits(asked), asked
    return understood


def main() -> None:
    """A million for every codec."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    for name, make in CODECS.items():
        begin = time.perf_counter()
        understood = attack(make(), count, seed=20)
        seconds = time.perf_counter() - begin
        sys.stdout.write(f"{name}: {count} in {seconds:.0f} s, {understood} understood\n")


if __name__ == "__main__":
    main()
