"""Report of a calibration and of an identification: one table, lines for people, and JSON.

The table has the fitted value, its standard error, the value before, and the parameter whose error
is most correlated with this one.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from model.arrays import FloatArray, Point
from model.estimate.calibrate import Calibration
from model.estimate.fit import Parameter
from model.estimate.identify import MAX_CHI2, MAX_MODE_SHIFT, Identification
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.space import MAX_GUESSED, UNIT_KEYS
from model.quantities import counted, in_display_unit, percent, with_error
from model.rig.rig import Rig, Uncertainty
from model.study.expected_contrast import ExpectedContrast

_ALIKE = 0.9  # smallest correlation of two errors that is reported
_MISTAKEN = 0.01  # unexplained, beyond which a plate differs from the rig by more than parameters
_LISTED_STDS = 2.0  # from the rig's value, beyond which a parameter is listed


def confusions(names: Sequence[str], covariance: FloatArray) -> list[str]:
    """Name the parameter with the most correlated error, for each parameter.

    The name is empty if the correlation is at most 0.9. covariance: of the errors, (p, p).
    """
    std = np.sqrt(np.diagonal(covariance))
    std = np.where(std > 0, std, np.inf)
    alike = np.abs(covariance / np.outer(std, std)) * ~np.eye(len(std), dtype=bool)
    nearest = alike.argmax(axis=1)
    return [
        names[other] if alike[own, other] > _ALIKE else ""
        for own, other in enumerate(nearest.tolist())
    ]


def estimate_table(rows: Sequence[tuple[str, str, str, str, str]]) -> list[str]:
    """Table of fitted values: name, value, standard error, value before, and a note."""
    cells = [("", "fitted", "standard error", "before", "note"), *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in cells]


def quality_rows(
    uncertainty: Uncertainty, *, held_out: str = "", error: float | None = None, beside: str
) -> list[str]:
    """Return lines on the uncertainty stated by the new rig, and on the held-out prediction.

    held_out: description of the held-out data; error: of its prediction, relative to the response,
    None without held-out data; beside: an additional note on the fit's errors.
    """
    found = (
        f"{held_out} predicted within {percent(error)} of the response"
        if error is not None
        else "too few sensors to leave any out"
    )
    return [f"uncertainty in the new rig: {uncertainty}", f"held out: {found}; {beside}"]


def change_rows(calibration: Calibration) -> list[str]:
    """Table of all parameters, and of ERAs that are not at the rig's places."""
    fit, places = calibration.fit, {era.name: (era.x, era.y) for era in calibration.plate.rig.eras}
    numbers = calibration.plate.numbers
    own = fit.covariance[np.ix_(numbers, numbers)]
    alike = confusions([each.name for each in calibration.parameters], own)
    moved = [
        (
            f"{name} place",
            f"{_millimetres(place)} mm",
            f"± {_millimetres(error)} mm",
            f"{_millimetres(places[name])} mm",
            "",
        )
        for name, (place, error) in calibration.moved.items()
    ]
    return estimate_table([*map(_estimate, calibration.parameters, alike), *moved])


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
        f"sensor {name}: scale {with_error(scale, error)} of the others"
        for name, (scale, error) in calibration.scales.items()
    ]
    if calibration.outlier_count:
        rows.append(
            f"{calibration.outlier_count} of {calibration.value_count} values left out as outliers"
        )
    fixed = [p.name for p in calibration.parameters if not p.is_identified]
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
        beside=f"with the old rig {percent(held.before)}",
    )


def calibration_json(calibration: Calibration, before: Rig) -> dict[str, Any]:
    """Return all results as JSON, with units in the keys or next to the values."""
    held_out = calibration.held_out
    return {
        "parameters": [
            {
                "name": fitted.name,
                "era": fitted.era or None,
                "foot": fitted.foot or None,
                "kind": fitted.kind,
                "unit": fitted.unit,
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
                "standard_error": errors[np.isfinite(errors)].tolist(),
            }
            for era, errors in zip(calibration.rig.eras, calibration.gains_error.T, strict=True)
        },
        "moved_eras": [
            {
                "era": name,
                "before_m": [before.era(name).x, before.era(name).y],
                "after_m": list(place),
                "standard_error_m": list(error),
            }
            for name, (place, error) in calibration.moved.items()
        ],
        "uncertainty": asdict(calibration.rig.uncertainty),
        "not_identified": [p.name for p in calibration.parameters if not p.is_identified],
        "dead_sensors": list(calibration.dead_sensors),
        "dead_eras": list(calibration.dead_eras),
        "sensor_scales": {
            name: {"scale": scale, "standard_error": error}
            for name, (scale, error) in calibration.scales.items()
        },
        "sensors": list(calibration.measurement.names),
        "drive_frequencies_hz": calibration.measurement.frequencies.tolist(),
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


def _millimetres(place: Point) -> str:
    return f"({1e3 * place[0]:.1f}, {1e3 * place[1]:.1f})"


def _estimate(fitted: Parameter, alike: str) -> tuple[str, str, str, str, str]:
    """Row of `estimate_table` of a value; alike: name of the correlated parameter."""
    before = in_display_unit(fitted.before, fitted.unit, digits=5)
    if fitted.standard_error is None:
        return fitted.name, "", "", before, "not identified"
    shown = with_error(fitted.value, fitted.standard_error, fitted.unit)
    value, _, error = shown.partition(" ± ")
    unit = error.partition(" ")[1:]
    notes = [
        f"{100 * (fitted.value / fitted.before - 1):+.1f} %" if fitted.before else "",
        "at its bound" if fitted.at_bound else "",
        f"correlated with {alike}" if alike else "",
    ]
    return fitted.name, value + "".join(unit), f"± {error}", before, ", ".join(filter(None, notes))


def identified_parameters(found: Identification) -> list[Parameter]:
    """Return all uncertain parameters as differences from the rig, in report units.

    Per cent refer to the rig's value; positions of a mass are relative to the middle of the plate.
    """
    space, rows = found.fitted.space, []
    for kind, part in space.groups.items():
        for number in np.arange(space.size)[part][space.uncertain[part]].tolist():
            is_place = kind == "masses" and (number - part.start) % 3
            known = space.kinds["place" if is_place else kind]
            std, error = float(space.std[number]), float(found.std[number])
            difference = std * float(found.fitted.x[number])
            if known.unit == "%":  # of logarithms of factors
                std, error = math.expm1(std), math.exp(difference) * error
                difference = math.expm1(difference)
            difference, error, std = (known.per_unit * each for each in (difference, error, std))
            rows.append(
                Parameter(
                    kind,
                    space.names[number],
                    known.unit,
                    value=difference,
                    standard_error=error,
                    prior=std,
                )
            )
    return rows


def fit_rows(found: Identification) -> list[str]:
    """Lines of how well the model explains the measurement."""
    held, known = found.held_out, found.rig.uncertainty
    verdict = "explains" if found.chi2 <= MAX_CHI2 else "does not explain"
    rows = [f"chi² {found.chi2:.2f}: the model {verdict} the measurement (at most {MAX_CHI2:g})"]
    material = found.rig.plate.material
    if material.orthotropy != found.before.plate.material.orthotropy:
        moduli = ", ".join(f"{key} {each / 1e9:.4g}" for key, each in material.moduli.items())
        rows.append(f"the board's grain was found, too: {moduli} GPa")
    if not found.is_known_well:
        rows.append(
            f"not known well enough: modes differ by {found.mode_shift:.1f} standard deviations "
            f"from the rig's plate (at most {MAX_MODE_SHIFT:g})"
        )
    if held is None:
        return [*rows, *quality_rows(known, beside="nothing is promised")]
    rows += quality_rows(
        known,
        held_out="every fifth path",
        error=held.total,
        beside=f"the model leaves {percent(held.unexplained)} unexplained",
    )
    if held.unexplained > _MISTAKEN:
        rows.append(
            "the plate differs from the rig in more than its parameters, for example in a "
            "thickness that varies over its length; errors of values and answers allow for this"
        )
    return rows


def parameter_rows(found: Identification) -> list[str]:
    """Return a table of parameters: rig-file parameters, and others that clearly differ.

    Plate parameters come first, then ERA by ERA. Values are differences from the rig.
    """
    places = {era.name: place for place, era in enumerate(found.rig.eras)}
    names = found.fitted.space.names
    confused = dict(zip(names, confusions(names, found.covariance), strict=True))
    rows = []
    for each in identified_parameters(found):
        assert each.standard_error is not None  # noqa: S101  all were searched
        if (
            PARAMETER_KINDS[each.kind].is_listed
            or abs(each.value) > _LISTED_STDS * each.standard_error
        ):
            unit = each.unit if each.unit in ("", "°") else f" {each.unit}"
            value, _, error = with_error(each.value, each.standard_error, sign="+").partition(" ± ")
            other = confused[each.name]
            note = f"correlated with {other}" if other else ""
            if each.kind == "supports" and each.standard_error > MAX_GUESSED * each.prior:
                note = "not identified"
            before = f"± {float(f'{each.prior:.2g}'):g}{unit}"
            rows.append((each.name, f"{value}{unit}", f"± {error}{unit}", before, note))
    rows.sort(key=lambda row: places.get(row[0].rpartition(" ")[2], -1))
    return estimate_table(rows)


def contrast_rows(expected: Sequence[ExpectedContrast]) -> list[str]:
    """Lines of the expected contrast before and after, and of the promised contrast."""
    if not expected:
        return ["contrast: nothing is promised"]
    return [
        "contrast on plates like this one, median over random fingers:",
        *(
            f"  {each.quiet} quiet: rig file {each.before:.1f} dB, identified {each.after:.1f} "
            f"dB; promised {each.promised:.1f} dB"
            for each in expected
        ),
    ]


def identification_json(
    found: Identification, expected: Sequence[ExpectedContrast]
) -> dict[str, Any]:
    """Return all results as JSON, with units in the keys or next to the values."""
    return {
        "explained": found.is_explained,
        "chi2": found.chi2,
        "known_well": found.is_known_well,
        "mode_shift": found.mode_shift,
        "held_out_error": None if found.held_out is None else found.held_out.total,
        "unexplained_error": None if found.held_out is None else found.held_out.unexplained,
        "parameters": [
            {
                "name": each.name,
                "unit": UNIT_KEYS.get(each.unit, each.unit),
                "difference": each.value,
                "standard_error": each.standard_error,
                "standard_deviation_before": each.prior,
            }
            for each in identified_parameters(found)
        ],
        "uncertainty": asdict(found.rig.uncertainty),
        "expected_contrast": [
            {
                "quiet": each.quiet,
                "before_db": each.before,
                "after_db": each.after,
                "promised_db": each.promised,
            }
            for each in expected
        ],
    }
