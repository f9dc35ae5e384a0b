"""Measurements of one amplifier: voltage and current of its channels, and tones at its sensors.

These requests need no session, do not feed the watchdog and do not change what plays.
"""

import asyncio
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from drivers.errors import (
    CommandError,
    CommandRefused,
    FrameError,
)
from drivers.host.amplifier import Amplifier
from drivers.host.line import (
    Priority,
)
from drivers.protocol.definition import (
    NO_CHANNEL,
    QUANTITIES,
    READING_STATES,
    SENSOR_UNITS,
    UNKNOWN_PLACE,
    has_feature,
    name_of,
    sensor_reading,
)
from drivers.protocol.records import Record, Refusal, Rows, Values
from registry import threads

_MARGIN = 0.002  # s; by which the amplifier's clock may be late at the end of a window
_MAX_OVERDUE = 2.0  # s; after the end of the window; an emulator may stand still for a while
_ROUNDING = 1e-6  # periods
_Q = QUANTITIES
_VIOLATION = "the amplifier does not keep the protocol"


@dataclass(frozen=True, slots=True)
class AmplifierSensor:
    """A sensor of an amplifier, as it describes it."""

    unit: str
    """A name of `SENSOR_UNITS`."""
    channel: int | None
    """The channel whose actuator it sits at; None if it sits at none."""
    x: float | None
    """Place on the plate [m]; None if the amplifier does not know it."""
    y: float | None
    """As x."""
    range: float
    """Largest amplitude that it measures, in its unit."""
    frequency_max: float
    """Highest frequency that it measures [Hz]."""


@dataclass(frozen=True, slots=True)
class SensorReading:
    """What a sensor measured."""

    is_overloaded: bool
    tones: tuple[tuple[float, float], ...]
    """Amplitude in the sensor's unit and phase [degrees] of each tone."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A measurement of tones at all sensors of an amplifier over a window."""

    number: int
    state: str
    """A name of `READING_STATES`."""
    left: float
    """Time until its window ends [s]."""
    start: int
    """The amplifier's clock at the start of the window, from which phases count."""
    token: int
    """Token of the set that played then."""
    tones: int
    """Number of tones."""
    sensors: tuple[SensorReading, ...]
    """Empty until the reading is complete."""


async def read_amplifier_sensors(amplifier: Amplifier) -> tuple[AmplifierSensor, ...]:
    """Read the descriptions of an amplifier's sensors; empty if it has none."""
    if not has_feature(amplifier.ledger.capabilities, "sensors"):
        return ()
    found: list[AmplifierSensor] = []
    while True:
        listed = await amplifier.request("GetSensors", {"first": len(found)}, Priority.READING)
        found += [_sensor(each) for each in listed["sensors"]]
        if len(found) > listed["all"]:
            raise FrameError(f"sensors must be {listed['all']}, got {len(found)}; {_VIOLATION}")
        is_last = len(found) > _Q["sensor"].maximum or not listed["sensors"]
        if is_last or len(found) == listed["all"]:
            return tuple(found)


async def read_electrical(amplifier: Amplifier) -> list[tuple[float, float]]:
    """Read voltage [V] and current [A] of each channel; empty if it does not measure them."""
    if not has_feature(amplifier.ledger.capabilities, "electrical"):
        return []
    measured = await amplifier.request("GetMeasured", {}, Priority.READING)
    voltage, current = _Q["channel_voltage"].from_wire, _Q["channel_current"].from_wire
    return [
        (voltage(row["channel_voltage"]), current(row["channel_current"]))
        for row in measured["channels"]
    ]


async def start_reading(
    amplifier: Amplifier, frequencies: Sequence[float], window: float
) -> Reading:
    """Begin to measure tones [Hz] at all sensors over a window [s] that starts now.

    Raises CommandError for tones that the window cannot tell apart, and CommandRefused for tones
    that the sensors cannot measure.
    """
    check_tones(frequencies, window)
    number = random.randint(_Q["reading"].minimum, _Q["reading"].maximum)  # noqa: S311  no secret
    values: Values = {
        "reading": number,
        "window": _Q["window"].to_wire(window),
        "tones": len(frequencies),
        "frequencies": [_Q["frequency"].to_wire(each) for each in frequencies],
    }
    found = await amplifier.request("Measure", values, Priority.READING)
    return _reading(found, number=number, tones=len(frequencies))


async def measure_tones(
    amplifier: Amplifier, frequencies: Sequence[float], window: float
) -> Reading:
    """Measure tones [Hz] at all sensors over a window [s] that starts now, and wait for its end.

    The tones of the result are in the order of the frequencies. The caller must wait until the
    plate has settled before, and feed the watchdog during the reading. Raises what `start_reading`
    and `finish_reading` raise.
    """
    return await finish_reading(amplifier, await start_reading(amplifier, frequencies, window))


async def finish_reading(amplifier: Amplifier, started: Reading) -> Reading:
    """Wait for the end of a reading, and return it with all its sensors.

    Raises CommandRefused if another host has started a reading meanwhile, and FrameError if this
    one does not end in time or lacks sensors.
    """
    found = started
    end = threads.now() + started.left + _MAX_OVERDUE
    while found.state == "RUNNING":
        if threads.now() > end:
            raise FrameError(
                f"reading {started.number} must be complete after its window, got {found.state} "
                f"{_MAX_OVERDUE:g} s later; {_VIOLATION}"
            )
        await asyncio.sleep(found.left + _MARGIN)
        found = await _same_reading(amplifier, started, 0)
    count = (await amplifier.request("GetSensors", {"first": 0}, Priority.READING))["all"]
    sensors = found.sensors
    more = sensors
    while more and len(sensors) < count:
        more = (await _same_reading(amplifier, started, len(sensors))).sensors
        sensors += more
    if len(sensors) != count:
        raise FrameError(f"reading must have all {count} sensors, got {len(sensors)}; {_VIOLATION}")
    return replace(found, sensors=sensors)


def check_tones(frequencies: Sequence[float], window: float) -> None:
    """Raise CommandError for tones [Hz] that a window [s] cannot tell apart."""
    limit = _Q["tone_count"].maximum
    if not 1 <= len(frequencies) <= limit:
        raise CommandError(f"a reading must have 1 to {limit} tones, got {len(frequencies)}")
    apart = min(after - before for before, after in pairwise([0.0, *sorted(frequencies)]))
    if not apart * window >= 1 - _ROUNDING:
        raise CommandError(
            f"window must be at least a period of each frequency and of the differences between "
            f"them, 1/({apart:g} Hz), got {window:g} s"
        )


async def _same_reading(amplifier: Amplifier, started: Reading, first: int) -> Reading:
    """Read a reading that was started, with its sensors from this index on."""
    found = await amplifier.request("GetReading", {"first": first}, Priority.READING)
    return _reading(found, number=started.number, tones=started.tones)


def _sensor(values: Values) -> AmplifierSensor:
    channel = values["channel"]
    return AmplifierSensor(
        name_of(SENSOR_UNITS, values["unit"]),
        None if channel == NO_CHANNEL else channel,
        _place(values["x"]),
        _place(values["y"]),
        values["range"],
        _Q["frequency"].from_wire(values["frequency_max"]),
    )


def _place(at: int) -> float | None:
    return None if at == UNKNOWN_PLACE else _Q["place"].from_wire(at)


def _reading(values: Values, *, number: int, tones: int) -> Reading:
    """Return the reading that a reply describes.

    Raises CommandRefused if its number is another one, FrameError for another count of tones.
    """
    if values["reading"] != number:
        raise CommandRefused(
            f"reading {number} was replaced by {values['reading'] or 'none'}: another host "
            "measures, or the amplifier has restarted; measure again"
        )
    if values["tones"] != tones:
        raise FrameError(
            f"reading {number} must have {tones} tones, got {values['tones']}; {_VIOLATION}"
        )
    count = values["count"]
    record = Record(Rows("sensors", count, sensor_reading(tones)))
    try:
        rows = record.unpack(values["sensors"], is_strict=False)["sensors"] if count else []
    except Refusal as refusal:
        raise FrameError(f"reading: {refusal}; {_VIOLATION}") from None
    return Reading(
        values["reading"],
        name_of(READING_STATES, values["state"]),
        _Q["window_left"].from_wire(values["window_left"]),
        values["window_start"],
        values["token"],
        tones,
        tuple(
            SensorReading(
                bool(row["flags"] & 1),
                tuple(
                    (tone["amplitude"], _Q["phase"].from_wire(tone["phase"]))
                    for tone in row["tones"]
                ),
            )
            for row in rows
        ),
    )
