"""Report of a calibration: tables and lines for people, and JSON."""

from dataclasses import asdict
from typing import Any

import numpy as np

from model.arrays import FloatArray, Point
from model.estimate.calibration_result import Calibration, HeldOutSensors
from model.estimate.fit_report import TableRow, confusions, quality_rows, table_lines
from model.estimate.fitted_values import Parameter
from model.quantities import counted, estimate_text, in_display_unit, percent
from model.rig.rig import Rig
from model.structure.exciter import Actuator


def change_rows(calibration: Calibration) -> list[str]:
    """Return a table of all parameters, and of the ERAs at other positions than in the rig."""
    plate = calibration.plate
    parameters = calibration.parameters
    covariance = calibration.fit.covariance[np.ix_(plate.numbers, plate.numbers)]
    confused = confusions([parameter.name for parameter in parameters], covariance)
    rows = list(map(_parameter_row, parameters, confused))
    for name, (position, error) in calibration.moved.items():
        era = plate.rig.era(name)
        rows.append(
            TableRow(
                name=f"{name} place",
                fitted=f"{_millimeters(position)} mm",
                standard_error=f"± {_millimeters(error)} mm",
                value_before=f"{_millimeters((era.x, era.y))} mm",
                note="",
            )
        )
    return table_lines(rows)


def _parameter_row(parameter: Parameter, confused: str) -> TableRow:
    """Return the row of a fitted value; confused: name of the correlated parameter."""
    value_before = in_display_unit(parameter.before, parameter.unit, digits=5)
    if parameter.standard_error is None:
        return TableRow(parameter.name, "", "", value_before, "not identified")
    fitted = estimate_text(parameter.value, parameter.standard_error, parameter.unit)
    notes = []
    if parameter.before:
        notes.append(f"{100 * (parameter.value / parameter.before - 1):+.1f} %")
    if parameter.at_bound:
        notes.append("at its bound")
    if confused:
        notes.append(f"correlated with {confused}")
    return TableRow(
        name=parameter.name,
        fitted=f"{fitted.value} {fitted.unit}".strip(),
        standard_error=f"± {fitted.error} {fitted.unit}".strip(),
        value_before=value_before,
        note=", ".join(notes),
    )


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
        rows.append(f"sensor {name}: scale {estimate_text(scale, error)} of the others")
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
        return quality_rows(uncertainty, "", None, note)
    sensors = f"sensors {', '.join(held_out.sensors)}"
    note = f"with the old rig {percent(held_out.before)}"
    return quality_rows(uncertainty, sensors, held_out.after, note)


def calibration_json(calibration: Calibration, original: Rig) -> dict[str, Any]:
    """Return all results as JSON, with units in the keys or next to the values."""
    gain_errors = zip(calibration.rig.eras, calibration.gains_error.T, strict=True)
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
    scales = calibration.scales.items()
    return {
        "parameters": list(map(_parameter_json, calibration.parameters)),
        "gains": {era.name: _gains_json(era, errors) for era, errors in gain_errors},
        "moved_eras": moved,
        "uncertainty": asdict(calibration.rig.uncertainty),
        "not_identified": _unidentified(calibration),
        "dead_sensors": list(calibration.dead_sensors),
        "dead_eras": list(calibration.dead_eras),
        "sensor_scales": {
            name: {"scale": scale, "standard_error": error} for name, (scale, error) in scales
        },
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
    return {
        "frequency_hz": frequencies.tolist(),
        "magnitude": magnitudes.tolist(),
        "phase_deg": np.degrees(phases).tolist(),
        "standard_error": standard_errors or [None] * len(frequencies),
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
