"""Loads on a plate that fits its rig: masses and fingers, next to form errors."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from model.arrays import best_by
from model.estimate.plate_match import Match, match_plate
from model.estimate.sensed_plate import plate_of
from model.finger import Grid
from model.structure.attachments import PointLoad
from model.structure.fingertips import Fingertip, FingertipLoad

Load: TypeAlias = PointLoad | FingertipLoad
"""Load that can lie on a plate."""

# Noise of a fit with form errors, relative to a row's RMS. The error of a first fit is the noise of
# the second, within bounds. The noise is less than `MODEL_ERROR`, which includes form errors.
_FIRST_NOISE = 0.02
_MIN_NOISE, _MAX_NOISE = 0.01, 0.05

_LOAD_GRID = Grid(32, 24)
"""Cells whose centers are the possible positions of loads."""

_MAX_LOADS = 2
"""Maximum number of loads, found one after the other."""

_LIGHT, _FIRM = 0.3, 3.0
"""Least and largest load of a finger, in fingertips; a lighter one is no finger."""

_CLEAR_LOAD = 40.0
"""Reduction of half the sum of squares that proves a load: more than for another wiring, since the
best of many positions explains some of the noise."""


def match_with_form(match: Match) -> tuple[Match, list[Load]]:
    """Fit form errors to the values of a match, and find loads on the plate.

    Form errors explain inaccurate cutting and positioning, but not a single mass near an edge.
    """
    first = _match_loads(match, [], _FIRST_NOISE)
    noise = float(np.clip(first.error, _MIN_NOISE, _MAX_NOISE))
    best = _match_loads(match, [], noise)
    loads: list[Load] = []
    while len(loads) < _MAX_LOADS:
        candidates = []
        for load in _load_candidates(best):
            candidates.append((load, _match_loads(match, [*loads, load], noise)))
        if not candidates:
            break
        load, loaded = best_by(candidates, lambda candidate: -candidate[1].fit.cost)
        if loaded.fit.cost > best.fit.cost - _CLEAR_LOAD:
            break
        best = loaded
        loads.append(load)
    return best, loads


def _match_loads(match: Match, loads: Sequence[Load], noise: float) -> Match:
    """Match a plate with form errors and loads; noise: relative to a row's RMS."""
    rig = match.plate.rig
    rig = replace(rig, masses=(*rig.masses, *loads))  # type: ignore[arg-type]
    plate = plate_of(rig, match.fit.measurement, has_form=True)
    return match_plate(plate, match.values, drives=match.drives, model_error=noise)


def _load_candidates(match: Match) -> list[Load]:
    """Return a mass and a finger at the positions where each would explain most."""
    rig = match.plate.rig
    linear = match.linearized()
    points = _LOAD_GRID.centers(rig.plate)
    loads: list[Load] = []
    for number, mass in linear.loads(points, std=rig.plate.mass)[:1]:
        x, y = points[number].tolist()
        loads.append(PointLoad(x, y, mass=mass))
    tip = rig.fingertip or Fingertip()
    omega = match.plate.omega
    mass_of_tip = -tip.dynamic_stiffness(omega) / omega**2
    for number, size in linear.loads(points, factor=mass_of_tip)[:1]:
        if size >= _LIGHT:
            x, y = points[number].tolist()
            loads.append(FingertipLoad(x, y, tip.multiplied(min(size, _FIRM))))
    return loads
