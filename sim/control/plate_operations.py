"""Control operations on fingers, sensors, recordings and the plate."""

import asyncio
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from model.answer.stimulus import check_on_plate
from model.errors import InputError
from model.structure.attachments import PointLoad
from sim.control.context import SimulationContext
from sim.control.requests import (
    File,
    Finger,
    Fingers,
    PlateChange,
    Request,
    Sensors,
    Tones,
    Touch,
    Window,
    read,
)
from sim.plant.accelerometer import Accelerometer
from sim.plant.fingers import Position, measure_vibration
from sim.plant.imperfections import PlateErrors
from sim.sensors.recording import Recording

Response: TypeAlias = dict[str, Any]
Operation: TypeAlias = Callable[[SimulationContext, Request, float], Awaitable[Response]]
"""Executes a request at a time [s], or raises InputError and changes nothing."""


async def _fingers(context: SimulationContext, request: Request, now: float) -> Response:
    given = read(Fingers, request)
    return _placed(context, given.fingers, now, observers=given.observers, loads=given.loads)


async def _touch_or_move(context: SimulationContext, request: Request, now: float) -> Response:
    name, bench = read(Finger, request).finger, context.bench
    if (name in bench.positions) != (request["op"] == "move"):
        state = "already" if name in bench.positions else "not"
        raise InputError(f"finger {name!r} is {state} on the plate")
    given = read(Touch, request)
    loads = dict(bench.loads)
    if given.load is not None:
        loads[name] = given.load
    positions = {**bench.positions, name: given.at_m}
    return _placed(context, positions, now, observers=bench.observers, loads=loads)


async def _lift(context: SimulationContext, request: Request, now: float) -> Response:
    name, present = read(Finger, request).finger, context.bench.positions
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
    window = read(Window, request)
    await context.solved(
        window.until_s
    )  # in a thread, as the fits below: amplifiers must go on replying
    context.bench.advance(now)
    records, frequencies = context.bench.records(window.since_s, window.until_s)
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


async def _sensors(context: SimulationContext, request: Request, now: float) -> Response:
    sensors = [
        Accelerometer(name, *each.at_m, **each.model_dump(exclude={"at_m"}, exclude_unset=True))
        for name, each in read(Sensors, request).sensors.items()
    ]
    context.bench.advance(now)
    context.accelerometers.place(sensors)
    return {"ok": True, "time_s": context.bench.time}


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
    frequencies, nyquist = read(Tones, request).frequencies_hz, context.bench.sample_rate / 2
    if len(set(frequencies)) < len(frequencies) or max(frequencies) >= nyquist:
        raise InputError(f"frequencies_hz must be different ones below {nyquist:g} Hz")
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
    window = read(Window, request)
    context.bench.advance(now)
    return context.accelerometers.read(window.since_s, window.until_s)


async def _record(context: SimulationContext, request: Request, now: float) -> Response:
    file = read(File, request).file
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


async def _plate(context: SimulationContext, request: Request, now: float) -> Response:
    context.bench.change_plate(_changed(context, read(PlateChange, request)), now=now)
    return {"ok": True, "time_s": context.bench.time}


def _changed(context: SimulationContext, change: PlateChange) -> PlateErrors:
    first, rig = context.first_plate, context.bench.rig
    names = [era.name for era in rig.eras]
    if not change.stiffness.keys() <= set(names):
        raise InputError(f"stiffness must be an object of factors by ERA ({', '.join(names)})")
    stiffness = {
        name: first.stiffness.get(name, 1.0) * change.stiffness.get(name, 1.0) for name in names
    }
    check_on_plate("a mass", [(x, y) for x, y, _ in change.masses], rig.plate)
    return replace(
        first,
        modulus=first.modulus * change.modulus,
        stiffness=stiffness,
        masses=(*first.masses, *(PointLoad(x, y, mass=mass) for x, y, mass in change.masses)),
    )


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
