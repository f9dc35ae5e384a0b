"""A rig with identified values: what its parameters say, and the text of its file with them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.identification.values import Values
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import Era, Gain, PointLoad
from model.structure.plate import LOSS_FREQUENCY, Plate

_LEAST_MASS = 1e-5  # kg; less is none
_GAIN_STEP = 10.0  # Hz, of a drive that lags; linear between them is right to a thousandth


def plate_with(plate: Plate, values: Values) -> Plate:
    """The plate with identified thickness, modulus, losses and modes."""
    count = max(len(plate.mode_deviations), len(values.mode_shifts))
    deviations = np.zeros((count, 2))
    deviations[: len(plate.mode_deviations)] = np.reshape(plate.mode_deviations, (-1, 2))
    deviations[: len(values.mode_shifts)] += np.column_stack(
        [values.mode_shifts, values.mode_losses]
    )
    return replace(
        plate.scaled(modulus=values.modulus, thickness=values.thickness),
        loss_factor=max(values.loss_factor, 0.0),
        loss_exponent=values.loss_exponent,
        mode_deviations=tuple((float(a), float(b)) for a, b in deviations if len(deviations)),
    )


def rig_with(rig: Rig, values: Values, uncertainty: Uncertainty) -> Rig:
    """The rig with identified values; additional masses come after its own."""
    places = np.clip(values.places, 0, [rig.plate.length, rig.plate.width])
    eras = tuple(
        replace(
            era,
            x=float(places[number, 0]),
            y=float(places[number, 1]),
            stiffness=float(values.stiffness[number]),
            damping=float(max(values.damping[number], 0.0)),
            bolt_mass=float(max(values.bolt_mass[number], 0.0)),
            gains=_gains(era, rig, values, number),
        )
        for number, era in enumerate(rig.eras)
    )
    return replace(
        rig,
        plate=plate_with(rig.plate, values),
        laminate=rig.laminate
        and rig.laminate.scaled(modulus=values.modulus, thickness=values.thickness),
        eras=eras,
        masses=(*rig.masses, *additional_masses(values)),
        uncertainty=uncertainty,
    )


def additional_masses(values: Values) -> Sequence[PointLoad]:
    """The masses that were found on the plate, without those that weigh nothing."""
    return [
        PointLoad(float(x), float(y), mass=float(mass))
        for mass, x, y in values.masses
        if mass > _LEAST_MASS
    ]


def _gains(era: Era, rig: Rig, values: Values, number: int) -> tuple[Gain, ...]:
    """Measured gains times what was identified; of an ERA without any at one frequency.

    Over the rig's frequencies where the drive lags.
    """
    if values.drive_gains[number] == 1 and not (values.inertia[number] or values.drag[number]):
        return era.gains
    before = era.gains or ((LOSS_FREQUENCY, 1.0, 0.0),)
    if values.inertia[number] or values.drag[number]:
        low, high = rig.limits.frequency_min, rig.limits.frequency_max
        count = 1 + int(np.ceil((high - low) / _GAIN_STEP))
        before = tuple((float(f), 1.0, 0.0) for f in np.linspace(low, high, count))
    factors = values.drive_gains[number] * values.lag(np.array([f for f, *_ in before]))[:, number]
    return tuple(
        (f, magnitude * float(abs(factor)), turned + float(np.angle(factor)))
        for (f, magnitude, turned), factor in zip(before, factors.tolist(), strict=True)
    )
