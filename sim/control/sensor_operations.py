"""Control operations on sensors and recordings."""

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from model.errors import InputError
from sim.control.context import SimulationContext
from sim.control.values import (
    Operation,
    Request,
    Response,
    is_number,
    parse_number,
    parse_position,
    parse_window,
)
from sim.plant.accelerometer import Accelerometer
from sim.sensors.recording import Recording

_MAX_TONES = 64
_SENSOR_KEYS = {  # by key: field and unit
    "noise_m_s2_rthz": ("noise_density", "m/s²/√Hz"),
    "reach_m_s2": ("reach", "m/s²"),
    "resolution_m_s2": ("resolution", "m/s²"),
    "scale": ("scale", "reading per acceleration"),
}


async def _sensors(context: SimulationContext, request: Request, now: float) -> Response:
    given = request.get("sensors")
    if not isinstance(given, dict):
        raise InputError('sensors must be an object, as in {"P1": {"at_m": [0.10, 0.08]}}')
    sensors = [_sensor(name, values) for name, values in given.items()]
    context.bench.advance(now)
    context.accelerometers.place(sensors)
    return {"ok": True, "time_s": context.bench.time}


def _sensor(name: str, given: object) -> Accelerometer:
    what = f"sensor {name[:40]!r}"
    if not isinstance(given, dict):
        raise InputError(f'{what} must be an object, as in {{"at_m": [0.10, 0.08]}}')
    unknown = sorted(given.keys() - {"at_m", *_SENSOR_KEYS})
    if unknown:
        raise InputError(f"{what}: {unknown[0][:40]!r} is unknown")
    x, y = parse_position(given.get("at_m"), what=what)
    values: dict[str, Any] = {
        field: parse_number(given, key, unit)
        for key, (field, unit) in _SENSOR_KEYS.items()
        if key in given
    }
    return replace(Accelerometer(name, x, y), **values)


async def _signals(context: SimulationContext, request: Request, now: float) -> Response:
    recording = _recorded(context, request, now)
    columns = zip(
        recording.names, recording.points.tolist(), recording.samples.T.tolist(), strict=True
    )
    return {
        "sample_rate_hz": recording.sample_rate,
        "start_s": recording.start,
        "sensors": {name: {"at_m": at, "m_s2": samples} for name, at, samples in columns},
    }


async def _tones(context: SimulationContext, request: Request, now: float) -> Response:
    frequencies = request.get("frequencies_hz")
    nyquist = context.bench.sample_rate / 2
    if not (
        isinstance(frequencies, list)
        and 0 < len(frequencies) <= _MAX_TONES
        and all(is_number(f) and 0 < f < nyquist for f in frequencies)
        and len(set(frequencies)) == len(frequencies)
    ):
        raise InputError(
            f"frequencies_hz must be 1 to {_MAX_TONES} different frequencies below {nyquist:g} Hz"
        )
    recording = _recorded(context, request, now)
    # In a thread: a long fit must not delay the amplifiers' replies.
    phasors = await asyncio.to_thread(recording.tones, frequencies)
    columns = zip(recording.names, recording.points.tolist(), phasors.T, strict=True)
    return {
        "sensors": {
            name: {"at_m": at, "real_m_s2": a.real.tolist(), "imag_m_s2": a.imag.tolist()}
            for name, at, a in columns
        }
    }


def _recorded(context: SimulationContext, request: Request, now: float) -> Recording:
    since, until = parse_window(request)
    context.bench.advance(now)
    return context.accelerometers.read(since, until)


async def _record(context: SimulationContext, request: Request, now: float) -> Response:
    file = request.get("file")
    if not isinstance(file, str) or not file:
        raise InputError("file must be the name of a recording, as in run.csv")
    context.bench.advance(now)
    context.record(Path(file))
    return {"ok": True, "time_s": context.bench.time}


async def _finish(context: SimulationContext, request: Request, now: float) -> Response:
    context.bench.advance(now)
    recorder = context.stop_recording()
    await asyncio.to_thread(recorder.finish)
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
