"""Identification of a rig by responses measured in place."""

import math
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.identification.advice import unknowns
from model.identification.grain import fit_board
from model.identification.held_out import SHARE, HeldOutPaths, hold_out
from model.identification.measurement import Measurement
from model.identification.parameters import Space
from model.identification.posterior import Posterior
from model.identification.stages import FittedModel, Setting, chi2
from model.identification.values import Values, rig_with
from model.processes import Progress, unseen
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.meshes import mesh_of
from model.rig.rig import Rig
from model.spectral.mesh import PlateMesh, SpectralMesh
from model.structure.modal_elasticity import check_measurable

MAX_CHI2 = 2.0
"""chi² beyond which a model does not explain a measurement, and nothing is promised from it."""

MAX_MODE_SHIFT = 2.0
"""Root mean square of the shifts of the lowest modes, in standard deviations, beyond which a
measurement tells too little of a plate: its fields are others, whatever its sensors hear."""

# How far a drive repeats from one day to the next, which no measurement tells.
_DRIVE_GAIN, _DRIVE_PHASE_DEG = 0.01, 1.0

_LEAST_VALUES = 16
_GAIN_STDS = 5.0
_LEAST_GAIN, _LEAST_PHASE = 0.3, math.radians(20)  # what gains are allowed at least


@dataclass(frozen=True, eq=False)
class Identification:
    """A rig as its responses show it.

    before: the rig as written; rig: with identified values and, where the model explains the
    measurement, their uncertainty; values: of the parameters, gains of sensors among them;
    posterior: their distribution, wider by what paths disagree in; chi2: squared residuals per
    value; mode_shift: rms by which the lowest modes had to shift, in standard deviations; held_out:
    how well unseen paths are predicted, None where there are too few; seed: of the contacts that a
    promise draws.
    """

    before: Rig
    rig: Rig
    values: Values
    posterior: Posterior
    chi2: float
    mode_shift: float
    held_out: HeldOutPaths | None
    fitted: FittedModel
    seed: int

    @property
    def is_explained(self) -> bool:
        """Whether the model explains the measurement, so that answers may rely on it."""
        return self.chi2 <= MAX_CHI2 and self.is_known_well

    @property
    def is_known_well(self) -> bool:
        """Whether modes are those of the rig's plate, so that fields between sensors are, too."""
        return self.mode_shift <= MAX_MODE_SHIFT


def identify(
    rig: Rig, measurement: Measurement, *, seed: int = 0, progress: Progress = unseen
) -> Identification:
    """Identify a rig by a measurement on it; the same for the same data and seed.

    progress: called with the fits done and all, one of everything and one of each held-out share.
    Raises InputError for a rig with a part that does not scale, for a plate that was not linear or
    has changed during the measurement, for gains that no drive or sensor has (another unit, a wrong
    sign), and where it leaves unknown what answers depend on, with the tone and the sensor that
    would show it.
    """
    _check(rig, measurement)
    before, free = rig, solved_for(rig, float(measurement.frequencies[-1]))
    setting, fitted = fit_board(Setting(rig, free, measurement))
    rig = setting.rig
    values = Values.of(rig, fitted.space, fitted.best.x)
    posterior, shift = Posterior.of(fitted.space, fitted.best), _mode_shift(fitted)
    found = Identification(
        *(before, rig, values, posterior, chi2(fitted), shift, None, fitted, seed)
    )
    if found.is_explained:
        _check_gains(rig, measurement, values, fitted.space)
    unknown = unknowns(setting, fitted, posterior)
    if unknown:
        raise InputError("measurement must show more: " + "; ".join(map(str, unknown)))
    held_out, uncertainty = hold_out(fitted, progress=progress), rig.uncertainty
    if found.is_explained:
        uncertainty = posterior.uncertainty(
            uncertainty,
            gain=_DRIVE_GAIN,
            phase_deg=_DRIVE_PHASE_DEG,
            field=held_out.unexplained if held_out else 0.0,
        )
    if held_out:
        covariance = posterior.covariance + held_out.disagreement
        posterior = replace(posterior, covariance=covariance)
    progress(1 + SHARE, 1 + SHARE)
    known = rig_with(rig, values, uncertainty)
    return replace(found, rig=known, posterior=posterior, held_out=held_out)


def _mode_shift(fitted: FittedModel) -> float:
    """Root mean square of the shifts of modes in standard deviations, 0 without any."""
    shifts = fitted.best.x[fitted.space.of("mode_shifts")]
    return float(np.sqrt((shifts**2).mean())) if len(shifts) else 0.0


def _check(rig: Rig, measurement: Measurement) -> None:
    check_measurable(rig.plate)  # what is left uncertain of modes is written as thickness
    names = [era.name for era in rig.eras]
    for sensor in measurement.sensors:
        if sensor.era and sensor.era not in names:
            raise InputError(
                f"sensor {sensor.name} must be at one of {', '.join(names)}, got {sensor.era}"
            )
        if not sensor.era and not rig.plate.contains(sensor.x, sensor.y):
            raise InputError(
                f"sensor {sensor.name} must be on the plate, got ({sensor.x:g}, {sensor.y:g}) m"
            )
    if measurement.count < _LEAST_VALUES:
        raise InputError(
            f"a measurement must have at least {_LEAST_VALUES} values, got {measurement.count}; "
            "play more tones"
        )
    limits, tones = rig.limits, measurement.frequencies
    if tones[0] < limits.frequency_min or tones[-1] > limits.frequency_max:
        raise InputError(
            "tones must be within the rig's limits.frequency of "
            f"{limits.frequency_min:g} to {limits.frequency_max:g} Hz, got {tones[0]:g} to "
            f"{tones[-1]:g} Hz"
        )
    measurement.check()


def solved_for(rig: Rig, frequency_max: float) -> FreePlate:
    """The free plate of a rig, solved for tones up to a frequency [Hz]."""
    mesh: PlateMesh = rig.mesh
    if not isinstance(mesh, SpectralMesh):
        # Places move freely only where a plate is solved in functions over all of it.
        mesh = mesh_of("auto", rig.plate, frequency_max=rig.limits.frequency_max)
    return solve_free_plate(rig.plate, mesh, frequency_max=max(frequency_max, 200.0))


def _check_gains(rig: Rig, measurement: Measurement, values: Values, space: Space) -> None:
    """Raise InputError for gains no drive or sensor has: another unit, a sign, a wrong plug.

    A response tells only the product of a drive's and a sensor's gain, so that the fit shares an
    error of either among both, and its residuals do not show a wrong unit or sign.
    """
    drives = [f"drive {era.name}" for era in rig.eras]
    sensors = [f"sensor {sensor.name}" for sensor in measurement.sensors]
    wrong = [
        *_wrong_gains(drives, np.log(values.drive_gains), space, ""),
        *_wrong_gains(sensors, np.log(values.sensor_gains), space, "sensor_"),
    ]
    if wrong:
        raise InputError(
            "measurement must be acceleration in m/s² along the drives' motion, got gains of "
            f"{'; '.join(wrong)}; check unit, sign and plug of each sensor and drive"
        )


def _wrong_gains(names: list[str], logarithms: FloatArray, space: Space, whose: str) -> list[str]:
    """Those whose complex logarithm of the gain is beyond what is usual, in words."""
    gain, phase = (space.std[space.groups[whose + kind]].max() for kind in ("gain", "phase"))
    return [
        f"{name} {math.exp(one.real):.2f} at {math.degrees(one.imag):.0f}°"
        for name, one in zip(names, logarithms.tolist(), strict=True)
        if abs(one.real) > max(_LEAST_GAIN, _GAIN_STDS * gain)
        or abs(one.imag) > max(_LEAST_PHASE, _GAIN_STDS * phase)
    ]
