"""Register contents of the sensors of a simulated amplifier.

Written from protocol.yaml, without code of the host's side.
"""

import struct
from collections.abc import Sequence

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    GetBlock,
    Measure,
    NakCode,
    Reading,
    Reply,
    SampleBlock,
    Sensor,
    SensorList,
)
from sim.far_ends.modbus.registers import MAP, NO_CHANNEL, RefusedWrite, value_of, word_of

_Q = PROTOCOL.quantities
_UNKNOWN = 0xFFFF  # place


def sensor_words(reply: Reply | None) -> list[int]:
    """The registers of the sensors that are listed; zeros where there are none."""
    found = reply if isinstance(reply, SensorList) else SensorList(0, ())
    listed = found.sensors[: MAP["sensors_listed"]]
    words = [found.count, len(listed)]
    for sensor in listed:
        words += _described(sensor)
    return words


def _described(sensor: Sensor) -> list[int]:
    return [
        int(sensor.unit),
        NO_CHANNEL if sensor.channel is None else sensor.channel,
        *(_UNKNOWN if at is None else word_of(_Q.place, at) for at in (sensor.x, sensor.y)),
        *_real(sensor.range),
        word_of(_Q.frequency, sensor.frequency_max),
        sensor.sample_rate,
        *_real(sensor.count_step),
    ]


def reading_words(reply: Reply | None) -> list[int]:
    """The registers of a reading, with as many sensors as fit; zeros where there is none."""
    if not isinstance(reply, Reading):
        return []
    each = 1 + 3 * reply.tone_count
    listed = reply.sensors[: MAP["reading_registers"] // each]
    start = min(round(reply.start * _Q.window_start.per_unit), _Q.window_start.maximum)
    words = [
        reply.number,
        int(reply.state),
        word_of(_Q.window_left, reply.left),
        *_two(start),
        reply.token,
        reply.tone_count,
        len(listed),
    ]
    for sensor in listed:
        words.append(int(sensor.is_overloaded))
        for tone in sensor.tones:
            words += [*_real(tone.amplitude), _phase(tone.phase)]
    return words


def sample_words(reply: Reply | None) -> list[int]:
    """The registers of raw samples; zeros where there are none."""
    if not isinstance(reply, SampleBlock):
        return []
    samples = [sample % 0x10000 for sample in reply.samples[: _Q.sample_count.maximum]]
    return [reply.number, *_two(reply.first), *_two(reply.end), len(samples), *samples]


def decode_measure(words: Sequence[int]) -> Measure:
    """Decode the block of a reading; raises RefusedWrite."""
    if len(words) < 3 or len(words) != 3 + words[2]:
        raise RefusedWrite(NakCode.BAD_LENGTH)
    if not 1 <= words[2] <= _Q.tone_count.maximum:
        raise RefusedWrite(NakCode.BAD_VALUE)
    frequencies = tuple(value_of(_Q.frequency, word) for word in words[3:])
    number = int(value_of(_Q.reading, words[0]))
    return Measure(number, value_of(_Q.window, words[1]), frequencies)


def decode_sample(words: Sequence[int]) -> GetBlock:
    """Decode from which sample on to list; raises RefusedWrite."""
    if len(words) != 3:
        raise RefusedWrite(NakCode.BAD_LENGTH)
    return GetBlock(int(value_of(_Q.sensor, words[0])), words[1] * 0x10000 + words[2])


def _two(number: int) -> tuple[int, int]:
    """A number of 32 bits, the high half first."""
    return number // 0x10000, number % 0x10000


def _real(value: float) -> tuple[int, int]:
    """A number of IEEE 754 binary32, the high half first."""
    high, low = struct.unpack(">HH", struct.pack(">f", value))
    return high, low


def _phase(degrees: float) -> int:
    """The word of an angle, -180 up to below 180 degrees."""
    steps = round(degrees * _Q.phase.per_unit)
    return ((steps + 18000) % 36000 - 18000) % 0x10000
