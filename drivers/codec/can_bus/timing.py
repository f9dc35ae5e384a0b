"""Durations of CAN frames."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, final

from drivers.codec.can_bus.canopen import BLOCK, CanFrame
from drivers.protocol.wire_times import WireTimes

_FRAME_BITS = 47  # besides the data, with the interframe space
_STUFFED_BITS = 34  # of these and the data, one stuff bit per four at worst
_FD_SLOW_BITS = 30  # arbitration, acknowledgement and pause of a CAN FD frame
_FD_FAST_BITS = 37  # control and CRC
_ENVELOPE_HEAD = 3  # bytes: step, count
_KNOT = 4  # bytes: level, phase
_SEGMENT = 7  # bytes


@final
@dataclass(frozen=True)
class CanTimes(WireTimes):
    """Durations with worst-case bit stuffing; fd: data bit rate, 0 without CAN FD."""

    is_multi_master: ClassVar[bool] = True

    bitrate: int
    fd: int = 0

    def frame(self, length: int) -> float:
        """Duration of a frame with a number of data bytes."""
        stuffing = (_STUFFED_BITS + 8 * length - 1) // 4
        return (_FRAME_BITS + 8 * length + stuffing) / self.bitrate

    def fd_frame(self, length: int) -> float:
        """Duration of a CAN FD frame with a number of data bytes."""
        return _FD_SLOW_BITS / self.bitrate + (_FD_FAST_BITS + 8 * length) * 1.25 / self.fd

    def frames(self, frames: Iterable[CanFrame]) -> float:
        """Duration of consecutive frames."""
        return sum(
            self.fd_frame(len(frame.data)) if frame.fd else self.frame(len(frame.data))
            for frame in frames
        )

    def round_trip(self, channels: int) -> float:
        """See `WireTimes`."""
        if self.fd:
            return self.fd_frame(BLOCK * (1 + channels)) + self.fd_frame(BLOCK)
        return (channels + 2) * self.frame(BLOCK)

    def commit(self) -> float:
        """See `WireTimes`."""
        return self.frame(BLOCK)

    def loading(self, knots: int) -> float:
        """See `WireTimes`; an SDO block transfer with its replies.

        Two frames initiate it, two end it, one acknowledges the segments.
        """
        segments = -(-(_ENVELOPE_HEAD + _KNOT * knots) // _SEGMENT)
        return (segments + 5) * self.frame(8)
