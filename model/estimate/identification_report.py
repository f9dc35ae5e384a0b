"""Report of an identification: tables and lines for people, and JSON.

Values are differences from the rig: per cent of the rig's value for parameters that are logarithms
of factors, otherwise in the unit of their kind. Positions of additional masses are relative to the
middle of the plate.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from model.estimate.fit_report import TableRow, confusions, quality_rows, table_lines
from model.estimate.fitted_values import Parameter
from model.estimate.identify import MAX_CHI2, MAX_MODE_SHIFT, Identification
from model.estimate.parameter_kinds import SensorParameter
from model.estimate.parameter_space import ParameterKind
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.sensed_plate import MAX_GUESSED
from model.quantities import estimate_text, percent
from model.study.expected_contrast import ExpectedContrast

_MAX_UNEXPLAINED = 0.01  # above it, the plate differs from the rig in more than its parameters
_LISTED_STDS = 2.0  # standard errors from the rig's value, above which a parameter is listed

_UNIT_KEYS = {"%": "percent", "°": "deg", "/kHz²": "1/kHz^2", "/kHz": "1/kHz"}
"""Units in JSON reports, where these differ from the units in printed reports."""


def identified_parameters(identification: Identification) -> list[Parameter]:
    """Return all uncertain parameters as differences from the rig, in report units."""
    space = identification.fitted.space
    parameters = []
    for name, part in space.groups.items():
        for number in space.indices(name):
            if space.uncertain[number]:
                parameters.append(_identified(identification, name, number, number - part.start))
    return parameters


def _identified(
    identification: Identification, kind_name: str, number: int, number_in_kind: int
) -> Parameter:
    """Return a parameter as a difference from the rig.

    number: index in the space; number_in_kind: among the parameters of its kind.
    """
    space = identification.fitted.space
    kind = PARAMETER_KINDS[kind_name]
    if kind_name == "masses" and number_in_kind % 3 > 0:
        kind = PARAMETER_KINDS["sensor_place"]  # x or y of the mass
    prior = float(space.std[number])
    error = float(identification.std[number])
    difference = prior * float(identification.fitted.x[number])
    if kind.unit == "%":  # logarithms of factors
        prior = math.expm1(prior)
        error = math.exp(difference) * error
        difference = math.expm1(difference)
    return Parameter(
        kind=kind_name,
        name=space.names[number],
        unit=kind.unit,
        era=_era_of(identification, kind, number_in_kind),
        value=kind.per_unit * difference,
        standard_error=kind.per_unit * error,
        prior=kind.per_unit * prior,
    )


def _era_of(identification: Identification, kind: ParameterKind, number_in_kind: int) -> str:
    """Return the ERA of a parameter, or the ERA at which its sensor is, "" without one."""
    if isinstance(kind, SensorParameter):
        return identification.fitted.measurement.sensors[number_in_kind].era
    if kind.per_era:
        return identification.rig.eras[number_in_kind // kind.per_era].name
    return ""


def parameter_rows(identification: Identification) -> list[str]:
    """Return a table of parameters: rig-file parameters, and others that clearly differ.

    Plate parameters come first, then ERA by ERA.
    """
    names = identification.fitted.space.names
    confused = dict(zip(names, confusions(names, identification.covariance), strict=True))
    listed = []
    for parameter in identified_parameters(identification):
        assert parameter.standard_error is not None  # noqa: S101  all were searched
        is_clear = abs(parameter.value) > _LISTED_STDS * parameter.standard_error
        if is_clear or PARAMETER_KINDS[parameter.kind].is_listed:
            listed.append((parameter, parameter.standard_error))
    order = {era.name: number for number, era in enumerate(identification.rig.eras)}
    listed.sort(key=lambda row: order.get(row[0].era, -1))
    return table_lines(
        [_difference_row(parameter, error, confused[parameter.name]) for parameter, error in listed]
    )


def _difference_row(parameter: Parameter, standard_error: float, confused: str) -> TableRow:
    """Return the row of a difference from the rig; confused: name of the correlated parameter."""
    unit = parameter.unit
    if unit not in ("", "°"):
        unit = f" {unit}"
    fitted = estimate_text(parameter.value, standard_error, sign="+")
    note = f"correlated with {confused}" if confused else ""
    if parameter.kind == "supports" and standard_error > MAX_GUESSED * parameter.prior:
        note = "not identified"
    return TableRow(
        name=parameter.name,
        fitted=f"{fitted.value}{unit}",
        standard_error=f"± {fitted.error}{unit}",
        value_before=f"± {float(f'{parameter.prior:.2g}'):g}{unit}",
        note=note,
    )


def fit_rows(identification: Identification) -> list[str]:
    """Return lines on how well the model explains the measurement."""
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
    if identification.fitted.measurement.gain_by_level:
        rows.append(
            f"warning: gains change by {percent(uncertainty.level)} from full level to a tenth of "
            "it, by the run at half level; promises count it as uncertainty.level"
        )
    held_out = identification.held_out
    if held_out is None:
        return rows + quality_rows(uncertainty, "", None, "nothing is promised")
    note = f"the model leaves {percent(held_out.unexplained)} unexplained"
    rows += quality_rows(uncertainty, "every fifth path", held_out.total, note)
    if held_out.unexplained > _MAX_UNEXPLAINED:
        rows.append(
            "the plate differs from the rig in more than its parameters, for example in a "
            "thickness that varies over its length; errors of values and answers allow for this"
        )
    return rows


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
    parameters = [
        {
            "name": parameter.name,
            "unit": _UNIT_KEYS.get(parameter.unit, parameter.unit),
            "difference": parameter.value,
            "standard_error": parameter.standard_error,
            "standard_deviation_before": parameter.prior,
        }
        for parameter in identified_parameters(identification)
    ]
    expected = [
        {
            "quiet": contrast.quiet,
            "before_db": contrast.before,
            "after_db": contrast.after,
            "promised_db": contrast.promised,
        }
        for contrast in contrasts
    ]
    held_out = identification.held_out
    return {
        "explained": identification.is_explained,
        "chi2": identification.chi2,
        "known_well": identification.is_known_well,
        "mode_shift": identification.mode_shift,
        "held_out_error": held_out and held_out.total,
        "unexplained_error": held_out and held_out.unexplained,
        "parameters": parameters,
        "uncertainty": asdict(identification.rig.uncertainty),
        "expected_contrast": expected,
    }
