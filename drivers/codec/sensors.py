"""Payloads of sensors, readings and raw samples, on serial lines and in CAN objects.

Unpacking yields values in range or raises Malformed. Packing a list takes as many sensors as fit.
"""

from dataclasses import replace

from drivers.codec.payload import Cursor, Malformed, pack, pack_optional_channel, pack_real
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    GetBlock,
    GetReading,
    GetSensors,
    Measure,
    NakCode,
    Reading,
    ReadingState,
    SampleBlock,
    Sensor,
    SensorList,
    SensorReading,
    SensorUnit,
    ToneReading,
)

_Q = PROTOCOL.quantities
UNKNOWN_PLACE = _Q.place.maximum
_OVERLOAD = 1 << PROTOCOL.overload
_SENSOR_SIZE, _HEAD_SIZE, _TONE_SIZE = 18, 13, 6


def pack_get_sensors(request: GetSensors | GetReading) -> bytes:
    """Pack from which sensor on to list."""
    return pack((_Q.sensor, request.first))


def unpack_get_sensors(cursor: Cursor) -> GetSensors:
    """Unpack from which sensor on to describe."""
    return GetSensors(cursor.integer(_Q.sensor))


def unpack_get_reading(cursor: Cursor) -> GetReading:
    """Unpack from which sensor on to report."""
    return GetReading(cursor.integer(_Q.sensor))


def pack_measure(request: Measure) -> bytes:
    """Pack what to measure."""
    return pack(
        (_Q.reading, request.number),
        (_Q.window, request.window),
        (_Q.tone_count, len(request.frequencies)),
        *((_Q.frequency, frequency) for frequency in request.frequencies),
    )


def unpack_measure(cursor: Cursor) -> Measure:
    """Unpack what to measure; at least one tone."""
    number, window = cursor.integer(_Q.reading), cursor.number(_Q.window)
    count = cursor.integer(_Q.tone_count)
    if not count:
        raise Malformed("a reading needs at least one tone", code=NakCode.BAD_VALUE)
    return Measure(number, window, tuple(cursor.number(_Q.frequency) for _ in range(count)))


def pack_get_block(request: GetBlock) -> bytes:
    """Pack which samples to report."""
    return pack((_Q.sensor, request.sensor), (_Q.sample, request.sample))


def unpack_get_block(cursor: Cursor) -> GetBlock:
    """Unpack which samples to report."""
    return GetBlock(cursor.integer(_Q.sensor), cursor.integer(_Q.sample))


def pack_sensors(found: SensorList) -> bytes:
    """Pack as many sensors as fit."""
    listed = found.sensors[: (PROTOCOL.serial.payload_max - 2) // _SENSOR_SIZE]
    head = pack((_Q.sensor_count, found.count), (_Q.sensor_count, len(listed)))
    return head + b"".join(pack_sensor(sensor) for sensor in listed)


def unpack_sensors(cursor: Cursor) -> SensorList:
    """Unpack a list of sensors."""
    count, listed = cursor.integer(_Q.sensor_count), cursor.integer(_Q.sensor_count)
    return SensorList(count, tuple(unpack_sensor(cursor) for _ in range(listed)))


def pack_sensor(sensor: Sensor) -> bytes:
    """Pack the description of a sensor."""
    place = (UNKNOWN_PLACE if at is None else _Q.place.to_wire(at) for at in (sensor.x, sensor.y))
    return (
        bytes([sensor.unit])
        + pack_optional_channel(sensor.channel)
        + b"".join(at.to_bytes(2, "little") for at in place)
        + pack_real(sensor.range)
        + pack((_Q.frequency, sensor.frequency_max), (_Q.sample_rate, sensor.sample_rate))
        + pack_real(sensor.count_step)
    )


def unpack_sensor(cursor: Cursor) -> Sensor:
    """Unpack the description of a sensor."""
    return Sensor(
        unit=cursor.one_of(SensorUnit),
        channel=cursor.optional_channel(),
        x=place_of(cursor.integer(_Q.place)),
        y=place_of(cursor.integer(_Q.place)),
        range=cursor.real(),
        frequency_max=cursor.number(_Q.frequency),
        sample_rate=cursor.integer(_Q.sample_rate),
        count_step=cursor.real(),
    )


def place_of(integer: int) -> float | None:
    """Return a place [m], None for one that the amplifier does not know."""
    return None if integer == UNKNOWN_PLACE else _Q.place.from_wire(integer)


def pack_reading(reading: Reading) -> bytes:
    """Pack a reading with as many sensors as fit."""
    room = PROTOCOL.serial.payload_max - _HEAD_SIZE
    listed = reading.sensors[: room // (1 + _TONE_SIZE * max(reading.tone_count, 1))]
    head = pack_reading_head(reading) + pack((_Q.sensor_count, len(listed)))
    return head + b"".join(pack_sensor_reading(one) for one in listed)


def unpack_reading(cursor: Cursor) -> Reading:
    """Unpack a reading."""
    head = unpack_reading_head(cursor)
    listed = cursor.integer(_Q.sensor_count)
    sensors = tuple(unpack_sensor_reading(cursor, head.tone_count) for _ in range(listed))
    return replace(head, sensors=sensors)


def pack_reading_head(reading: Reading) -> bytes:
    """Pack a reading without its sensors; its start saturates."""
    return (
        pack((_Q.held_reading, reading.number))
        + bytes([reading.state])
        + pack(
            (_Q.window_left, reading.left),
            (_Q.window_start, min(reading.start, _Q.window_start.high)),
            (_Q.active_token, reading.token),
            (_Q.tone_count, reading.tone_count),
        )
    )


def unpack_reading_head(cursor: Cursor) -> Reading:
    """Unpack a reading without its sensors."""
    return Reading(
        number=cursor.integer(_Q.held_reading),
        state=cursor.one_of(ReadingState),
        left=cursor.number(_Q.window_left),
        start=cursor.number(_Q.window_start),
        token=cursor.integer(_Q.active_token),
        tone_count=cursor.integer(_Q.tone_count),
    )


def pack_sensor_reading(one: SensorReading) -> bytes:
    """Pack the tones of one sensor."""
    tones = (pack_real(tone.amplitude) + pack((_Q.phase, tone.phase)) for tone in one.tones)
    return bytes([_OVERLOAD * one.is_overloaded]) + b"".join(tones)


def unpack_sensor_reading(cursor: Cursor, tones: int) -> SensorReading:
    """Unpack so many tones of one sensor."""
    is_overloaded = bool(cursor.byte() & _OVERLOAD)
    read = (ToneReading(cursor.real(), cursor.number(_Q.phase)) for _ in range(tones))
    return SensorReading(tuple(read), is_overloaded)


def pack_block(block: SampleBlock) -> bytes:
    """Pack raw samples, as many as fit."""
    samples = block.samples[: _Q.sample_count.maximum]
    return pack(
        (_Q.held_reading, block.number),
        (_Q.sample, block.first),
        (_Q.sample, block.end),
        (_Q.sample_count, len(samples)),
    ) + b"".join(sample.to_bytes(2, "little", signed=True) for sample in samples)


def unpack_block(cursor: Cursor) -> SampleBlock:
    """Unpack raw samples."""
    number = cursor.integer(_Q.held_reading)
    first, end = cursor.integer(_Q.sample), cursor.integer(_Q.sample)
    count = cursor.integer(_Q.sample_count)
    return SampleBlock(number, first, end, tuple(cursor.signed() for _ in range(count)))
