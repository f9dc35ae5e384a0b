"""The sensors of an amplifier of protocol 2: its messages, by the values of protocol 3."""

from collections.abc import Sequence
from typing import Protocol

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    GetBlock,
    GetReading,
    GetSensors,
    Measure,
    Nak,
    NakCode,
    Reading,
    ReadingState,
    Reply,
    SampleBlock,
    Sensor,
    SensorList,
    SensorReading,
    SensorUnit,
    ToneReading,
)
from drivers.protocol.records import Refusal, Values
from drivers.protocol.table import NO_CHANNEL, QUANTITIES, UNKNOWN_PLACE, sensor_reading
from sim.amplifier.amplifier import SensorRequest, SimulatedAmplifier
from sim.amplifier.summary import AmplifierSummary

_Q = QUANTITIES
_OLD = PROTOCOL.quantities


class Samples(Protocol):
    """Raw samples of a reading."""

    def samples(self, sensor: int, first: int, *, limit: int) -> tuple[int, int, list[int]]:
        """Number of the first, the number after the newest, and samples from one on."""


class ValuePort(Protocol):
    """Sensors that an amplifier reports, and their raw samples."""

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Reply to a request at a time [s]; raises Refusal."""

    def changed(self, moment: float) -> None:
        """Note that what plays changes at a time [s]."""

    def forget(self) -> None:
        """Forget the reading, as without supply."""

    @property
    def reader(self) -> Samples | None:
        """What has read the tones."""

    @property
    def sample_rate(self) -> float:
        """Sampling rate [Hz]."""

    @property
    def count_steps(self) -> Sequence[float]:
        """Of a count of a raw sample of each sensor."""


class SensedAmplifier(SimulatedAmplifier):
    """An amplifier of protocol 2 whose sensors have the values of protocol 3."""

    def attach(self, sensing: ValuePort) -> None:  # type: ignore[override]  # as a bench has them
        """Give it sensors."""
        super().attach(_SensorMessages(sensing))

    def summary(self, now: float) -> AmplifierSummary:
        """What it does at a time [s] up to which it has been ticked."""
        status = self.status(now)
        names = (status.state.name, status.fault.name)
        return AmplifierSummary(*names, status.token, status.high_voltage, status.levels)


class _SensorMessages:
    """Sensors by the messages of protocol 2."""

    def __init__(self, port: ValuePort) -> None:
        self._port = port
        self.changed = port.changed
        self.forget = port.forget

    def handle(self, request: SensorRequest, now: float) -> Reply:
        """Reply to a request at a time [s]."""
        return _reply(self._port, request, now)


def _reply(port: ValuePort, request: SensorRequest, now: float) -> Reply:
    match request:
        case GetSensors(first=first):
            return _listed(port, first, now)
        case Measure(number=number, window=window, frequencies=frequencies):
            values = {
                **{"reading": number, "window": _Q["window"].to_wire(window)},
                "frequencies": [_Q["frequency"].to_wire(each) for each in frequencies],
            }
            try:
                return _reading(port.handle("Measure", values, now), [])
            except Refusal:
                return Nak(NakCode.BAD_VALUE)
        case GetReading(first=first):
            head = values = port.handle("GetReading", {"first": first}, now)
            found: list[SensorReading] = []
            while values["count"]:
                found += _tones(values)
                values = port.handle("GetReading", {"first": first + len(found)}, now)
            return _reading(head, found)
        case GetBlock(sensor=sensor, sample=sample):
            return _block(port, sensor, sample, now)


def _listed(port: ValuePort, first: int, now: float) -> Reply:
    found: list[Sensor] = []
    while True:
        values = port.handle("GetSensors", {"first": first + len(found)}, now)
        found += [
            _described(port, number, each)
            for number, each in enumerate(values["sensors"], first + len(found))
        ]
        if not values["count"] or first + len(found) >= values["all"]:
            return SensorList(values["all"], tuple(found))


def _described(port: ValuePort, number: int, values: Values) -> Sensor:
    rate = _raw_rate(port)
    x, y = (
        None if values[name] == UNKNOWN_PLACE else _Q["place"].from_wire(values[name])
        for name in ("x", "y")
    )
    return Sensor(
        SensorUnit(values["unit"]),
        None if values["channel"] == NO_CHANNEL else values["channel"],
        *(x, y),
        range=values["range"],
        frequency_max=_Q["frequency"].from_wire(values["frequency_max"]),
        sample_rate=rate,
        count_step=port.count_steps[number] if rate else 0.0,
    )


def _raw_rate(port: ValuePort) -> int:
    """Sampling rate of raw samples [Hz]; 0 for one that the protocol cannot state."""
    rate = port.sample_rate
    return int(rate) if rate.is_integer() and rate <= _OLD.sample_rate.maximum else 0


def _reading(values: Values, sensors: Sequence[SensorReading]) -> Reading:
    return Reading(
        values["reading"],
        ReadingState(values["state"]),
        _Q["window_left"].from_wire(values["window_left"]),
        _Q["window_start"].from_wire(values["window_start"]),
        values["token"],
        values["tones"],
        tuple(sensors),
    )


def _tones(values: Values) -> list[SensorReading]:
    record = sensor_reading(values["tones"])
    words, at = values["sensors"], 0
    found = []
    for _ in range(values["count"]):
        row, at = record.read(words, at)
        tones = [
            ToneReading(each["amplitude"], _Q["phase"].from_wire(each["phase"]))
            for each in row["tones"]
        ]
        found.append(SensorReading(tuple(tones), is_overloaded=bool(row["flags"])))
    return found


def _block(port: ValuePort, sensor: int, sample: int, now: float) -> Reply:
    if not _raw_rate(port) or sensor >= len(port.count_steps):
        return Nak(NakCode.BAD_VALUE)
    if port.reader is None:
        return SampleBlock(0, 0, 0, ())
    number = port.handle("GetReading", {"first": _Q["sensor"].maximum}, now)["reading"]
    limit = _OLD.sample_count.maximum
    first, end, samples = port.reader.samples(sensor, sample, limit=limit)
    return SampleBlock(number, first, end, tuple(samples))
