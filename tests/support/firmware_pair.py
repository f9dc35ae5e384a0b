"""The firmware and the simulated amplifier of protocol 3 on a serial line, asked the same."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from drivers.codec.serial_line.frame import (
    Frame,
    FrameReader,
    encode_frame,
    pack_words,
    unpack_words,
)
from drivers.protocol.records import Record, Values
from drivers.protocol.table import BY_NUMBER, EVENT, EVENT_RECORD, NAK, NAK_RECORD, VERSION
from moved_firmware import SERIAL, MovedFirmware
from sim.amplifier.contract import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers


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
        return self.time + 1e-9 * self._requests

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
