"""What CAN frames cost in time, by arithmetic."""

from collections.abc import Iterable

from drivers.codec.can_bus.frame import BLOCK, CanFrame

_FRAME_BITS = 47  # beside the data, with the pause after it
_STUFFED_BITS = 34  # of these and the data, every fifth may be followed by one that is stuffed in
_FD_SLOW_BITS = 30  # arbitration, acknowledgement and pause of a CAN FD frame
_FD_FAST_BITS = 37  # control and CRC
_ENVELOPE_HEAD = 3  # bytes: step, count
_KNOT = 4  # bytes: level, phase
_SEGMENT = 7  # bytes


def frame_time(length: int, *, bitrate: int, fd: int = 0) -> float:
    """Longest time [s] of a frame with so many bytes of data; fd: bit rate of the data, 0: none."""
    if fd:
        return _FD_SLOW_BITS / bitrate + (_FD_FAST_BITS + 8 * length) * 1.25 / fd
    stuffing = (_STUFFED_BITS + 8 * length - 1) // 4
    return (_FRAME_BITS + 8 * length + stuffing) / bitrate


def frames_time(frames: Iterable[CanFrame], *, bitrate: int, fd: int = 0) -> float:
    """Longest time [s] of some frames one after the other."""
    return sum(
        frame_time(len(frame.data), bitrate=bitrate, fd=fd if frame.fd else 0) for frame in frames
    )


def round_trip_time(channels: int, *, bitrate: int, fd: int = 0) -> float:
    """Time [s] of an apply of so many channels and its answer, the amplifier's own not counted."""
    sync = frame_time(0, bitrate=bitrate)
    if fd:
        together = frame_time(BLOCK * (1 + channels), bitrate=bitrate, fd=fd)
        return together + sync + frame_time(BLOCK, bitrate=bitrate, fd=fd)
    return (channels + 2) * frame_time(BLOCK, bitrate=bitrate) + sync


def commit_time(*, bitrate: int) -> float:
    """Time [s] on the bus until a commit and its SYNC have arrived."""
    return frame_time(BLOCK, bitrate=bitrate) + frame_time(0, bitrate=bitrate)


def loading_time(knots: int, *, bitrate: int) -> float:
    """Time [s] of loading an envelope of so many knots, as an SDO block transfer with its answers.

    Two frames begin it, two end it, one tells that the segments have come.
    """
    segments = -(-(_ENVELOPE_HEAD + _KNOT * knots) // _SEGMENT)
    return (segments + 5) * frame_time(8, bitrate=bitrate)
