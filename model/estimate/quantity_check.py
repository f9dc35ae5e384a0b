"""Checks of the quantity, the unit and the sign of phases of measured responses.

Responses must be acceleration per base displacement, with phases for exp(+i omega t). Gains absorb
another quantity or unit in a fit, so they are checked before it: all channels together differ from
the prediction by the same factor and power of i omega.
"""

from typing import NamedTuple

import numpy as np

from model.arrays import ComplexArray, best_by
from model.errors import InputError
from model.estimate.gains import gains_of, row_rms
from model.estimate.plate_match import MIN_COST_REDUCTION, best_wiring
from model.estimate.sensed_plate import SensedPlate
from model.estimate.shape_match import ShapeMatch
from model.structure.statics import GRAVITY

_MAX_GAIN = 3.0  # of all channels together; a factor either way is another quantity or unit


class _Quantity(NamedTuple):
    """Quantity that responses can be by mistake: factor * (i omega)^power times the right one."""

    name: str
    remedy: str
    factor: float
    power: int = 0


_RIGHT_QUANTITY = _Quantity("acceleration per displacement", "", 1.0)
_WRONG_QUANTITIES = (
    _Quantity("g", f"multiply by {GRAVITY}", 1 / GRAVITY),
    _Quantity("mm/s² per m", "divide by 1000", 1e3),
    _Quantity("m/s² per mm", "multiply by 1000", 1e-3),
    _Quantity("m/s² per µm", "multiply by 1000000", 1e-6),
    _Quantity("g per mm", f"multiply by {1000 * GRAVITY}", 1e-3 / GRAVITY),
    _Quantity("g per µm", f"multiply by {1e6 * GRAVITY}", 1e-6 / GRAVITY),
    _Quantity("velocity in m/s", "multiply by i omega, 2 pi times the frequency", 1.0, -1),
    _Quantity("velocity in mm/s", "multiply by i omega / 1000", 1e3, -1),
    _Quantity("displacement in m", "multiply by -omega², omega 2 pi times the frequency", 1.0, -2),
    _Quantity("displacement in mm", "multiply by -omega² / 1000", 1e3, -2),
    _Quantity("displacement in µm", "multiply by -omega² / 1000000", 1e6, -2),
)


def check_quantity(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> None:
    """Raise InputError if the gains of all channels indicate another quantity or unit."""
    model = plate.responses(plate.start(*shapes.start))[..., shapes.nearest]
    gains = gains_of(model, values)
    sizes = np.log(row_rms(values) / row_rms(model))[:, 0]
    is_driven = np.isfinite(gains)
    omega = plate.omega[:, None]

    def distance(quantity: _Quantity) -> float:
        """Return the distance of gains from the gains of a quantity, in size and phase."""
        expected = quantity.factor * (1j * omega) ** quantity.power
        size_error = np.abs(sizes - np.log(np.abs(expected)))[is_driven]
        phase_error = np.angle(gains / expected)[is_driven]
        return float(np.median(size_error) + 1 - np.median(np.cos(phase_error)))

    level = float(np.median(sizes[is_driven]))
    nearest = best_by(_WRONG_QUANTITIES, lambda quantity: -distance(quantity))
    gap = distance(nearest)
    if abs(level) < np.log(_MAX_GAIN) or distance(_RIGHT_QUANTITY) < gap:
        return
    ratio = f"{np.exp(level):.3g} times the prediction"
    if gap < np.log(_MAX_GAIN):
        raise InputError(
            "responses must be acceleration per base displacement in 1/s²; values appear to be in "
            f"{nearest.name}: all are {ratio}; {nearest.remedy}"
        )
    raise InputError(
        f"responses must match the rig within a factor of {_MAX_GAIN:g}, got {ratio}; check their "
        "unit and the stroke of the ERAs"
    )


def check_phases(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> None:
    """Raise InputError for conjugated phases."""
    match = best_wiring(plate, values, shapes)
    conjugate = best_wiring(plate, values.conj(), shapes)
    if conjugate.fit.cost < match.fit.cost - MIN_COST_REDUCTION:
        raise InputError(
            "phases must be for exp(+i omega t), but appear to be conjugated: with the signs of "
            "all imaginary parts changed, the model fits better "
            f"({100 * conjugate.error:.1f} % unexplained instead of {100 * match.error:.1f} %); "
            "change the signs"
        )
