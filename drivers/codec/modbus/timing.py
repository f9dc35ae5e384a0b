"""What Modbus RTU frames cost in time, by arithmetic."""

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
_COMMIT = HEAD + 1  # registers, the last for the token
_READ_WRITE = 13  # bytes of an FC23 request without its registers
_READ = 5  # bytes of its answer without its registers
_GAP = 3.5  # characters of silence between two frames
_SHORTEST_GAP = 0.00175  # s; what the standard asks for above 19200 baud


@final
@dataclass(frozen=True)
class ModbusTimes(WireTimes):
    """On an RTU line at a speed [baud], with so many bits a byte."""

    baud: int
    bits_per_byte: int = 11

    @property
    def silence(self) -> float:
        """For which the line is silent between two frames."""
        return max(_GAP * self.bits_per_byte / self.baud, _SHORTEST_GAP)

    def of(self, size: int) -> float:
        """Of so many bytes."""
        return size * self.bits_per_byte / self.baud

    def round_trip(self, channels: int) -> float:
        """See `WireTimes`; with the silences.

        In one transaction, FC23, with what was achieved read back.
        """
        request = _READ_WRITE + 2 * (_SET_HEAD + channels * CHANNEL_SIZE)
        answer = _READ + 2 * (_ACHIEVED_HEAD + channels * CHANNEL_SIZE)
        return self.of(request + answer) + 2 * self.silence

    def commit(self) -> float:
        """See `WireTimes`; its end is known by the silence after it."""
        return self.of(_READ_WRITE + 2 * _COMMIT) + self.silence

    def loading(self, knots: int) -> float:
        """See `WireTimes`; with the silences."""
        request = _READ_WRITE + 2 * (_ENVELOPE_HEAD + _KNOT * knots)
        answer = _READ + 2 * _ENVELOPE_HEAD
        return self.of(request + answer) + 2 * self.silence
