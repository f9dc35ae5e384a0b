"""What CAN frames cost in time, by arithmetic."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

from drivers.codec.can_bus.frame import BLOCK, CanFrame
from drivers.protocol.wire_times import WireTimes

_FRAME_BITS = 47  # beside the data, with the pause after it
_STUFFED_BITS = 34  # of these and the data, every fifth may be followed by one that is stuffed in
_FD_SLOW_BITS = 30  # arbitration, acknowledgement and pause of a CAN FD frame
_FD_FAST_BITS = 37  # control and CRC
_ENVELOPE_HEAD = 3  # bytes: step, count
_KNOT = 4  # bytes: level, phase
_SEGMENT = 7  # bytes


@final
@dataclass(frozen=True)
class CanTimes(WireTimes):
    """On a bus at a bit rate, with the worst stuffing; fd: that of the data, 0 without CAN FD."""

    bitrate: int
    fd: int = 0

    def frame(self, length: int) -> float:
        """Of a frame with so many bytes of data."""
        stuffing = (_STUFFED_BITS + 8 * length - 1) // 4
        return (_FRAME_BITS + 8 * length + stuffing) / self.bitrate

    def fd_frame(self, length: int) -> float:
        """Of a CAN FD frame with so many bytes of data."""
        return _FD_SLOW_BITS / self.bitrate + (_FD_FAST_BITS + 8 * length) * 1.25 / self.fd

    def frames(self, frames: Iterable[CanFrame]) -> float:
        """Of some frames one after the other."""
        return sum(
            self.fd_frame(len(frame.data)) if frame.fd else self.frame(len(frame.data))
            for frame in frames
        )

    def round_trip(self, channels: int) -> float:
        """See `WireTimes`."""
        sync = self.frame(0)
        if self.fd:
            return self.fd_frame(BLOCK * (1 + channels)) + sync + self.fd_frame(BLOCK)
        return (channels + 2) * self.frame(BLOCK) + sync

    def commit(self) -> float:
        """See `WireTimes`; with its SYNC."""
        return self.frame(BLOCK) + self.frame(0)

    def loading(self, knots: int) -> float:
        """See `WireTimes`; as an SDO block transfer with its answers.

        Two frames begin it, two end it, one tells that the segments have come.
        """
        segments = -(-(_ENVELOPE_HEAD + _KNOT * knots) // _SEGMENT)
        return (segments + 5) * self.frame(8)
