"""The firmware and the simulated amplifier of protocol 3 on one wire, asked the same."""

import random
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from drivers.codec.can_bus.adapter_text import SLCAN, TextReader
from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.segments import REPLY, REQUEST, pack_frames, segments, unpack_frames
from drivers.codec.serial_line.frame import (
    Frame,
    FrameReader,
    encode_frame,
    pack_words,
    unpack_words,
)
from drivers.protocol.records import Record, Values
from drivers.protocol.table import BY_NUMBER, EVENT, EVENT_RECORD, NAK, NAK_RECORD, VERSION
from moved_firmware import CAN, SERIAL, TCP, MovedFirmware
from sim.amplifier.contract import Amplifier
from sim.far_ends.can_bus.amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers

WIRES: Mapping[str, int] = {"serial": SERIAL, "tcp": TCP, "can": CAN}
"""The wires, with the firmware's line of each."""

_EMERGENCY = 0x81
_MBAP = 7  # bytes


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
    """Firmware and simulated amplifier on a wire, at one time [s] that the caller moves."""

    def __init__(self, firmware: MovedFirmware, amplifier: Amplifier, wire: str) -> None:
        self.firmware, self.amplifier, self.wire = firmware, amplifier, wire
        self.time = 0.0
        self._requests = 0
        self._line = WIRES[wire]
        self._out: list[bytes] = []
        peers = {1: amplifier}
        self._far: SerialAmplifiers | ModbusAmplifiers | CanAmplifiers
        if wire == "serial":
            self._far = SerialAmplifiers(peers, self._out.append)
        elif wire == "tcp":
            self._far = ModbusAmplifiers(peers, self._out.append, is_rtu=False)
        else:
            self._far = CanAmplifiers(peers, self._out.append)
            firmware.receive(CAN, b"O\r")
            self._exchange(pack_frames([CanFrame(0, bytes([1, 0]))]))  # operational

    @property
    def moment(self) -> float:
        """The time, a little later with each request, so that what is due then has happened."""
        return self.time + 1e-9 * self._requests

    def follow(self) -> tuple[list[Sent], list[Sent]]:
        """Let both reach the time; returns what each sends."""
        return self._exchange(b"")

    def ask(self, number: int, words: Sequence[int]) -> tuple[list[Sent], list[Sent]]:
        """Return what each sends upon a request with a message's number."""
        if self.wire == "serial":
            sequence = self._requests % 65536
            return self._exchange(
                encode_frame(Frame(number, 1, sequence, pack_words(words), VERSION))
            )
        if self.wire == "can":
            data = [
                CanFrame(REQUEST + 1, each)
                for each in segments(self._requests % 255 + 1, number, words)
            ]
            random.Random(self._requests).shuffle(data)
            return self._exchange(pack_frames(data))
        row = b"".join(word.to_bytes(2, "big") for word in (self._requests, *words))
        head = bytes([16, number, 0, 0, len(row) // 2, len(row)])
        written = self._exchange(self._adu(head + row))
        read = self._exchange(self._adu(bytes([3, number, 128, 0, 122])))
        return written[0] + read[0], written[1] + read[1]

    def _adu(self, pdu: bytes) -> bytes:
        return bytes([0, self._requests % 256, 0, 0, 0, len(pdu) + 1, 1]) + pdu

    def _exchange(self, data: bytes) -> tuple[list[Sent], list[Sent]]:
        self._requests += 1
        self.firmware.move(self.time)
        pieces = [data]
        if self.wire == "can":
            pieces = [SLCAN.encode(frame) for frame in unpack_frames(data)]
        for piece in pieces:
            self.firmware.receive(self._line, piece)
        self.amplifier.tick(self.moment)
        self._far.receive(data, self.moment)
        made, expected = self.firmware.sent(self._line), b"".join(self._out)
        self._out.clear()
        if self.wire == "serial":
            return [*_of_frames(made)], [*_of_frames(expected)]
        if self.wire == "tcp":
            return [*_of_areas(made)], [*_of_areas(expected)]
        return [*_of_can(TextReader(SLCAN).feed(made))], [*_of_can(unpack_frames(expected))]


def _of_frames(data: bytes) -> Iterator[Sent]:
    for frame in FrameReader().feed(data):
        head = (frame.is_reply, frame.version, frame.sequence)
        yield Sent(frame.type, head, unpack_words(frame.payload))


def _of_areas(data: bytes) -> Iterator[Sent]:
    """Responses to writes, and areas of replies: a refusal as a Nak."""
    while data:
        size = _MBAP - 1 + int.from_bytes(data[4:6], "big")
        pdu, data = data[_MBAP:size], data[size:]
        if pdu[0] != 3:
            yield Sent(NAK, (), (*pdu, 0, 0, 0))
            continue
        tag, result, *words = (
            int.from_bytes(pdu[at : at + 2], "big") for at in range(2, len(pdu), 2)
        )
        if result:
            yield Sent(NAK, (tag,), (0, result >> 8, result & 255))
        else:
            yield Sent(0, (tag,), tuple(words))


def _of_can(frames: Iterator[CanFrame] | Sequence[CanFrame]) -> Iterator[Sent]:
    """Messages, whose frames come in order, and emergencies."""
    number, count, words = 0, 0, list[int]()
    for frame in frames:
        if frame.id == _EMERGENCY:
            yield Sent(NAK, (frame.id,), (*frame.data,))
        if frame.id != REPLY + 1:
            continue
        if frame.data[1] == 0:
            number, count, words = frame.data[2], frame.data[3], []
        start = 4 if frame.data[1] == 0 else 2
        words += [frame.data[at] | frame.data[at + 1] << 8 for at in range(start, 8, 2)]
        if len(words) >= count:
            yield Sent(number, (frame.data[0],), tuple(words[:count]))
