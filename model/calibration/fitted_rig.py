"""The rig of a fit: what a rig file can express of it, and how well it is then known."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import ComplexArray, FloatArray
from model.calibration.calibration_result import FittedParameter, HeldOutSensors, MovedEra
from model.calibration.fit import CalibrationProblem, Fit, clear
from model.calibration.sensed_plate import Parameter, sensed_plate
from model.calibration.variable_projection import project_gains, row_rms
from model.identification.form_errors import MASS_CELLS
from model.identification.parameters import KINDS
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import Gain

_LEAST = 1e-4  # of an uncertainty; no fit is exact

# Relative error of values by idealisations of the model, of any but the loss factor, and of that:
# what form errors leave unexplained widens resonances by 0.4 % (root mean square over plates
# without noise).
_MODEL_ERROR, _LOSS_ERROR = 2e-3, 4e-3
_FOREIGN_MASS = KINDS["foreign_mass"].std * math.sqrt(MASS_CELLS.cell_count)  # of the plate's


def rig_of_fit(problem: CalibrationProblem, fit: Fit, z: FloatArray) -> Rig:
    """Rig of a fit without form errors, z (p,); ERAs where they clearly are, gains unchanged."""
    rig = problem.plate.rig_at(z)
    moves = {moved.name: moved.after for moved in moved_eras(problem, fit)}
    eras = tuple(
        replace(era, x=moves[era.name][0], y=moves[era.name][1]) if era.name in moves else era
        for era in rig.eras
    )
    return replace(rig, eras=eras)


def moved_eras(problem: CalibrationProblem, fit: Fit) -> tuple[MovedEra, ...]:
    """List the ERAs that are off their places by several standard errors."""
    rig, space, found = problem.plate.rig, problem.plate.model.space, []
    sides = np.array([rig.plate.length, rig.plate.width])
    off = np.where(clear(fit), fit.z, 0.0)
    places, errors = (space.values(x, "place").reshape(-1, 2) for x in (off, fit.error))
    for era, place, error in zip(rig.eras, places, errors, strict=True):
        at = np.clip(np.array([era.x, era.y]) + place, 0, sides)
        if np.abs(at - [era.x, era.y]).max() > 0:
            found.append(
                MovedEra(
                    era.name,
                    (era.x, era.y),
                    (float(at[0]), float(at[1])),
                    (float(error[0]), float(error[1])),
                )
            )
    return tuple(found)


def place_error(problem: CalibrationProblem, fit: Fit, before: float) -> float:
    """Root mean square of what the rig of a fit has places of ERAs off by, along a side [m].

    About the place that it keeps where the fit does not clearly have another one; before: of places
    that the data determine less than their prior does.
    """
    space = problem.plate.model.space
    kept, error = (space.values(x, "place") for x in (np.where(clear(fit), 0.0, fit.z), fit.error))
    by_data = error < math.sqrt(0.5) * KINDS["place"].std
    of_each = np.where(by_data, np.hypot(np.hypot(kept, error), KINDS["place"].theory), before)
    return _rms(of_each)


def predicted_by(
    rig: Rig, problem: CalibrationProblem, points: FloatArray, fit: Fit
) -> tuple[ComplexArray, ComplexArray]:
    """Responses (f, e, s) of a rig at points (s, 2) [m], and its gains (f, e) that fit best."""
    known = problem.plate
    model = sensed_plate(rig, points, known.model.frequencies, masses=known.masses).responses()
    weight = fit.used / fit.noise[:, :, None]
    gains, _ = project_gains(model * problem.scales(fit.z), problem.values, weight)
    return model, gains


def lacking_of(problem: CalibrationProblem, fit: Fit, z: FloatArray) -> FloatArray:
    """What responses lack of a fit's without its form errors, z (p,), relative, (f, e).

    But with its ERAs, whose places a rig states the errors of.
    """
    at_places = np.where(problem.plate.model.space.of("place"), fit.z, z)
    model = problem.plate.responses(at_places)
    gains, _ = project_gains(model, problem.values, fit.used / fit.noise[:, :, None])
    predicted = gains[:, :, None] * model
    squares = np.where(fit.used, np.abs(predicted - fit.predicted) ** 2, np.nan)
    size = row_rms(fit.predicted, fit.used)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.nansum(squares, axis=2) / fit.used.sum(axis=2)
    return np.asarray(np.sqrt(shares) / size)


def gain_rows(gains: ComplexArray, frequencies: FloatArray) -> tuple[Gain, ...]:
    """Rows of known gains (f,) for a rig."""
    known = np.isfinite(gains) & (gains != 0)
    return tuple(
        (float(f), float(abs(gain)), float(np.angle(gain)))
        for f, gain in zip(frequencies[known], gains[known], strict=True)
    )


def standard_error(
    rig: Rig, parameter: Parameter, value: float, error: float, dampers: float
) -> float:
    """Standard error of a value by that of a fit, by the model's, and of the mass it goes by.

    dampers: what they do to the responses relative to what the plate's own losses do, by which an
    error of the model in the former looks like one of the latter.
    """
    share = math.hypot(_MODEL_ERROR, _mass_scale_error(rig))
    if parameter.kind == "loss_factor":
        share = math.hypot(_LOSS_ERROR, _MODEL_ERROR * dampers)
    return math.hypot(error, share * value)


def _mass_scale_error(rig: Rig) -> float:
    """Standard error of the whole mass, relative: all that is fitted but losses scales with it."""
    sides = KINDS["side"].std / np.array([rig.plate.length, rig.plate.width])
    return float(np.hypot(_FOREIGN_MASS, np.linalg.norm(sides)))


def uncertainty_of(
    before: Uncertainty,
    problem: CalibrationProblem,
    fit: Fit,
    plain: tuple[FloatArray, FloatArray],
    parameters: Sequence[FittedParameter],
    held_out: HeldOutSensors | None,
) -> Uncertainty:
    """How well a calibrated rig is known, for its file.

    Without the error of the whole mass, by which all scales and which no pattern feels. Thickness
    stands for the plate's rigidity: 1 % of modulus shifts modes as 0.5 % of thickness does. Field
    is what the fit's fields have that the rig's are lacking (f, e), as it cannot express form
    errors, and at least what held-out sensors leave unexplained. Gain and phase are those of the
    best gains of fields that are off by so much, as they are read at the sensors: what else is
    off moves gains and fields the opposite ways. What is not identified keeps the value of the
    rig before.
    """
    errors = problem.plate.errors(fit.z, fit.error)
    # An exciter damps and pushes by its coil: the share of its suspension shows little alone.
    by_coils = [each for each in problem.plate.of_exciters if each.kind == "damping"]
    stated = [one for one in parameters if one.parameter not in by_coils]
    relative = {
        kind: [
            math.hypot(
                float(error) / one.value,
                math.hypot(_LOSS_ERROR, _MODEL_ERROR * fit.dampers)
                if kind == "loss_factor"
                else _MODEL_ERROR,
            )
            for one, error in zip(parameters, errors, strict=True)
            if one in stated and one.parameter.kind == kind and one.is_identified and one.value > 0
        ]
        for kind in ("modulus", "loss_factor", "stiffness", "damping")
    }
    known = {
        kind: len(values) == sum(one.parameter.kind == kind for one in stated)
        for kind, values in relative.items()
    }

    def rms(kind: str) -> float:
        return _rms(relative[kind] or [0.0])

    gains = {}
    lacking = lacking_of(problem, fit, plain[0])
    known_gains = np.isfinite(fit.readings_error[0]) & np.isfinite(lacking)
    if known_gains.any(axis=0).all():
        field = max(_rms(lacking[known_gains]), held_out.unexplained if held_out else 0.0)
        # The best gain of a field that is off by so much at n sensors: but at resonances, masses
        # and stiffness that are off change a field in phase with it.
        off = field / np.sqrt(fit.used.sum(axis=2)[known_gains])
        gain, phase = (
            max(_rms(np.hypot(share * off, error[known_gains])), _LEAST)
            for share, error in zip((1, math.sqrt(0.5)), fit.readings_error, strict=True)
        )
        gains = {"gain": _rounded(gain), "phase_deg": _rounded(math.degrees(phase))}
        gains |= {"field": _rounded(field), "common_gain": _rounded(fit.common_error)}
    losses = (
        max(rms("loss_factor"), rms("damping"))
        if known["loss_factor"] and known["damping"]
        else math.log(before.damping)
    )
    fitted = {
        "stiffness": _rounded(rms("stiffness")) if known["stiffness"] else before.stiffness,
        "damping": 1 + _rounded(math.exp(losses) - 1),
    }
    fitted["place"] = _rounded(place_error(problem, fit, before.place))
    feet = [
        float(error) / one.value if one.is_identified else before.supports
        for one, error in zip(parameters, errors, strict=True)
        if one.parameter.foot
    ]
    if feet:
        fitted["supports"] = _rounded(math.hypot(_rms(feet), _MODEL_ERROR))
    if known["modulus"]:
        # The rig's modulus is that of frequencies with form errors, whatever part is theirs.
        of_plain, value = problem.plate.errors(*plain)[0], problem.plate.values(plain[0])[0]
        of_modulus = math.hypot(of_plain / value, _MODEL_ERROR)
        fitted |= Uncertainty.of_frequency(_rounded(of_modulus / 2))
    return Uncertainty.clipped(**asdict(before) | fitted | gains)


def _rms(values: ArrayLike) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _rounded(value: float) -> float:
    """To two digits: an error is hardly known better."""
    return float(f"{value:.2g}")
