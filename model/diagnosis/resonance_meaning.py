"""Which resonance the file of exciters gives: of the light coil alone, or of the glued magnet.

An exciter pushes a plate against its magnet: well above the resonance of that on the glued coil by
its whole force, far below it hardly, and with the opposite sign. A file that takes a sheet's
`free` resonance for the `mounted` one thus describes exciters of which all look reversed, and weak
by another factor at each frequency. With both meanings the plate is fitted as coarsely as for its
grain (`model.diagnosis.assignment.match_shapes`); of twelve boards as bought the gains that are
left vary over frequency by 0.15 to 0.43 (standard deviation of their logarithms) with the right
one, and by 1.2 or more with the other.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model.calibration.fit import SensedPlate, plate_of, project_gains, row_rms
from model.calibration.responses import Responses
from model.diagnosis.assignment import ShapeMatch, match_shapes
from model.rig.exciter_checks import exciters_of, sections_of
from model.rig.rig import Rig

_OTHER = {"free": "mounted", "mounted": "free"}
_VARYING = 0.8  # standard deviation of logarithms of gains, as no drive has it
_CLEARLY = 0.5  # of that as written


@dataclass(frozen=True)
class MisreadResonance:
    """Exciters whose resonance in the rig is the other one.

    rig: with the right ones; meant, as_written: `free` and `mounted`, by exciter; frequency: of the
    glued magnet [Hz] by exciter; variation, variation_as_written: of gains over frequency, standard
    deviations of their logarithms.
    """

    rig: Rig
    meant: Mapping[str, str]
    frequency: Mapping[str, float]
    variation: float
    variation_as_written: float

    label = "RESONANCE"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        (meant, *_), (glued, *_) = self.meant.values(), self.frequency.values()
        names = ", ".join(self.meant)
        return (
            f"resonance_is of {names} must be {meant}, got {_OTHER[meant]}: with it {meant} a "
            f"glued magnet resonates at {glued:.0f} Hz, and gains vary by a factor of "
            f"{math.exp(self.variation):.2g} over frequency, as written by "
            f"{math.exp(self.variation_as_written):.2g}; correct the rig"
        )


def misread_resonance(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> MisreadResonance | None:
    """Find exciters with the other meaning of their resonances where that is clearly the measured.

    shapes: of the observation, by the rig's plate. None without a resonance in the file.
    """
    rig = plate.rig
    as_written = {
        name: str(section.values["resonance_is"])
        for name, section in sections_of(rig).items()
        if not section.stiffness
    }
    if not as_written:
        return None
    variation_as_written = _variation(plate, shapes, observation)
    if not variation_as_written > _VARYING:
        return None
    for which in dict.fromkeys(as_written.values()):
        meant = {name: _OTHER[which] for name, own in as_written.items() if own == which}
        other = rig.replaced(eras={name: {"resonance_is": each} for name, each in meant.items()})
        sensed = plate_of(other, observation)
        found = _variation(sensed, match_shapes(sensed, observation.values), observation)
        if found < _CLEARLY * variation_as_written:
            glued = {e.name: e.magnet_frequency for e in exciters_of(other) if e.name in meant}
            return MisreadResonance(other, meant, glued, found, variation_as_written)
    return None


def _variation(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> float:
    """Standard deviation over frequency of the logarithm of gains, the median channel's."""
    model = plate.responses(plate.moved(*shapes.start))[:, list(shapes.nearest)]
    values = observation.values
    weight = np.isfinite(values) / row_rms(values)[:, :, None]
    gains, _ = project_gains(model, values, weight)
    driven = np.isfinite(gains).sum(axis=0) > 1
    with np.errstate(divide="ignore"):
        sizes = np.log(np.abs(gains[:, driven]))
    return float(np.median(np.nanstd(sizes, axis=0))) if driven.any() else 0.0
