"""What serial frames cost in time, by arithmetic."""

from drivers.codec.serial_line.frame import frame_length
from drivers.protocol.definition import PROTOCOL

_BITS_PER_BYTE = 10  # start, eight data, stop
_SET_HEAD = 7  # token, ramp, valid_for, count
_ACHIEVED_HEAD = 3  # token, count
_COMMAND = 8  # channel, flags, frequency, level, phase; two more with envelopes
_COMMIT = 2  # token
_ENVELOPE_HEAD = 4  # slot, step, count
_KNOT = 4  # level, phase
_LOADED = 2  # slot, count
_STATUS_LENGTH = frame_length(12 + 2 * PROTOCOL.quantities.channel_count.maximum)


def wire_time(channels: int, *, baud: int = PROTOCOL.serial.baud) -> float:
    """Time [s] that an apply of so many channels takes on the line."""
    return frame_length(_SET_HEAD + _COMMAND * channels) * _BITS_PER_BYTE / baud


def round_trip_time(channels: int, *, baud: int = PROTOCOL.serial.baud) -> float:
    """Time [s] on the line of an apply and its answer, the amplifier's own delay not counted."""
    answer = frame_length(_ACHIEVED_HEAD + _COMMAND * channels)
    return wire_time(channels, baud=baud) + answer * _BITS_PER_BYTE / baud


def commit_time(*, baud: int = PROTOCOL.serial.baud) -> float:
    """Time [s] on the line until a commit has arrived."""
    return frame_length(_COMMIT) * _BITS_PER_BYTE / baud


def loading_time(knots: int, *, baud: int = PROTOCOL.serial.baud) -> float:
    """Time [s] on the line of loading an envelope of so many knots and of the answer."""
    request = frame_length(_ENVELOPE_HEAD + _KNOT * knots)
    return (request + frame_length(_LOADED)) * _BITS_PER_BYTE / baud


def exchange_time(request_length: int, *, baud: int) -> float:
    """Time [s] on the line of a request of so many bytes and of an answer as long, or a Status."""
    return (request_length + max(request_length, _STATUS_LENGTH)) * _BITS_PER_BYTE / baud
