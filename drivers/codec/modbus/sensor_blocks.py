"""Register blocks of sensors, readings and raw samples, decoded for a Modbus host.

Decoding yields a message with every value in range or raises FrameError.
"""

import struct
from collections.abc import Iterator, Sequence

from drivers.codec.modbus.blocks import (
    SENSOR_SIZE,
    channel_of,
    fields_of,
    groups_of,
    integer_of,
    number_of,
    one_of,
)
from drivers.codec.payload import checked_real
from drivers.codec.sensors import place_of
from drivers.errors import FrameError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Reading,
    ReadingState,
    SampleBlock,
    Sensor,
    SensorList,
    SensorReading,
    SensorUnit,
    ToneReading,
)

_MAP = PROTOCOL.modbus["input"]
_Q = PROTOCOL.quantities
_TONE_SIZE = 3


def unpack_sensors(registers: Sequence[int]) -> SensorList:
    """Decode the sensors that were listed."""
    found, rest = fields_of(_MAP["sensors"]["registers"], registers)
    groups = _listed(found["listed"], rest, size=SENSOR_SIZE)
    return SensorList(
        integer_of("sensor_count", found["sensor_count"]), tuple(_sensor(one) for one in groups)
    )


def unpack_reading(registers: Sequence[int]) -> Reading:
    """Decode a reading with the sensors that were listed; none behind its registers."""
    found, rest = fields_of(_MAP["reading"]["registers"], registers)
    tones = integer_of("tone_count", found["tone_count"])
    groups = _listed(found["listed"], rest, size=1 + _TONE_SIZE * tones) if rest else ()
    return Reading(
        number=integer_of("held_reading", found["held_reading"]),
        state=one_of(ReadingState, found["reading_state"]),
        left=number_of("window_left", found["window_left"]),
        start=_Q.window_start.from_wire(found["start_high"] << 16 | found["start_low"]),
        token=integer_of("active_token", found["active_token"]),
        tone_count=tones,
        sensors=tuple(_sensor_reading(one) for one in groups),
    )


def unpack_samples(registers: Sequence[int]) -> SampleBlock:
    """Decode raw samples."""
    found, rest = fields_of(_MAP["samples"]["registers"], registers)
    count = integer_of("sample_count", found["sample_count"])
    raw = struct.pack(f">{len(rest)}H", *rest)
    return SampleBlock(
        number=integer_of("held_reading", found["held_reading"]),
        first=found["first_high"] << 16 | found["first_low"],
        end=found["end_high"] << 16 | found["end_low"],
        samples=struct.unpack(f">{len(rest)}h", raw)[:count],
    )


def _listed(register: int, rest: Sequence[int], *, size: int) -> Iterator[Sequence[int]]:
    """Split the registers of the sensors that were listed."""
    count = integer_of("sensor_count", register)
    if count * size > len(rest):
        raise FrameError(f"listed must be at most {len(rest) // size}, got {count}")
    return iter(list(groups_of(rest, size))[:count])


def _sensor(group: Sequence[int]) -> Sensor:
    unit, channel, x, y, *numbers = group
    high, low, frequency_max, sample_rate, step_high, step_low = numbers
    return Sensor(
        unit=one_of(SensorUnit, unit),
        channel=channel_of(channel),
        x=place_of(x),
        y=place_of(y),
        range=_real(high, low),
        frequency_max=number_of("frequency", frequency_max),
        sample_rate=sample_rate,
        count_step=_real(step_high, step_low),
    )


def _sensor_reading(group: Sequence[int]) -> SensorReading:
    flags, *tones = group
    return SensorReading(
        tuple(
            ToneReading(_real(high, low), number_of("phase", phase))
            for high, low, phase in groups_of(tones, _TONE_SIZE)
        ),
        is_overloaded=bool(flags >> PROTOCOL.overload & 1),
    )


def _real(high: int, low: int) -> float:
    """Decode a number of type f32."""
    (value,) = struct.unpack(">f", struct.pack(">HH", high, low))
    return checked_real(value)
