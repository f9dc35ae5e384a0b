"""Parameter spaces of rigs, and rigs with fitted values.

A space lists all parameters of an installed rig (`space_of`), or of a rig described only by data
sheets (`space_from_datasheets`). `rig_with` writes fitted values to a rig.
`model.estimate.parameters` defines the kinds of parameters.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.estimate.parameter_space import MODE_SHIFTS, PlateValues, SearchScope, Space
from model.estimate.parameters import PARAMETER_KINDS
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import PointLoad
from model.structure.exciter import Actuator
from model.structure.plate import LOSS_FREQUENCY, Plate
from model.structure.sources import Gain

_AT_EDGE = 1e-6  # m
_MIN_MASS = 1e-5  # kg; a lighter one is not written to a rig
_GAIN_STEP = 10.0  # Hz, for a drive with lag; linear interpolation is then accurate to 0.1 %


def space_of(
    rig: Rig,
    sensors: Sequence[str],
    uncertainty: Uncertainty,
    *,
    drives_lag: bool = False,
    masses: int = 0,
    mode_count: int = MODE_SHIFTS,
) -> Space:
    """Return the parameters of an installed rig; `SearchScope` explains the arguments.

    `common_gain` is not a parameter: if it was measured with the same sensors, they cannot show its
    error.
    """
    scope = SearchScope(rig, sensors, uncertainty, drives_lag, masses, mode_count)
    return Space.from_kinds(PARAMETER_KINDS, scope)


def space_from_datasheets(rig: Rig, sensors: Sequence[str], form_modes: int | None) -> Space:
    """Return the parameters of a rig described only by data sheets.

    form_modes: number of modes that can shift on a plate with form errors, None for a plate without
    form errors.
    """
    scope = SearchScope(
        rig,
        sensors,
        Uncertainty.none(),
        mode_count=form_modes or 0,
        form_of=None if form_modes is None else len(sensors),
    )
    return Space.from_kinds(PARAMETER_KINDS, scope, from_datasheets=True)


def inwards(space: Space, x: FloatArray, *, by: float) -> FloatArray:
    """Move positions in x (p,) that are on an edge of the plate inwards; by: relative to the prior.

    On an edge a position can vary in one direction only, so a start there would cover only half of
    its neighborhood.
    """
    moved = x.copy()
    for number in space.indices("place"):
        from_lower = space.std[number] * (x[number] - space.lower[number])
        from_upper = space.std[number] * (space.upper[number] - x[number])
        if from_lower < _AT_EDGE:
            moved[number] += by
        elif from_upper < _AT_EDGE:
            moved[number] -= by
    return np.where(space.uncertain, moved, x)


def rig_with(rig: Rig, values: PlateValues, uncertainty: Uncertainty) -> Rig:
    """Return the rig with identified values; additional masses follow its own."""
    thickness, modulus = values["thickness"], values["modulus"]
    laminate = rig.laminate
    if laminate is not None:
        laminate = laminate.scaled(modulus=modulus, thickness=thickness)
    return replace(
        rig,
        plate=plate_with(rig.plate, values),
        laminate=laminate,
        eras=_eras_with(rig, values),
        masses=_masses_with(rig, values),
        uncertainty=uncertainty,
    )


def _eras_with(rig: Rig, values: PlateValues) -> tuple[Actuator, ...]:
    """The rig's ERAs with identified values, gains and positions, which stay on the plate."""
    positions = np.clip(values["place"], 0, [rig.plate.length, rig.plate.width]).tolist()
    eras = []
    for number, era in enumerate(values.sources()):
        x, y = positions[number]
        eras.append(replace(era, x=x, y=y, gains=_gains(rig, values, number)))
    return tuple(eras)


def _masses_with(rig: Rig, values: PlateValues) -> tuple[PointLoad, ...]:
    """The rig's masses with identified stiffness of its feet, then the additional masses."""
    masses = list(rig.masses)
    for foot, factor in zip(rig.feet, values["supports"].tolist(), strict=True):
        masses[foot] = replace(masses[foot], stiffness=factor * masses[foot].stiffness)
    for mass, x, y in values["masses"].tolist():
        if mass > _MIN_MASS:
            masses.append(PointLoad(x, y, mass=mass))
    return tuple(masses)


def plate_with(plate: Plate, values: PlateValues) -> Plate:
    """The plate with identified thickness, modulus, losses and modes."""
    shifted = np.column_stack([values["mode_shifts"], values["mode_losses"]])
    count = max(len(plate.mode_deviations), len(shifted))
    deviations = np.zeros((count, 2))
    deviations[: len(plate.mode_deviations)] = np.reshape(plate.mode_deviations, (-1, 2))
    deviations[: len(shifted)] += shifted
    return replace(
        plate.scaled(modulus=values["modulus"], thickness=values["thickness"]),
        loss_factor=values["loss"],
        loss_exponent=values["loss_exponent"],
        mode_deviations=tuple((float(a), float(b)) for a, b in deviations if deviations.any()),
    )


def _gains(rig: Rig, values: PlateValues, number: int) -> tuple[Gain, ...]:
    """Return gains of an ERA: the rig's, multiplied by the identified gain and lag of its drive.

    An ERA whose drive lags gets gains over the rig's frequencies; one without measured gains and
    lag gets a single gain.
    """
    era, identified_gain = rig.eras[number], values["gain"][number]
    drive_lags = bool(values["inertia"][number] or values["drag"][number])
    if identified_gain == 1 and not drive_lags:
        return era.gains
    gains = era.gains or ((LOSS_FREQUENCY, 1.0, 0.0),)
    if drive_lags:
        gains = _gains_over(era, rig.limits.frequency_min, rig.limits.frequency_max)
    frequencies = np.array([frequency for frequency, _, _ in gains])
    factors = identified_gain * values.lag(frequencies)[:, number]
    return tuple(
        (frequency, magnitude * abs(factor), phase + float(np.angle(factor)))
        for (frequency, magnitude, phase), factor in zip(gains, factors.tolist(), strict=True)
    )


def _gains_over(era: Actuator, lowest: float, highest: float) -> tuple[Gain, ...]:
    """Return an ERA's gains at frequencies [Hz] close enough for linear interpolation of a lag."""
    count = 1 + math.ceil((highest - lowest) / _GAIN_STEP)
    frequencies = np.linspace(lowest, highest, count)
    gains = era.gain(frequencies)
    rows = zip(frequencies.tolist(), np.abs(gains).tolist(), np.angle(gains).tolist(), strict=True)
    return tuple(rows)
