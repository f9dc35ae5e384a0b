"""The objects of the sensors of a simulated amplifier.

Indices and ranges are those of protocol.yaml; the encoding shares no code with the host's side.
"""

import struct
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    GetBlock,
    GetReading,
    GetSensors,
    Measure,
    Nak,
    NakCode,
    Reading,
    Reply,
    Request,
    SampleBlock,
    Sensor,
    SensorList,
)
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.can_bus.sdo import BAD_LENGTH, NO_SUBINDEX, SdoAbort
from sim.far_ends.can_bus.set_buffer import NO_CHANNEL

_Key: TypeAlias = tuple[int, int]
_ABORTS = {NakCode[name]: code for name, code in PROTOCOL.canopen["aborts"].items()}
_INDEX = {name: declared["index"] for name, declared in PROTOCOL.canopen["objects"].items()}
_Q = PROTOCOL.quantities
_UNKNOWN = 0xFFFF  # place


class SensorObjects:
    """The objects of the sensors of a device."""

    def __init__(self, device: SimulatedDevice) -> None:
        self._device = device
        self._first_sample = GetBlock(0, 0)

    def reads(self) -> dict[_Key, Callable[[], bytes]]:
        """What is read, by index and subindex."""
        found: dict[_Key, Callable[[], bytes]] = {
            (_INDEX["sensors"], 0): self._count,
            (_INDEX["sensor_reading"], 0): self._count,
            (_INDEX["reading"], 0): self._reading,
            (_INDEX["samples"], 0): self._samples,
        }
        for number in range(_Q.sensor_count.maximum):
            found[_INDEX["sensors"], number + 1] = partial(self._sensor, number)
            found[_INDEX["sensor_reading"], number + 1] = partial(self._tones, number)
        return found

    def writes(self) -> dict[_Key, Callable[[bytes], None]]:
        """What is written, by index and subindex."""
        return {
            (_INDEX["measure"], 0): self._measure,
            (_INDEX["first_sample"], 0): self._select,
        }

    def _exchange(self, request: Request) -> Reply | None:
        reply = self._device.exchange(request)
        if isinstance(reply, Nak):
            raise SdoAbort(_ABORTS[reply.code])
        return reply

    def _count(self) -> bytes:
        reply = self._exchange(GetSensors(0))
        return bytes([reply.count if isinstance(reply, SensorList) else 0])

    def _sensor(self, number: int) -> bytes:
        reply = self._exchange(GetSensors(number))
        if not isinstance(reply, SensorList) or not reply.sensors:
            raise SdoAbort(NO_SUBINDEX)
        return _described(reply.sensors[0])

    def _reading(self) -> bytes:
        reply = self._exchange(GetReading(0))
        if not isinstance(reply, Reading):
            raise SdoAbort(_ABORTS[NakCode.BUSY])
        return struct.pack(
            "<HBHLHB",
            reply.number,
            reply.state,
            round(reply.left * 1000),
            min(round(reply.start * 1e6), _Q.window_start.maximum),
            reply.token,
            reply.tone_count,
        )

    def _tones(self, number: int) -> bytes:
        self._sensor(number)  # aborts for one that does not exist
        reply = self._exchange(GetReading(number))
        if not isinstance(reply, Reading):
            raise SdoAbort(_ABORTS[NakCode.BUSY])
        if not reply.sensors:  # not complete
            return struct.pack("<H", reply.number)
        sensor = reply.sensors[0]
        tones = [struct.pack("<fh", tone.amplitude, _phase(tone.phase)) for tone in sensor.tones]
        return struct.pack("<HB", reply.number, sensor.is_overloaded) + b"".join(tones)

    def _samples(self) -> bytes:
        reply = self._exchange(self._first_sample)
        if not isinstance(reply, SampleBlock):
            raise SdoAbort(_ABORTS[NakCode.BUSY])
        samples = reply.samples[: _Q.sample_count.maximum]
        head = struct.pack("<HLLB", reply.number, reply.first, reply.end, len(samples))
        return head + struct.pack(f"<{len(samples)}h", *samples)

    def _measure(self, data: bytes) -> None:
        if len(data) < 5 or len(data) != 5 + 2 * data[4]:
            raise SdoAbort(BAD_LENGTH)
        number, window, count = struct.unpack_from("<HHB", data)
        if not (
            _Q.reading.holds(number)
            and _Q.window.holds(window)
            and 1 <= count <= _Q.tone_count.maximum
        ):
            raise SdoAbort(_ABORTS[NakCode.BAD_VALUE])
        frequencies = struct.unpack_from(f"<{count}H", data, 5)
        wanted = tuple(one / _Q.frequency.per_unit for one in frequencies)
        self._exchange(Measure(number, window / 1000, wanted))

    def _select(self, data: bytes) -> None:
        if len(data) != 5:
            raise SdoAbort(BAD_LENGTH)
        sensor, sample = struct.unpack("<BL", data)
        if not _Q.sensor.holds(sensor):
            raise SdoAbort(_ABORTS[NakCode.BAD_VALUE])
        wanted = GetBlock(sensor, sample)
        self._exchange(wanted)
        self._first_sample = wanted


def _described(sensor: Sensor) -> bytes:
    x, y = (_UNKNOWN if at is None else round(at * 10_000) for at in (sensor.x, sensor.y))
    return struct.pack(
        "<BBHHfHHf",
        sensor.unit,
        NO_CHANNEL if sensor.channel is None else sensor.channel,
        x,
        y,
        sensor.range,
        round(sensor.frequency_max * _Q.frequency.per_unit),
        sensor.sample_rate,
        sensor.count_step,
    )


def _phase(degrees: float) -> int:
    """The integer of an angle, -180 up to below 180 degrees."""
    return (round(degrees * 100) + 18000) % 36000 - 18000
