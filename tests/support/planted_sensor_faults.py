"""Faults of sensors to plant into the simulated amplifier; see `planted_faults`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.protocol.messages import (
    Apply,
    GetSensors,
    Measure,
    Nak,
    Reading,
    SampleBlock,
    SensorList,
)
from planted_bugs import Plant, replaced, wrapped
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.bench import sensing
from sim.bench.reading import ToneReader
from sim.bench.sensing import Sensing


@dataclass(frozen=True)
class SensorFault:
    """What is changed, and the check that must find it."""

    check: str
    plant: Plant


def handled(around: Any) -> Plant:
    """Call `around(handle, sensors, request, now)` for every request to sensors."""
    return wrapped(Sensing, "handle", around)


def reply_of(kind: type[Any], alter: Any) -> Plant:
    """Alter every reply of a kind."""

    def around(handle: Any, self: Any, request: Any, now: float) -> Any:
        reply = handle(self, request, now)
        return replace(reply, **alter(reply)) if isinstance(reply, kind) else reply

    return handled(around)


def _forgets_when_refusing(handle: Any, self: Any, request: Any, now: float) -> Any:
    reply = handle(self, request, now)
    if isinstance(request, Measure) and isinstance(reply, Nak):
        self.forget()
    return reply


def _feeds(handle: Any, self: Any, request: Any, now: float) -> Any:
    reply = handle(self, request, now)
    if isinstance(request, Measure):
        self._last_fed = now
    return reply


def _falls_silent(handle: Any, self: Any, request: Any, now: float) -> Any:
    if isinstance(request, Measure):
        self._channels.silence(now, ramp=0.0)
    return handle(self, request, now)


def _disturbed_by_repeating(handle: Any, self: Any, request: Any, now: float) -> Any:
    if isinstance(request, Apply) and self._sets.token == request.command_set.token:
        self._sensing.changed(now)
    return handle(self, request, now)


def _each_alone(read: Any, self: ToneReader) -> Any:
    """A lock-in for each tone, whatever sounds beside it."""
    self._normal = np.diag(np.diag(self._normal))
    return read(self)


def _from_its_window(read: Any, self: ToneReader) -> Any:
    self._offset = 0.0
    return read(self)


def _first_sensor(reply: SensorList, **changes: Any) -> dict[str, Any]:
    first, *others = reply.sensors or (None,)
    return {"sensors": (replace(first, **changes), *others) if first else ()}


def _loudest_one(reply: Reading) -> dict[str, Any]:
    """Every reading as loud as another."""
    tones = [tone for one in reply.sensors for tone in one.tones]
    loudest = max((tone.amplitude for tone in tones), default=1.0)
    return {
        "sensors": tuple(
            replace(
                one,
                tones=tuple(
                    replace(tone, amplitude=tone.amplitude / loudest) for tone in one.tones
                ),
            )
            for one in reply.sensors
        )
    }


SENSOR_FAULTS: Mapping[str, SensorFault] = {
    "sensors are listed from the first, whatever is asked": SensorFault(
        "sensor_descriptions",
        handled(
            lambda handle, self, request, now: handle(
                self, GetSensors(0) if isinstance(request, GetSensors) else request, now
            )
        ),
    ),
    "a sensor sits at a channel that does not exist": SensorFault(
        "sensor_descriptions", reply_of(SensorList, lambda one: _first_sensor(one, channel=15))
    ),
    "a sensor has no range": SensorFault(
        "sensor_descriptions", reply_of(SensorList, lambda one: _first_sensor(one, range=0.0))
    ),
    "a reading is complete 20 ms early": SensorFault(
        "readings",
        wrapped(
            ToneReader, "reading", lambda read, self, first, now: read(self, first, now + 0.02)
        ),
    ),
    "a reading is complete 20 ms late": SensorFault(
        "readings",
        wrapped(
            ToneReader, "reading", lambda read, self, first, now: read(self, first, now - 0.02)
        ),
    ),
    "tones that the window does not tell apart are measured": SensorFault(
        "readings", replaced(sensing, "pairwise", lambda _: [(0.0, 1e6)])
    ),
    "a refused Measure ends the reading": SensorFault("readings", handled(_forgets_when_refusing)),
    "Measure feeds the watchdog": SensorFault(
        "readings_change_nothing", wrapped(SimulatedAmplifier, "handle", _feeds)
    ),
    "Measure silences": SensorFault(
        "readings_change_nothing", wrapped(SimulatedAmplifier, "handle", _falls_silent)
    ),
    "no reading is disturbed": SensorFault(
        "disturbed_readings", replaced(Sensing, "changed", lambda self, moment: None)
    ),
    "a repeated Apply disturbs a reading": SensorFault(
        "disturbed_readings", wrapped(SimulatedAmplifier, "handle", _disturbed_by_repeating)
    ),
    "t at the start of a window is zero": SensorFault(
        "disturbed_readings", reply_of(Reading, lambda one: {"start": 0.0})
    ),
    "tones that sound together leak into each other": SensorFault(
        "readings_of_tones", wrapped(ToneReader, "_sensors", _each_alone)
    ),
    "phases count from the window of each reading": SensorFault(
        "readings_of_tones", wrapped(ToneReader, "_sensors", _from_its_window)
    ),
    "readings have an automatic gain": SensorFault(
        "readings_of_tones", reply_of(Reading, _loudest_one)
    ),
    "a count of raw samples is stated as half": SensorFault(
        "raw_samples",
        reply_of(
            SensorList,
            lambda one: {
                "sensors": tuple(replace(s, count_step=s.count_step / 2) for s in one.sensors)
            },
        ),
    ),
    "raw samples are numbered from the oldest": SensorFault(
        "raw_samples", reply_of(SampleBlock, lambda one: {"first": 0})
    ),
}
"""Faults by what is wrong; each is seen on every wire."""
