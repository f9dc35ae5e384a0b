"""Control operations on fingers."""

import asyncio
from collections.abc import Collection, Mapping

from model.errors import InputError
from sim.control.context import SimulationContext
from sim.control.values import (
    Operation,
    Request,
    Response,
    parse_finger,
    parse_number,
    parse_position,
    parse_window,
)
from sim.plant.felt import measure_vibration
from sim.plant.fingers import Position

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


OPERATIONS: Mapping[str, Operation] = {
    "fingers": _fingers,
    "touch": _touch_or_move,
    "move": _touch_or_move,
    "lift": _lift,
    "felt": _felt,
}
