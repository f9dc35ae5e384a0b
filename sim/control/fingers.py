"""Operations of control on fingers: where they rest, and what they felt."""

from collections.abc import Mapping, Sequence
from typing import Any

from model.errors import InputError
from sim.control.answers import Answer, Operation, already
from sim.control.context import SimulationContext
from sim.control.values import finger_of, place_of, window_of
from sim.plant.felt import feel
from sim.plant.finger import Position, Record


def _fingers(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    fingers = request.get("fingers")
    if not isinstance(fingers, dict):
        raise InputError('fingers must be an object of positions, as in {"1": [0.10, 0.08]}')
    places = {
        name: place_of(place, what=f"finger {name[:40]!r}") for name, place in fingers.items()
    }
    return _placed(context, places, now)


def _come(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    name, present = finger_of(request), context.bench.fingers.layout.positions
    if (name in present) != (request["op"] == "move"):
        there = "is on the plate already" if name in present else "is not on the plate"
        raise InputError(f"finger {name!r} {there}")
    at = place_of(request.get("at_m"), what=f"finger {name!r}")
    return _placed(context, {**present, name: at}, now)


def _go(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    name, present = finger_of(request), context.bench.fingers.layout.positions
    if name not in present:
        raise InputError(f"finger {name!r} is not on the plate")
    return _placed(context, {id: at for id, at in present.items() if id != name}, now)


def _placed(context: SimulationContext, places: Mapping[str, Position], now: float) -> Answer:
    context.bench.place_fingers(places, now=now)
    return already({"ok": True, "time_s": context.bench.time})


def _felt(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    since, until = window_of(request)
    context.bench.advance(now)
    records, frequencies = context.bench.records(since, until)
    return lambda: {"fingers": {id: _as_felt(rec, frequencies) for id, rec in records.items()}}


def _as_felt(record: Record, frequencies: Sequence[float]) -> dict[str, Any]:
    felt = feel(record, frequencies)
    return {
        "points_m": felt.points.tolist(),
        "frequencies_hz": list(felt.frequencies),
        "amplitude_m_s2": felt.amplitude.tolist(),
        "peak_m_s2": felt.peak.tolist(),
    }


OPERATIONS: Mapping[str, Operation] = {
    "fingers": _fingers,
    "come": _come,
    "move": _come,
    "go": _go,
    "felt": _felt,
}
