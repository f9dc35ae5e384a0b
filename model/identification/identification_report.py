"""Report of an identification, as text and as JSON."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from model.identification.fit_report import quality_rows, value_rows
from model.identification.identify import MAX_CHI2, MAX_MODE_SHIFT, Identification
from model.identification.parameters import KINDS, MAX_GUESSED
from model.identification.promise import ExpectedContrast
from model.quantities import percent, with_error

_MISTAKEN = 0.01  # unexplained, beyond which a plate is not quite the rig's
_LYING = 4.0  # standard errors
_SHOWN = 2.0  # standard errors from the rig's value, beyond which a form error is listed

_ALWAYS = ("thickness", "modulus", "stiffness", "damping", "loss", "gain", "phase", "supports")


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter: its value less the rig's, standard error, standard deviation before; unit.

    Per cent are those of the rig's value; places of a mass count from the middle of the plate. key:
    the unit in words.
    """

    name: str
    kind: str
    difference: float
    error: float
    before: float
    unit: str
    key: str


def estimates(found: Identification) -> list[ParameterEstimate]:
    """All parameters that were uncertain."""
    space, posterior = found.posterior.space, found.posterior
    kinds = {number: kind for kind in space.groups for number in space.indices(kind)}
    rows = []
    for number, name in enumerate(space.names):
        if not space.std[number]:
            continue
        kind = kinds[number]
        is_place = kind == "masses" and (number - space.groups[kind].start) % 3
        known = KINDS["place" if is_place else kind]
        std, error = float(space.std[number]), float(posterior.std[number])
        difference = std * float(posterior.x[number])
        if known.unit == "%":  # of logarithms of factors
            std, error = math.expm1(std), math.exp(difference) * error
            difference = math.expm1(difference)
        difference, error, std = (known.per_unit * each for each in (difference, error, std))
        rows.append(ParameterEstimate(name, kind, difference, error, std, known.unit, known.key))
    return rows


@dataclass(frozen=True)
class ClockEstimate:
    """By which an amplifier's clock is late against the first one's, as the plate shows it [us].

    error: standard one; stated: rms of both, as they and their lines state.
    """

    amplifier: str
    delay_us: float
    error_us: float
    stated_us: float

    @property
    def is_believed(self) -> bool:
        """Whether what is stated explains it, but for one in 16 000 that are true."""
        return abs(self.delay_us) <= _LYING * math.hypot(self.error_us, self.stated_us)


def clock_estimates(found: Identification) -> list[ClockEstimate]:
    """Clocks of all amplifiers but the first, by name, whose clocks are held to its own."""
    stated = found.fitted.problem.measurement.clock_errors
    first, *others = sorted(stated) or [""]
    part = found.posterior.space.groups["delay"]
    rows = zip([first, *others], found.values.delays, found.posterior.std[part], strict=False)
    estimated = [
        ClockEstimate(name, 1e6 * delay, 1e6 * error, 1e6 * math.hypot(stated[first], stated[name]))
        for name, delay, error in rows
        if name != first
    ]
    return [each for each in estimated if math.isfinite(each.stated_us)]


def clock_rows(found: Identification) -> list[str]:
    """Lines of clocks that are off, which the rig's gains take off, and of those that lie."""
    rows = []
    for each in clock_estimates(found):
        late = f"{with_error(each.delay_us, each.error_us, sign='+')} us"
        rows.append(f"clock of amplifier {each.amplifier}: {late}, taken off by its ERAs' gains")
        if not each.is_believed:
            rows.append(
                f"amplifier {each.amplifier} or the first one must be within "
                f"{each.stated_us:.0f} us, as stated, got {late}; its clock_error is not true, "
                "or its output is late otherwise than that of its product"
            )
    return rows


def parameter_rows(found: Identification) -> list[str]:
    """Table of what a rig file states, and of all else that differs from it significantly.

    By how much, those of the plate first and then ERA by ERA.
    """
    places = {era.name: place for place, era in enumerate(found.rig.eras)}
    rows = []
    for each in estimates(found):
        if each.kind in _ALWAYS or abs(each.difference) > _SHOWN * each.error:
            unit = each.unit if each.unit in ("", "°") else f" {each.unit}"
            after = f"{with_error(each.difference, each.error, sign='+')}{unit}"
            if each.kind == "supports" and each.error > MAX_GUESSED * each.before:
                after = "not identified"
            rows.append((each.name, f"± {each.before:.2g}{unit}", after))
    return value_rows(sorted(rows, key=lambda row: places.get(row[0].rpartition(" ")[2], -1)))


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
            f"not known well enough: modes are {found.mode_shift:.1f} standard deviations from "
            f"those of the rig's plate (at most {MAX_MODE_SHIFT:g})"
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
            "the plate differs from the rig by more than its parameters, such as in thickness from "
            "end to end; errors of values and answers allow for that"
        )
    return rows


def contrast_rows(expected: Sequence[ExpectedContrast]) -> list[str]:
    """Lines of the contrast to expect before and after, and of what is promised."""
    if not expected:
        return ["contrast: nothing is promised"]
    rows = ["contrast on plates like this one, median over random fingers:"]
    for each in expected:
        rows.append(
            f"  {each.quiet} quiet: as written {each.before:.1f} dB, identified {each.after:.1f} "
            f"dB; nine of ten plates {each.promised:.1f} dB"
        )
    return rows


def as_json(found: Identification, expected: Sequence[ExpectedContrast]) -> dict[str, Any]:
    """All results for programs, units in the keys or beside the values."""
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
                "unit": each.key,
                "difference": each.difference,
                "standard_error": each.error,
                "standard_deviation_before": each.before,
            }
            for each in estimates(found)
        ],
        "clocks": [
            {**asdict(each), "is_believed": each.is_believed} for each in clock_estimates(found)
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
