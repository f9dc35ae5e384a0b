"""Durations of Modbus RTU frames."""

from dataclasses import dataclass
from typing import final

from drivers.codec.modbus.blocks import CHANNEL_SIZE, HEAD
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.wire_times import WireTimes

_MAP = PROTOCOL.modbus
_SET_HEAD = HEAD + len(_MAP["holding"]["set"]["registers"])
_ACHIEVED_HEAD = HEAD + len(_MAP["input"]["achieved"]["registers"])
_ENVELOPE_HEAD = HEAD + len(_MAP["holding"]["envelope"]["registers"])
_KNOT = 2  # registers: level, phase
_COMMIT = HEAD + 2  # registers; the token and the session
_READ_WRITE = 13  # bytes of an FC23 request without registers
_READ = 5  # bytes of its response without registers
_GAP = 3.5  # characters of silence between two frames
_SHORTEST_GAP = 0.00175  # s; by the standard above 19200 baud


@final
@dataclass(frozen=True)
class ModbusTimes(WireTimes):
    """Durations on an RTU line at a speed [baud], with a number of bits per byte."""

    baud: int
    bits_per_byte: int = 11

    @property
    def silence(self) -> float:
        """Silence [s] between two frames."""
        return max(_GAP * self.bits_per_byte / self.baud, _SHORTEST_GAP)

    def of(self, size: int) -> float:
        """Duration of a number of bytes."""
        return size * self.bits_per_byte / self.baud

    def round_trip(self, channels: int) -> float:
        """See `WireTimes`; one FC23 transaction with the achieved set, with silences."""
        request = _READ_WRITE + 2 * (_SET_HEAD + channels * CHANNEL_SIZE)
        answer = _READ + 2 * (_ACHIEVED_HEAD + channels * CHANNEL_SIZE)
        return self.of(request + answer) + 2 * self.silence

    def commit(self) -> float:
        """See `WireTimes`; with the silence that ends it."""
        return self.of(_READ_WRITE + 2 * _COMMIT) + self.silence

    def loading(self, knots: int) -> float:
        """See `WireTimes`; with silences."""
        request = _READ_WRITE + 2 * (_ENVELOPE_HEAD + _KNOT * knots)
        answer = _READ + 2 * _ENVELOPE_HEAD
        return self.of(request + answer) + 2 * self.silence
