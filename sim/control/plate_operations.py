"""Control operations on fingers, sensors, recordings and the plate, and checks of their values."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

from model.errors import InputError
from model.structure.attachments import PointLoad
from sim.control.context import SimulationContext
from sim.plant.accelerometer import Accelerometer
from sim.plant.fingers import Position, measure_vibration
from sim.plant.imperfections import PlateErrors
from sim.sensors.recording import Recording

Request: TypeAlias = dict[str, Any]
Response: TypeAlias = dict[str, Any]
Operation: TypeAlias = Callable[[SimulationContext, Request, float], Awaitable[Response]]
"""Executes a request at a time [s], or raises InputError and changes nothing."""


def parse_window(request: Request) -> tuple[float, float]:
    """The time window since_s to until_s [s]."""
    since = parse_number(request, "since_s", "seconds")
    until = parse_number(request, "until_s", "seconds")
    if since >= until:
        raise InputError(f"since_s must be less than until_s, got {since} and {until}")
    return since, until


def parse_number(given: Request, key: str, unit: str) -> float:
    """The finite number under a key; unit: for the error."""
    value = given.get(key)
    if not is_number(value):
        raise InputError(f"{key} must be a number of {unit}, got {str(value)[:40]!r}")
    return float(value)


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a JSON value is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # JSON allows integers of any length
        return False


def parse_finger(request: Request) -> str:
    """The id of a finger."""
    name = request.get("finger")
    if not isinstance(name, str) or not 0 < len(name) <= 40:
        raise InputError("finger must be an id of 1 to 40 characters")
    return name


def parse_position(given: object, *, what: str) -> Position:
    """A position [x, y] [m]; what: for the error."""
    if not (isinstance(given, list) and len(given) == 2 and all(map(is_number, given))):
        raise InputError(f"{what} must have a position [x, y] in metres")
    return float(given[0]), float(given[1])


_LOAD = "times the rig's fingertip"


async def _fingers(context: SimulationContext, request: Request, now: float) -> Response:
    fingers = request.get("fingers")
    if not isinstance(fingers, dict):
        raise InputError('fingers must be an object of positions, as in {"1": [0.10, 0.08]}')
    positions = {
        name: parse_position(at, what=f"finger {name[:40]!r}") for name, at in fingers.items()
    }
    observers = request.get("observers", [])
    if not (isinstance(observers, list) and all(name in list(positions) for name in observers)):
        raise InputError('observers must be a list of ids of these fingers, as in ["1"]')
    loads = request.get("loads", {})
    if not (isinstance(loads, dict) and all(name in positions for name in loads)):
        raise InputError('loads must be an object of these fingers\' loads, as in {"1": 1.5}')
    loads = {name: parse_number(loads, name, _LOAD) for name in loads}
    return _placed(context, positions, now, observers=observers, loads=loads)


async def _touch_or_move(context: SimulationContext, request: Request, now: float) -> Response:
    name, present = parse_finger(request), context.bench.positions
    if (name in present) != (request["op"] == "move"):
        state = "already" if name in present else "not"
        raise InputError(f"finger {name!r} is {state} on the plate")
    at = parse_position(request.get("at_m"), what=f"finger {name!r}")
    loads = dict(context.bench.loads)
    if "load" in request:
        loads[name] = parse_number(request, "load", _LOAD)
    return _placed(
        context, {**present, name: at}, now, observers=context.bench.observers, loads=loads
    )


async def _lift(context: SimulationContext, request: Request, now: float) -> Response:
    name, present = parse_finger(request), context.bench.positions
    if name not in present:
        raise InputError(f"finger {name!r} is not on the plate")
    rest = {id: at for id, at in present.items() if id != name}
    return _placed(context, rest, now, observers=context.bench.observers, loads=context.bench.loads)


def _placed(
    context: SimulationContext,
    positions: Mapping[str, Position],
    now: float,
    *,
    observers: Collection[str],
    loads: Mapping[str, float],
) -> Response:
    context.bench.begin_placing(positions, now=now, observers=observers, loads=loads)
    context.start_solving()
    return {"ok": True, "time_s": context.bench.time}


async def _felt(context: SimulationContext, request: Request, now: float) -> Response:
    since, until = parse_window(request)
    await context.solved(until)  # in a thread, as the fits below: amplifiers must go on replying
    context.bench.advance(now)
    records, frequencies = context.bench.records(since, until)
    felt = {
        id: await asyncio.to_thread(measure_vibration, record, frequencies)
        for id, record in records.items()
    }
    return {
        "fingers": {
            id: {
                "points_m": one.points.tolist(),
                "weights": one.weights.tolist(),
                "frequencies_hz": list(one.frequencies),
                "amplitude_m_s2": one.amplitude.tolist(),
                "peak_m_s2": one.peak.tolist(),
            }
            for id, one in felt.items()
        }
    }


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


_KEYS = {"op", "modulus", "stiffness", "masses"}
_FACTOR = "times that of the plate at first"


async def _plate(context: SimulationContext, request: Request, now: float) -> Response:
    unknown = sorted(request.keys() - _KEYS)
    if unknown:
        raise InputError(f"plate: {unknown[0][:40]!r} is unknown")
    context.bench.change_plate(_changed(context, request), now=now)
    return {"ok": True, "time_s": context.bench.time}


def _changed(context: SimulationContext, request: Request) -> PlateErrors:
    first, rig = context.first_plate, context.bench.rig
    factors = request.get("stiffness", {})
    names = [era.name for era in rig.eras]
    if not (isinstance(factors, dict) and all(name in names for name in factors)):
        raise InputError(f"stiffness must be an object of factors by ERA ({', '.join(names)})")
    stiffness = {
        name: first.stiffness.get(name, 1.0) * (_factor(factors, name) if name in factors else 1.0)
        for name in names
    }
    modulus = _factor(request, "modulus") if "modulus" in request else 1.0
    masses = request.get("masses", [])
    if not isinstance(masses, list):
        raise InputError("masses must be a list of [x, y, kg]")
    loads = tuple(_mass(context, given) for given in masses)
    return replace(
        first,
        modulus=first.modulus * modulus,
        stiffness=stiffness,
        masses=(*first.masses, *loads),
    )


def _factor(given: Request, key: str) -> float:
    value = parse_number(given, key, _FACTOR)
    if value <= 0:
        raise InputError(f"{key} must be above 0, got {value:g}")
    return value


def _mass(context: SimulationContext, given: object) -> PointLoad:
    if not (isinstance(given, list) and len(given) == 3 and all(map(is_number, given))):
        raise InputError("each mass must be [x, y, kg] in metres and kilograms")
    x, y, mass = map(float, given)
    if not context.bench.rig.plate.contains(x, y) or mass <= 0:
        raise InputError(f"a mass must be above 0 kg and on the plate, got {given}")
    return PointLoad(x, y, mass=mass)


OPERATIONS: Mapping[str, Operation] = {
    "fingers": _fingers,
    "touch": _touch_or_move,
    "move": _touch_or_move,
    "lift": _lift,
    "felt": _felt,
    "sensors": _sensors,
    "signals": _signals,
    "tones": _tones,
    "record": _record,
    "finish": _finish,
    "plate": _plate,
}
