"""What Modbus RTU frames cost in time, by arithmetic."""

from drivers.codec.modbus.blocks import CHANNEL_SIZE, HEAD
from drivers.protocol.definition import PROTOCOL

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


def silence(*, baud: int, bits_per_byte: int = 11) -> float:
    """Time [s] for which the line is silent between two frames."""
    return max(_GAP * bits_per_byte / baud, _SHORTEST_GAP)


def apply_time(channels: int, *, baud: int, bits_per_byte: int = 11) -> float:
    """Time [s] that an apply of so many channels takes on the line, without its answer."""
    registers = _SET_HEAD + channels * CHANNEL_SIZE
    return (_READ_WRITE + 2 * registers) * bits_per_byte / baud


def round_trip_time(channels: int, *, baud: int, bits_per_byte: int = 11) -> float:
    """Time [s] of an apply and its answer with the silences, the amplifier's own delay not counted.

    In one transaction, FC23, with what was achieved read back.
    """
    registers = _ACHIEVED_HEAD + channels * CHANNEL_SIZE
    answer = (_READ + 2 * registers) * bits_per_byte / baud
    gaps = 2 * silence(baud=baud, bits_per_byte=bits_per_byte)
    return apply_time(channels, baud=baud, bits_per_byte=bits_per_byte) + answer + gaps


def commit_time(*, baud: int, bits_per_byte: int = 11) -> float:
    """Time [s] on the line until a commit has arrived, its end known by the silence after it."""
    size = _READ_WRITE + 2 * _COMMIT
    return size * bits_per_byte / baud + silence(baud=baud, bits_per_byte=bits_per_byte)


def loading_time(knots: int, *, baud: int, bits_per_byte: int = 11) -> float:
    """Time [s] of loading an envelope of so many knots and of its answer, with the silences."""
    request = _READ_WRITE + 2 * (_ENVELOPE_HEAD + _KNOT * knots)
    answer = _READ + 2 * _ENVELOPE_HEAD
    gaps = 2 * silence(baud=baud, bits_per_byte=bits_per_byte)
    return (request + answer) * bits_per_byte / baud + gaps
