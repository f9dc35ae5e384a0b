"""Reports of a calibration and of an identification: tables and lines for people, and JSON.

A table lists each fitted value with its standard error, the value before the fit, and the
parameter whose error is most correlated with its own.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from model.arrays import FloatArray, Point
from model.estimate.calibration_result import Calibration, HeldOutSensors
from model.estimate.forward import ParameterKind, Space
from model.estimate.identify import MAX_CHI2, MAX_MODE_SHIFT, Identification
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.sensed_plate import Parameter
from model.estimate.space import MAX_GUESSED, UNIT_KEYS
from model.quantities import counted, error_parts, in_display_unit, percent, with_error
from model.rig.rig import Rig, Uncertainty
from model.structure.exciter import Actuator
from model.study.expected_contrast import ExpectedContrast

_MIN_CORRELATION = 0.9  # of two errors, above which a report names the other parameter
_MAX_UNEXPLAINED = 0.01  # above it, the plate differs from the rig in more than its parameters
_LISTED_STDS = 2.0  # standard errors from the rig's value, above which a parameter is listed

_NONE_HELD_OUT = "too few sensors to leave any out"

_Row = tuple[str, str, str, str, str]
"""Row of a table: name, fitted value, standard error, value before the fit, note."""


def confusions(names: Sequence[str], covariance: FloatArray) -> list[str]:
    """Return the name of the parameter with the most correlated error, for each parameter.

    The name is empty if the correlation is at most 0.9. covariance: of the errors, (p, p).
    """
    std = np.sqrt(np.diagonal(covariance))
    std = np.where(std > 0, std, np.inf)
    correlations = np.abs(covariance / np.outer(std, std)) * ~np.eye(len(std), dtype=bool)
    confused = [""] * len(names)
    for number, nearest in enumerate(correlations.argmax(axis=1).tolist()):
        if correlations[number, nearest] > _MIN_CORRELATION:
            confused[number] = names[nearest]
    return confused


def _table(rows: Sequence[_Row]) -> list[str]:
    """Return the lines of a table of fitted values, with a header."""
    cells = [("", "fitted", "standard error", "before", "note"), *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in cells]


def _quality_rows(uncertainty: Uncertainty, prediction: str, note: str) -> list[str]:
    """Return lines on the uncertainty of the new rig and on the prediction of held-out data."""
    return [f"uncertainty in the new rig: {uncertainty}", f"held out: {prediction}; {note}"]


def _prediction(subject: str, error: float) -> str:
    """Describe a prediction of held-out data; error: relative to the response."""
    return f"{subject} predicted within {percent(error)} of the response"


def change_rows(calibration: Calibration) -> list[str]:
    """Return a table of all parameters, and of the ERAs at other positions than in the rig."""
    plate = calibration.plate
    parameters = calibration.parameters
    covariance = calibration.fit.covariance[np.ix_(plate.numbers, plate.numbers)]
    confused = confusions([parameter.name for parameter in parameters], covariance)
    rows = list(map(_parameter_row, parameters, confused))
    for name, (position, error) in calibration.moved.items():
        era = plate.rig.era(name)
        fitted = f"{_millimeters(position)} mm"
        position_before = f"{_millimeters((era.x, era.y))} mm"
        rows.append((f"{name} place", fitted, f"± {_millimeters(error)} mm", position_before, ""))
    return _table(rows)


def _parameter_row(parameter: Parameter, confused: str) -> _Row:
    """Return the row of a fitted value; confused: name of the correlated parameter."""
    value_before = in_display_unit(parameter.before, parameter.unit, digits=5)
    if parameter.standard_error is None:
        return parameter.name, "", "", value_before, "not identified"
    value, error, unit = error_parts(parameter.value, parameter.standard_error, parameter.unit)
    fitted = f"{value} {unit}".strip()
    standard_error = f"± {error} {unit}".strip()
    notes = []
    if parameter.before:
        notes.append(f"{100 * (parameter.value / parameter.before - 1):+.1f} %")
    if parameter.at_bound:
        notes.append("at its bound")
    if confused:
        notes.append(f"correlated with {confused}")
    return parameter.name, fitted, standard_error, value_before, ", ".join(notes)


def _millimeters(point: Point) -> str:
    return f"({1e3 * point[0]:.1f}, {1e3 * point[1]:.1f})"


def gain_rows(calibration: Calibration) -> list[str]:
    """Return a line per ERA: median and range of its gains over frequency, and standard error."""
    rows = []
    for number, era in enumerate(calibration.rig.eras):
        if era.name in calibration.dead_eras or not era.gains:
            rows.append(f"{era.name} gain  not measured")
            continue
        _, magnitudes, phases = np.transpose(era.gains)
        size = 100 * (magnitudes - 1)
        phase = np.degrees(phases)
        error = 100 * float(np.nanmedian(calibration.gains_error[:, number]))
        rows.append(
            f"{era.name} gain  {np.median(size):+.1f} % ({size.min():+.1f} to {size.max():+.1f}), "
            f"phase {np.median(phase):+.1f}° ({phase.min():+.1f} to {phase.max():+.1f}), "
            f"± {error:.2g} % at {counted(len(size), 'frequency', plural='frequencies')}"
        )
    return rows


def finding_rows(calibration: Calibration) -> list[str]:
    """Return lines on faults of the measurement, and on parameters that are not identified."""
    rows = [f"sensor {name}: no signal, left out" for name in calibration.dead_sensors]
    for name in calibration.dead_eras:
        rows.append(f"ERA {name}: no motion; gains unchanged")
    for name, (scale, error) in calibration.scales.items():
        rows.append(f"sensor {name}: scale {with_error(scale, error)} of the others")
    if calibration.outlier_count:
        rows.append(
            f"{calibration.outlier_count} of {calibration.value_count} values left out as outliers"
        )
    names = _unidentified(calibration)
    if names:
        rows.append(f"not identified, rig's value kept: {', '.join(names)}")
    return rows


def _unidentified(calibration: Calibration) -> list[str]:
    """Return the names of the parameters that are not identified."""
    return [parameter.name for parameter in calibration.parameters if not parameter.is_identified]


def check_rows(calibration: Calibration) -> list[str]:
    """Return lines on the uncertainty of the new rig and on the held-out check."""
    uncertainty = calibration.rig.uncertainty
    held_out = calibration.held_out
    if held_out is None:
        note = f"error of the fit {percent(calibration.error)}"
        return _quality_rows(uncertainty, _NONE_HELD_OUT, note)
    prediction = _prediction(f"sensors {', '.join(held_out.sensors)}", held_out.after)
    note = f"with the old rig {percent(held_out.before)}"
    return _quality_rows(uncertainty, prediction, note)


def calibration_json(calibration: Calibration, original: Rig) -> dict[str, Any]:
    """Return all results as JSON, with units in the keys or next to the values."""
    gains = {}
    for era, errors in zip(calibration.rig.eras, calibration.gains_error.T, strict=True):
        gains[era.name] = _gains_json(era, errors)
    moved = []
    for name, (position, error) in calibration.moved.items():
        era = original.era(name)
        moved.append(
            {
                "era": name,
                "before_m": [era.x, era.y],
                "after_m": list(position),
                "standard_error_m": list(error),
            }
        )
    scales = {}
    for name, (scale, scale_error) in calibration.scales.items():
        scales[name] = {"scale": scale, "standard_error": scale_error}
    return {
        "parameters": list(map(_parameter_json, calibration.parameters)),
        "gains": gains,
        "moved_eras": moved,
        "uncertainty": asdict(calibration.rig.uncertainty),
        "not_identified": _unidentified(calibration),
        "dead_sensors": list(calibration.dead_sensors),
        "dead_eras": list(calibration.dead_eras),
        "sensor_scales": scales,
        "sensors": list(calibration.measurement.names),
        "drive_frequencies_hz": calibration.measurement.frequencies.tolist(),
        "values": calibration.value_count,
        "outliers": calibration.outlier_count,
        "fit_error": calibration.error,
        "chi2": calibration.chi2,
        "held_out": _held_out_json(calibration.held_out),
        "good": calibration.is_good,
        "fingerprint_before": original.fingerprint,
        "fingerprint_after": calibration.rig.fingerprint,
    }


def _parameter_json(parameter: Parameter) -> dict[str, Any]:
    return {
        "name": parameter.name,
        "era": parameter.era or None,
        "foot": parameter.foot or None,
        "kind": parameter.kind,
        "unit": parameter.unit,
        "before": parameter.before,
        "after": parameter.value,
        "standard_error": parameter.standard_error,
        "identified": parameter.is_identified,
        "at_bound": parameter.at_bound,
    }


def _gains_json(era: Actuator, errors: FloatArray) -> dict[str, Any]:
    """Return the gains of an ERA; errors (f,): standard errors, NaN if not measured.

    An ERA that was not measured keeps the gains of its rig, with null standard errors.
    """
    frequencies, magnitudes, phases = np.reshape(era.gains, (-1, 3)).T
    standard_errors = errors[np.isfinite(errors)].tolist()
    if not standard_errors:
        standard_errors = [None] * len(frequencies)
    return {
        "frequency_hz": frequencies.tolist(),
        "magnitude": magnitudes.tolist(),
        "phase_deg": np.degrees(phases).tolist(),
        "standard_error": standard_errors,
    }


def _held_out_json(held_out: HeldOutSensors | None) -> dict[str, Any] | None:
    if held_out is None:
        return None
    return {
        "sensors": list(held_out.sensors),
        "error_before": held_out.before,
        "error_after": held_out.after,
        "median_error_after": held_out.median,
    }


def identified_parameters(identification: Identification) -> list[Parameter]:
    """Return all uncertain parameters as differences from the rig, in report units.

    Per cent refer to the rig's value; positions of a mass are relative to the middle of the plate.
    """
    space = identification.fitted.space
    parameters = []
    for name, part in space.groups.items():
        for number in space.indices(name):
            if space.uncertain[number]:
                kind = _reported_kind(space, name, number - part.start)
                parameters.append(_identified(identification, name, kind, number))
    return parameters


def _reported_kind(space: Space, name: str, number: int) -> ParameterKind:
    """Return the kind with the unit of a parameter of a named kind; number: within the kind."""
    is_position = name == "masses" and number % 3 > 0
    return space.kinds["place"] if is_position else space.kinds[name]


def _identified(
    identification: Identification, name: str, kind: ParameterKind, number: int
) -> Parameter:
    """Return a parameter as a difference from the rig; number: index in the space."""
    space = identification.fitted.space
    prior = float(space.std[number])
    error = float(identification.std[number])
    difference = prior * float(identification.fitted.x[number])
    if kind.unit == "%":  # logarithms of factors
        prior = math.expm1(prior)
        error = math.exp(difference) * error
        difference = math.expm1(difference)
    return Parameter(
        kind=name,
        name=space.names[number],
        unit=kind.unit,
        value=kind.per_unit * difference,
        standard_error=kind.per_unit * error,
        prior=kind.per_unit * prior,
    )


def fit_rows(identification: Identification) -> list[str]:
    """Return lines on how well the model explains the measurement."""
    held_out = identification.held_out
    verdict = "explains" if identification.is_explained else "does not explain"
    chi2 = f"chi² {identification.chi2:.2f} (at most {MAX_CHI2:g})"
    rows = [f"{chi2}: the model {verdict} the measurement"]
    material = identification.rig.plate.material
    if material.orthotropy != identification.before.plate.material.orthotropy:
        moduli = [f"{key} {modulus / 1e9:.4g}" for key, modulus in material.moduli.items()]
        rows.append(f"the board's grain was found, too: {', '.join(moduli)} GPa")
    if not identification.is_known_well:
        rows.append(
            f"not known well enough: modes differ by {identification.mode_shift:.1f} standard "
            f"deviations from the rig's plate (at most {MAX_MODE_SHIFT:g})"
        )
    uncertainty = identification.rig.uncertainty
    if held_out is None:
        return [*rows, *_quality_rows(uncertainty, _NONE_HELD_OUT, "nothing is promised")]
    prediction = _prediction("every fifth path", held_out.total)
    note = f"the model leaves {percent(held_out.unexplained)} unexplained"
    rows += _quality_rows(uncertainty, prediction, note)
    if held_out.unexplained > _MAX_UNEXPLAINED:
        rows.append(
            "the plate differs from the rig in more than its parameters, for example in a "
            "thickness that varies over its length; errors of values and answers allow for this"
        )
    return rows


def parameter_rows(identification: Identification) -> list[str]:
    """Return a table of parameters: rig-file parameters, and others that clearly differ.

    Plate parameters come first, then ERA by ERA. Values are differences from the rig.
    """
    order = {era.name: number for number, era in enumerate(identification.rig.eras)}
    names = identification.fitted.space.names
    confused = dict(zip(names, confusions(names, identification.covariance), strict=True))
    rows = []
    for parameter in identified_parameters(identification):
        assert parameter.standard_error is not None  # noqa: S101  all were searched
        is_clear = abs(parameter.value) > _LISTED_STDS * parameter.standard_error
        if is_clear or PARAMETER_KINDS[parameter.kind].is_listed:
            rows.append(_difference_row(parameter, parameter.standard_error, confused))
    rows.sort(key=lambda row: order.get(row[0].rpartition(" ")[2], -1))
    return _table(rows)


def _difference_row(parameter: Parameter, standard_error: float, confused: dict[str, str]) -> _Row:
    """Return the row of a difference from the rig; confused: correlated parameters by name."""
    unit = parameter.unit
    if unit not in ("", "°"):
        unit = f" {unit}"
    value, error, _ = error_parts(parameter.value, standard_error, sign="+")
    prior = f"± {float(f'{parameter.prior:.2g}'):g}{unit}"
    note = confused[parameter.name]
    if note:
        note = f"correlated with {note}"
    if parameter.kind == "supports" and standard_error > MAX_GUESSED * parameter.prior:
        note = "not identified"
    return parameter.name, f"{value}{unit}", f"± {error}{unit}", prior, note


def contrast_rows(contrasts: Sequence[ExpectedContrast]) -> list[str]:
    """Return lines on the expected contrast before and after, and on the promised contrast."""
    if not contrasts:
        return ["contrast: nothing is promised"]
    rows = ["contrast on plates like this one, median over random fingers:"]
    for contrast in contrasts:
        rows.append(
            f"  {contrast.quiet} quiet: rig file {contrast.before:.1f} dB, identified "
            f"{contrast.after:.1f} dB; promised {contrast.promised:.1f} dB"
        )
    return rows


def identification_json(
    identification: Identification, contrasts: Sequence[ExpectedContrast]
) -> dict[str, Any]:
    """Return all results as JSON, with units in the keys or next to the values."""
    total, unexplained = None, None
    if identification.held_out is not None:
        total = identification.held_out.total
        unexplained = identification.held_out.unexplained
    parameters = []
    for parameter in identified_parameters(identification):
        parameters.append(
            {
                "name": parameter.name,
                "unit": UNIT_KEYS.get(parameter.unit, parameter.unit),
                "difference": parameter.value,
                "standard_error": parameter.standard_error,
                "standard_deviation_before": parameter.prior,
            }
        )
    expected = []
    for contrast in contrasts:
        expected.append(
            {
                "quiet": contrast.quiet,
                "before_db": contrast.before,
                "after_db": contrast.after,
                "promised_db": contrast.promised,
            }
        )
    return {
        "explained": identification.is_explained,
        "chi2": identification.chi2,
        "known_well": identification.is_known_well,
        "mode_shift": identification.mode_shift,
        "held_out_error": total,
        "unexplained_error": unexplained,
        "parameters": parameters,
        "uncertainty": asdict(identification.rig.uncertainty),
        "expected_contrast": expected,
    }
