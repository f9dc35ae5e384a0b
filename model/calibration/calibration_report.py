"""Report of a calibration, as text and as JSON."""

from dataclasses import asdict
from typing import Any

import numpy as np

from model.calibration.calibration_result import Calibration, FittedParameter
from model.identification.fit_report import quality_rows, value_rows
from model.quantities import counted, in_display_unit, percent, with_error
from model.rig.rig import Rig


def change_rows(calibration: Calibration) -> list[str]:
    """Table of all parameters, and of ERAs that are not at the rig's places."""
    moved = [
        (
            f"{each.name} place",
            _millimetres(each.before),
            f"{_millimetres(each.after)} ± {_millimetres(each.standard_error)} mm",
        )
        for each in calibration.moved
    ]
    return value_rows([*map(_change, calibration.parameters), *moved])


def gain_rows(calibration: Calibration) -> list[str]:
    """Lines of all ERAs: median and range over frequency of their gains, with standard error."""
    rows = []
    for number, era in enumerate(calibration.rig.eras):
        if era.name in calibration.dead_eras or not era.gains:
            rows.append(f"{era.name} gain  not measured")
            continue
        size = 100 * (np.array([row[1] for row in era.gains]) - 1)
        phase = np.degrees([row[2] for row in era.gains])
        error = float(np.nanmedian(calibration.gains_error[:, number]))
        rows.append(
            f"{era.name} gain  {np.median(size):+.1f} % ({size.min():+.1f} to {size.max():+.1f}), "
            f"phase {np.median(phase):+.1f}° ({phase.min():+.1f} to {phase.max():+.1f}), "
            f"± {100 * error:.2g} % at {counted(len(size), 'frequency', plural='frequencies')}"
        )
    return rows


def finding_rows(calibration: Calibration) -> list[str]:
    """Lines of faults of the measurement, and of parameters that are not identified."""
    rows = [f"sensor {name}: no signal, left out" for name in calibration.dead_sensors]
    rows += [f"ERA {name}: no motion; gains unchanged" for name in calibration.dead_eras]
    rows += [
        f"sensor {scale.name}: scale {with_error(scale.scale, scale.standard_error)} of the others"
        for scale in calibration.scales
    ]
    if calibration.outlier_count:
        rows.append(
            f"{calibration.outlier_count} of {calibration.value_count} values left out as outliers"
        )
    fixed = [p.parameter.name for p in calibration.parameters if not p.is_identified]
    if fixed:
        rows.append(f"not identified, rig's value kept: {', '.join(fixed)}")
    return rows


def check_rows(calibration: Calibration) -> list[str]:
    """Lines of the new rig's uncertainty and of the held-out check."""
    held, known = calibration.held_out, calibration.rig.uncertainty
    if held is None:
        return quality_rows(known, beside=f"error of the fit {percent(calibration.error)}")
    return quality_rows(
        known,
        held_out=f"sensors {', '.join(held.sensors)}",
        error=held.after,
        beside=f"by the old rig {percent(held.before)}",
    )


def as_json(calibration: Calibration, before: Rig) -> dict[str, Any]:
    """All results for programs, units in the keys or beside the values."""
    held_out = calibration.held_out
    frequencies = calibration.frequencies
    return {
        "parameters": [
            {
                "name": fitted.parameter.name,
                "era": fitted.parameter.era or None,
                "foot": fitted.parameter.foot or None,
                "kind": fitted.parameter.kind,
                "unit": fitted.parameter.unit,
                "before": fitted.before,
                "after": fitted.value,
                "standard_error": fitted.standard_error,
                "identified": fitted.is_identified,
                "at_bound": fitted.at_bound,
            }
            for fitted in calibration.parameters
        ],
        "gains": {
            era.name: {
                "frequency_hz": [row[0] for row in era.gains],
                "magnitude": [row[1] for row in era.gains],
                "phase_deg": np.degrees([row[2] for row in era.gains]).tolist(),
                "standard_error": [
                    float(error)
                    for error in calibration.gains_error[:, number]
                    if np.isfinite(error)
                ],
            }
            for number, era in enumerate(calibration.rig.eras)
        },
        "moved_eras": [
            {
                "era": moved.name,
                "before_m": list(moved.before),
                "after_m": list(moved.after),
                "standard_error_m": list(moved.standard_error),
            }
            for moved in calibration.moved
        ],
        "uncertainty": asdict(calibration.rig.uncertainty),
        "not_identified": [p.parameter.name for p in calibration.parameters if not p.is_identified],
        "dead_sensors": list(calibration.dead_sensors),
        "dead_eras": list(calibration.dead_eras),
        "sensor_scales": {
            scale.name: {"scale": scale.scale, "standard_error": scale.standard_error}
            for scale in calibration.scales
        },
        "sensors": list(calibration.sensors),
        "drive_frequencies_hz": frequencies.tolist(),
        "values": calibration.value_count,
        "outliers": calibration.outlier_count,
        "fit_error": calibration.error,
        "chi2": calibration.chi2,
        "held_out": None
        if held_out is None
        else {
            "sensors": list(held_out.sensors),
            "error_before": held_out.before,
            "error_after": held_out.after,
            "median_error_after": held_out.median,
        },
        "good": calibration.is_good,
        "fingerprint_before": before.fingerprint,
        "fingerprint_after": calibration.rig.fingerprint,
    }


def _millimetres(place: tuple[float, float]) -> str:
    return f"({1e3 * place[0]:.1f}, {1e3 * place[1]:.1f})"


def _change(fitted: FittedParameter) -> tuple[str, str, str]:
    parameter = fitted.parameter
    before = in_display_unit(fitted.before, parameter.unit, digits=5)
    if fitted.standard_error is None:
        return parameter.name, before, "not identified"
    note = "  (at its bound)" if fitted.at_bound else ""
    after = with_error(fitted.value, fitted.standard_error, parameter.unit)
    share = f" ({100 * (fitted.value / fitted.before - 1):+.1f} %)" if fitted.before else ""
    return parameter.name, before, f"{after}{share}{note}"
