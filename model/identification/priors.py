"""How far each parameter of a rig may be from its file before anything was measured."""

import math
from dataclasses import dataclass
from typing import Self

from model.rig.uncertainty import Uncertainty

_MODULUS = 0.02
_DAMPING_EACH = 0.2
_LOSS_EXPONENT = 0.3
_SENSOR_GAIN, _SENSOR_PHASE = 0.05, math.radians(5)
_BOLT_MASS = 0.5e-3
_PLACE = 1.5e-3
_MASS = 2e-3
_MODE_SHIFT, _MODE_LOSS = 0.01, 0.5
_FINGER = 0.5
_INERTIA, _DRAG = 1 / 0.7**2, 1 / 0.7  # of a resonance at 700 Hz with a damping ratio of 0.5


@dataclass(frozen=True)
class Priors:
    """Standard deviations of the parameters, 0 of one that is known.

    Of logarithms: thickness, modulus, stiffness, gain, sensor_gain; damping, of all ERAs, and
    damping_each, of one beside that; loss, of the plate; mode_shift, of an eigenvalue omega²;
    mode_loss, of the loss factor of a mode; finger, of each group of a finger's load.
    loss_exponent: of the loss factor's power of frequency; phase, sensor_phase [rad]; bolt_mass,
    mass [kg]; place [m]: of an ERA, on each axis; mass_place: of a mass, relative to the sides of
    the plate. inertia [1/kHz²], drag [1/kHz]: of a drive (`Values.lag`).
    """

    thickness: float
    modulus: float
    stiffness: float
    damping: float
    damping_each: float
    loss: float
    loss_exponent: float
    gain: float
    phase: float
    sensor_gain: float
    sensor_phase: float
    bolt_mass: float
    place: float
    mass: float
    mass_place: float
    mode_shift: float
    mode_loss: float
    finger: float
    inertia: float = 0.0
    drag: float = 0.0

    @classmethod
    def of(cls, uncertainty: Uncertainty, *, drives_lag: bool = False) -> Self:
        """Those that a rig states, and usual ones of all that it does not state.

        A modulus is known where the thickness is, the damping of each ERA where that of all is.
        drives_lag: whether bases follow what is played with a lag that nothing states.
        """
        damping = math.log(uncertainty.damping)
        return cls(
            thickness=uncertainty.thickness,
            modulus=_MODULUS if uncertainty.thickness else 0.0,
            stiffness=uncertainty.stiffness,
            damping=damping,
            damping_each=_DAMPING_EACH if damping else 0.0,
            loss=damping,
            loss_exponent=_LOSS_EXPONENT if damping else 0.0,
            gain=uncertainty.gain,
            phase=math.radians(uncertainty.phase_deg),
            sensor_gain=_SENSOR_GAIN,
            sensor_phase=_SENSOR_PHASE,
            bolt_mass=_BOLT_MASS,
            place=_PLACE,
            mass=_MASS,
            mass_place=1 / 3,
            mode_shift=_MODE_SHIFT,
            mode_loss=_MODE_LOSS if damping else 0.0,
            finger=_FINGER,
            inertia=_INERTIA if drives_lag else 0.0,
            drag=_DRAG if drives_lag else 0.0,
        )
