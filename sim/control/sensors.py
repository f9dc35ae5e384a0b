"""Operations of control on sensors: where they are, what they read, and recordings of it."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from model.errors import InputError
from sim.control.answers import Answer, Operation, already
from sim.control.context import SimulationContext
from sim.control.values import is_number, number_of, place_of, window_of
from sim.sensors.accelerometer import Accelerometer
from sim.sensors.recorder import Recorder
from sim.sensors.recording import Recording
from sim.sensors.signal_measures import tone_phasors

_TONES_MAX = 64


def _sensors(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    asked = request.get("sensors")
    if not isinstance(asked, dict):
        raise InputError('sensors must be an object, as in {"P1": {"at_m": [0.10, 0.08]}}')
    sensors = [_sensor(name, told) for name, told in asked.items()]
    context.bench.advance(now)
    context.accelerometers.place(sensors)
    return already({"ok": True, "time_s": context.bench.time})


def _sensor(name: str, told: object) -> Accelerometer:
    if not isinstance(told, dict):
        raise InputError(f'sensor {name[:40]!r} needs {{"at_m": [x, y]}} at least')
    unknown = sorted(told.keys() - {"at_m", *_SENSOR_KEYS})
    if unknown:
        raise InputError(f"sensor {name[:40]!r}: {unknown[0][:40]!r} is unknown")
    x, y = place_of(told.get("at_m"), what=f"sensor {name[:40]!r}")
    values = {key: number_of(told, key, unit) for key, unit in _SENSOR_KEYS.items() if key in told}
    return Accelerometer(
        name,
        x,
        y,
        values.get("noise_m_s2_rthz", 0.0),
        values.get("reach_m_s2", math.inf),
        values.get("resolution_m_s2", 0.0),
        values.get("scale", 1.0),
    )


_SENSOR_KEYS = {
    "noise_m_s2_rthz": "m/s²/√Hz",
    "reach_m_s2": "m/s²",
    "resolution_m_s2": "m/s²",
    "scale": "readings per truth",
}


def _signals(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    recording = _recorded(context, request, now)
    return lambda: {
        "sample_rate_hz": recording.sample_rate,
        "start_s": recording.start,
        "sensors": {
            name: {"at_m": at, "m_s2": samples}
            for name, at, samples in zip(
                recording.names,
                recording.points.tolist(),
                recording.samples.T.tolist(),
                strict=True,
            )
        },
    }


def _tones(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    frequencies = request.get("frequencies_hz")
    if not (
        isinstance(frequencies, list)
        and 0 < len(frequencies) <= _TONES_MAX
        and all(is_number(f) and 0 < f < context.bench.sample_rate / 2 for f in frequencies)
        and len(set(frequencies)) == len(frequencies)
    ):
        raise InputError(
            f"frequencies_hz must be 1 to {_TONES_MAX} different frequencies below "
            f"{context.bench.sample_rate / 2:g} Hz"
        )
    recording = _recorded(context, request, now)

    def answer() -> dict[str, Any]:
        found = tone_phasors(recording, frequencies)
        return {
            "sensors": {
                name: {"at_m": at, "real_m_s2": column.real.tolist(), "imag_m_s2": imag}
                for name, at, column, imag in zip(
                    recording.names,
                    recording.points.tolist(),
                    found.T,
                    found.imag.T.tolist(),
                    strict=True,
                )
            }
        }

    return answer


def _recorded(context: SimulationContext, request: dict[str, Any], now: float) -> Recording:
    since, until = window_of(request)
    context.bench.advance(now)
    return context.accelerometers.read(since, until)


def _record(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    file = request.get("file")
    if not isinstance(file, str) or not file:
        raise InputError("file must be the name of a recording, as in run.csv")
    context.bench.advance(now)
    context.record(Path(file))
    return already({"ok": True, "time_s": context.bench.time})


def _finish(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    context.bench.advance(now)
    recorder = context.stop_recording()
    return lambda: _finished(recorder)


def _finished(recorder: Recorder) -> dict[str, Any]:
    recorder.finish()
    return {
        "file": str(recorder.path),
        "seconds": recorder.seconds,
        "is_full": recorder.is_full,
    }


OPERATIONS: Mapping[str, Operation] = {
    "sensors": _sensors,
    "signals": _signals,
    "tones": _tones,
    "record": _record,
    "finish": _finish,
}
