"""The firmware, built by the compiler of this machine: its programs, and in this process.

In this process it has a clock that its caller moves, so that nothing takes real time. Random
requests of a host are sets in parts, commits, silence, stops and nonsense.
"""

import ctypes
import random
import struct
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cobs import cobs

from drivers.protocol.definition import (
    BY_NUMBER,
    EVENT,
    EVENT_RECORD,
    NAK,
    NAK_RECORD,
    VERSION,
)
from drivers.protocol.records import Record, Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, token_after
from drivers.wires.can_frames import SLCAN, TextReader, pack_frames, unpack_frames
from drivers.wires.serial_frames import Frame, FrameReader, encode_frame, pack_words, unpack_words
from kit import hand_frames as hand
from model.arrays import FloatArray
from registry import threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

FIRMWARE = Path(__file__).parents[2] / "firmware"


def build_firmware(folder: Path, program: str, *options: str) -> Path:
    """Build one of its programs into a folder, with options of make; return the folder.

    Not optimized: compiling takes longer than all that tests play.
    """
    goal = folder / program
    command = ["make", "-s", "-C", FIRMWARE, f"OUT={folder}", "CFLAGS=-O0", *options, goal]
    subprocess.run(command, check=True)
    return folder


@contextmanager
def running_firmware(folder: Path, *options: str) -> Iterator[tuple[str, int]]:
    """Run the amplifier with an option for its line; yield the URL of that line, and its process.

    The process is given by its number.
    """
    with subprocess.Popen(
        [folder / "era-firmware", "--until-eof", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield process.stdout.readline().strip(), process.pid
        process.stdin.close()


NONSENSE = [*range(2, 14), *range(19, 40)]  # others depend on what is there besides
MOMENTS = 128
"""Steps of the clock's high word in which whole numbers of samples pass, at 16 kHz."""
FREQUENCIES = (2000, 2600, 2605, 5000)  # 0.05 Hz


def knots(draw: random.Random) -> Envelope:
    """An envelope whose steps are whole samples."""
    count = draw.choice([0, 1, 2, 5])
    phases = (draw.randint(-18000, 17999) for _ in range(count))
    return Envelope(
        10 * draw.randint(1, 4), tuple((draw.randint(0, 2000), phase) for phase in phases)
    )


def command(draw: random.Random, channel: int) -> Command:
    """A command that is seldom out of range."""
    shapes = (knots(draw) if draw.random() < 0.3 else None for _ in range(2))
    frequency = draw.choice(FREQUENCIES) if draw.random() < 0.98 else 100
    level = draw.choice([0, 500, 1000, 2000]) if draw.random() < 0.98 else 10000
    flags = draw.random() < 0.5, draw.random() < 0.2
    return Command(channel, frequency, level, draw.randint(-18000, 17999), *flags, *shapes)


def layer(draw: random.Random, number: int, channels: int) -> LayerSet:
    """A layer: commands, silence or a renewal."""
    numbers = [channel for channel in range(channels) if draw.random() < 2 / channels]
    if draw.random() < 0.02:
        numbers.append(15)
    commands = tuple(command(draw, channel) for channel in dict.fromkeys(numbers))
    ramp, valid_for = draw.choice([0, 1, 5, 40]), draw.choice([0, 0, 0, 10, 20, 90])
    is_after = bool(commands) and draw.random() < 0.3
    is_renewal = not commands and draw.random() < 0.5
    return LayerSet(number, ramp, valid_for, commands, is_after, is_renewal)


class RandomHost:
    """A host that plays, stops, repeats and errs; draw: of everything."""

    def __init__(self, draw: random.Random, capabilities: Values) -> None:
        self._draw = draw
        self._channels, self._layers = (capabilities[name] for name in ("channels", "layers"))
        self._token = 1
        self._session = 1

    def requests(self, latch: int, clock: int) -> Iterator[tuple[int, list[int]]]:
        """Yield number and words of the next requests; latch, clock: those of the amplifier."""
        draw, kind = self._draw, self._draw.random()
        if kind < 0.55:
            yield from self._set(clock >> 16)
        elif kind < 0.8:
            yield 12, [self._session if draw.random() < 0.9 else 99, 0]
            yield 13, [draw.randint(0, 8)]
        elif kind < 0.9:
            yield draw.choice([2, 9, 10, 13]), [draw.randint(0, 3)] * draw.randint(0, 1)
        elif kind < 0.94:
            yield 7, [self._session, draw.choice([0, 3, 30])]
        elif kind < 0.97:
            yield draw.choice([4, 8]), [draw.choice([0, 2, 30])]
        else:
            length = draw.randint(0, 5)
            yield draw.choice(NONSENSE), [draw.choice([0, 1, 2, 300, 65535]) for _ in range(length)]
        if draw.random() < 0.2:
            yield 11, [latch if draw.random() < 0.8 else 7]
            yield 3, [self._session, 150, MOMENTS * draw.randint(0, 511)]
        if draw.random() < 0.1:
            self._session += 1

    def _set(self, high: int) -> Iterator[tuple[int, list[int]]]:
        draw = self._draw
        if draw.random() < 0.9:
            self._token = token_after(self._token)
        numbers = draw.sample(range(self._layers), draw.choice([1, 1, 2, 4]))
        if draw.random() < 0.02:
            numbers.append(self._layers)
        stream = pack_layers(layer(draw, number, self._channels) for number in numbers)
        parts: list[list[int]] = []
        while stream or not parts:
            length = draw.randint(1, 117)
            parts.append(stream[:length])
            stream = stream[length:]
        is_now = draw.random() < 0.4
        last = len(parts) - 1
        early_parts = [number for number in range(last) if draw.random() < 0.97]
        if draw.random() < 0.3:
            draw.shuffle(early_parts)
        for index in [
            *early_parts,
            *draw.choices(range(last + 1), k=draw.choice([0, 0, 0, 2])),
            last,
        ]:
            bits = index << 8 | len(parts) << 1 | is_now
            yield 5, [self._session, self._token, bits, *parts[index]]
        if not is_now:
            ahead = MOMENTS * draw.randint(1, 11) - high % MOMENTS
            at = high + draw.choice([0, 0, -300, 2000, ahead if ahead > 2 else 0])
            yield 6, [self._session, self._token, at % 65536]
            yield 9, []


RATE = 16000
"""Samples per second and channel."""

SERIAL, MODBUS, CAN, TCP = range(4)
"""Its lines; TCP: Modbus over TCP, whose replies come from MODBUS."""
LINES = {"serial": SERIAL, "rtu": MODBUS, "tcp": TCP, "can": CAN}
"""The kinds of wires, with the line of each."""

_FULL = 32767  # of a sample
_RING = 8192  # bytes
_SAMPLES = 1 << 21


class MovedFirmware:
    """The library `era-moved.so` in a folder: one amplifier, whose clock begins at 0.

    channels: with which it was built. buffered: samples that it makes ahead.
    """

    def __init__(self, folder: Path, *, channels: int = 4, buffered: int = 0) -> None:
        self._library = ctypes.CDLL(str(folder / "era-moved.so"))
        self._library.moved_to.argtypes = [ctypes.c_uint64]
        self._library.moved_stall.argtypes = [ctypes.c_uint64, ctypes.c_bool]
        self._library.moved_now.restype = ctypes.c_uint64
        self._sent = ctypes.create_string_buffer(_RING)
        self._made = np.empty(_SAMPLES, np.int16)
        self._channels = channels
        self._library.moved_begin(buffered)

    def move(self, time: float) -> None:
        """Move its clock to a time [s]."""
        self._library.moved_to(round(time * 1e6))

    def stall(self, time: float, *, is_converter_still: bool) -> None:
        """Let its loop stand still until a time [s], and its converter take nothing meanwhile."""
        self._library.moved_stall(round(time * 1e6), is_converter_still)

    def load(self, sample_time: float) -> None:
        """Let making a sample take a time [s] from now on."""
        self._library.moved_load(round(sample_time * 1e6))

    @property
    def time(self) -> float:
        """Its clock [s], which advances by itself under load."""
        return float(self._library.moved_now() / 1e6)

    def receive(self, line: int, data: bytes) -> None:
        """Take bytes that arrive on a line now."""
        if line == TCP:
            self._library.moved_receive_tcp(data, len(data))
        else:
            self._library.moved_receive(line, data, len(data))

    def sent(self, line: int) -> bytes:
        """Return what it has sent on a line since the last call."""
        length = self._library.moved_sent(MODBUS if line == TCP else line, self._sent)
        return self._sent.raw[:length]

    def samples(self) -> FloatArray:
        """Return the samples since the last call, (n, channels) in full levels."""
        pointer = self._made.ctypes.data_as(ctypes.c_void_p)
        length = self._library.moved_samples(pointer)
        return self._made[:length].reshape(-1, self._channels) / _FULL

    def set_interlock(self, *, is_open: bool) -> None:
        """Open or close its interlock."""
        self._library.moved_interlock(is_open)


class FirmwareEnd:
    """Firmware at address 1, the far end of a kind of wire; folder: its library.

    buffered: samples that it makes ahead.
    """

    def __init__(
        self, kind: str, folder: Path, send: Callable[[bytes], None], *, buffered: int = 0
    ) -> None:
        self._firmware = MovedFirmware(folder, buffered=buffered)
        self._began = threads.now()
        self._line, self._send = LINES[kind], send
        self._reader = TextReader(SLCAN)
        self._firmware.receive(CAN, b"O\r")
        self._firmware.sent(CAN)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        if self._line == CAN:
            data = b"".join(map(SLCAN.encode, unpack_frames(data)))
        self._firmware.move(now - self._began)
        self._firmware.receive(self._line, data)
        self.tick(now)

    def tick(self, now: float) -> None:
        """Move its clock, and send what it has to say."""
        self._firmware.move(now - self._began)
        data = self._firmware.sent(self._line)
        if self._line == CAN:
            data = pack_frames(self._reader.feed(data))
        if data:
            self._send(data)


class Sent(NamedTuple):
    """What an amplifier sends: number of the message, what else its frame says, its words."""

    number: int
    frame: tuple[int, ...]
    words: tuple[int, ...]

    def values(self) -> Values:
        """Return the values of its record."""
        records: Mapping[int, Record] = {NAK: NAK_RECORD, EVENT: EVENT_RECORD}
        record = records.get(self.number) or BY_NUMBER[self.number].reply
        return record.unpack(self.words, is_strict=False)


class Pair:
    """Firmware and simulated amplifier on a serial line, at one time [s] that the caller moves."""

    def __init__(self, firmware: MovedFirmware, amplifier: SimulatedAmplifier) -> None:
        self.firmware, self.amplifier = firmware, amplifier
        self.time = 0.0
        self._requests = 0
        self._out: list[bytes] = []
        self._far = SerialAmplifiers({1: amplifier}, self._out.append)

    @property
    def moment(self) -> float:
        """The time, a little later with each request, so that what is due then has happened."""
        return self.time + 1e-10 * self._requests

    def ask(self, number: int, words: Sequence[int]) -> tuple[list[Sent], list[Sent]]:
        """Return what each sends upon a request with a message's number."""
        data = encode_frame(Frame(number, 1, self._requests % 65536, pack_words(words), VERSION))
        self._requests += 1
        self.firmware.move(self.time)
        self.firmware.receive(SERIAL, data)
        self.amplifier.tick(self.moment)
        self._far.receive(data, self.moment)
        sent, expected = self.firmware.sent(SERIAL), b"".join(self._out)
        self._out.clear()
        return _of_frames(sent), _of_frames(expected)


def _of_frames(data: bytes) -> list[Sent]:
    return [
        Sent(
            frame.type,
            (frame.is_reply, frame.version, frame.sequence),
            unpack_words(frame.payload),
        )
        for frame in FrameReader().feed(data)
    ]


PER_MS = RATE // 1000
SESSION = 9

Script = Sequence[tuple[float, bytes]]
"""Requests by time [ms]."""


def request(kind: int, *words: int) -> bytes:
    """A request to address 1; kind: the number of its message."""
    return hand.frame(kind, words, sequence=7)


def arm(watchdog_ms: int = 2000) -> bytes:
    """An Arm of the session."""
    return request(hand.ARM, SESSION, watchdog_ms, 0)


def apply(token: int, *commands: Sequence[int], ramp_ms: int = 0) -> bytes:
    """A set of layer 0 that plays at once."""
    layer = hand.layer(0, *commands, ramp=ramp_ms)
    return request(hand.SET, *hand.part(token, layer, session=SESSION, now=True))


def values_of(firmware: MovedFirmware, number: int) -> Values:
    """The values of its reply on the serial line, behind a zero that ends what was begun there."""
    firmware.sent(SERIAL)
    firmware.receive(SERIAL, b"\0" + request(number))
    frame = cobs.decode(firmware.sent(SERIAL).split(b"\0")[-2])
    assert frame[0] == hand.REPLY | number
    words = struct.unpack(f"<{len(frame[5:-4]) // 2}H", frame[5:-4])
    return BY_NUMBER[number].reply.unpack(words, is_strict=True)


def replay(
    folder: Path, script: Script, until_ms: float
) -> tuple[FloatArray, list[tuple[int, tuple[int, ...]]]]:
    """The samples of a script, and type and words of each reply; events are left out."""
    firmware = MovedFirmware(folder)
    sent = b""
    for at, frame in script:
        firmware.move(at / 1000)
        firmware.receive(SERIAL, frame)
        sent += firmware.sent(SERIAL)
    firmware.move(until_ms / 1000)
    frames = [cobs.decode(part) for part in (sent + firmware.sent(SERIAL)).split(b"\0") if part]
    replies = [
        (frame[0], struct.unpack(f"<{len(frame[5:-4]) // 2}H", frame[5:-4]))
        for frame in frames
        if frame[0] & hand.REPLY
    ]
    return firmware.samples(), replies
