"""The firmware in this process, on a clock that its caller moves: nothing of it takes real time."""

import ctypes
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cobs import cobs

import hand_written as hand
from drivers.protocol.definition import BY_NUMBER, EVENT, EVENT_RECORD, NAK, NAK_RECORD, VERSION
from drivers.protocol.records import Record, Values
from drivers.wires.can_frames import SLCAN, TextReader, pack_frames, unpack_frames
from drivers.wires.serial_frames import (
    Frame,
    FrameReader,
    encode_frame,
    pack_words,
    unpack_words,
)
from model.arrays import FloatArray
from registry import threads
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

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
    """Firmware at address 1, the far end of a kind of wire; folder: its library."""

    def __init__(self, kind: str, folder: Path, send: Callable[[bytes], None]) -> None:
        self._firmware = MovedFirmware(folder)
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

    def __init__(self, firmware: MovedFirmware, amplifier: Amplifier) -> None:
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
        made, expected = self.firmware.sent(SERIAL), b"".join(self._out)
        self._out.clear()
        return _of_frames(made), _of_frames(expected)


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
