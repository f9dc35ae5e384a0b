"""Durations of serial frames."""

from dataclasses import dataclass
from typing import final

from drivers.codec.serial_line.frame import frame_length
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.wire_times import WireTimes

_BITS_PER_BYTE = 10  # start, eight data, stop
_SET_HEAD = 9  # session, token, ramp, valid_for, count
_ACHIEVED_HEAD = 3  # token, count
_COMMAND = 8  # channel, flags, frequency, level, phase; two more with envelopes
_COMMIT = 4  # session, token
_ENVELOPE_HEAD = 4  # slot, step, count
_KNOT = 4  # level, phase
_LOADED = 2  # slot, count
_STATUS_LENGTH = frame_length(13 + 2 * PROTOCOL.quantities.channel_count.maximum)


@final
@dataclass(frozen=True)
class SerialTimes(WireTimes):
    """Durations on a line at a speed [baud]."""

    baud: int = PROTOCOL.serial.baud

    def apply(self, channels: int) -> float:
        """Duration of an apply with this number of channels, without its reply."""
        return self._duration(frame_length(_SET_HEAD + _COMMAND * channels))

    def round_trip(self, channels: int) -> float:
        """See `WireTimes`."""
        answer = frame_length(_ACHIEVED_HEAD + _COMMAND * channels)
        return self.apply(channels) + self._duration(answer)

    def commit(self) -> float:
        """See `WireTimes`."""
        return self._duration(frame_length(_COMMIT))

    def loading(self, knots: int) -> float:
        """See `WireTimes`."""
        return self._duration(frame_length(_ENVELOPE_HEAD + _KNOT * knots) + frame_length(_LOADED))

    def exchange(self, request_length: int) -> float:
        """Duration of a request of this length and of a reply as long, or a Status."""
        return self._duration(request_length + max(request_length, _STATUS_LENGTH))

    def _duration(self, length: int) -> float:
        return length * _BITS_PER_BYTE / self.baud
