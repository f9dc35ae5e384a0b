"""Control operation on the plate: how it changes while the simulation runs."""

from collections.abc import Mapping
from dataclasses import replace

from model.errors import InputError
from model.structure.attachments import PointLoad
from sim.control.context import SimulationContext
from sim.control.values import Operation, Request, Response, is_number, parse_number
from sim.plant.imperfections import PlateErrors

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


OPERATIONS: Mapping[str, Operation] = {"plate": _plate}
