"""Identification of a rig by responses measured in place, the contrast it gives, and its report.

The contrast to expect is that of answers on plates within the remaining uncertainty, solved
exactly. Reports are made as text and as JSON."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from model.answer.plan import query
from model.answer.stimulus import MIN_LEVEL_DB_SL, Placement
from model.arrays import FloatArray
from model.ensemble.draws import PERCENTILE
from model.errors import InputError
from model.estimate.measurement import Measurement
from model.estimate.space import KINDS, MAX_GUESSED, Space, Values, rig_with
from model.estimate.stages import (
    HELD_OUT_FOLDS,
    FittedModel,
    HeldOutPaths,
    Posterior,
    Setting,
    chi2,
    fit_board,
    hold_out,
    unknowns,
)
from model.processes import Progress, unseen
from model.quantities import percent, with_error
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import mesh_of
from model.spectral.modes import PlateMesh, SpectralMesh
from model.structure.modal_elasticity import check_measurable
from model.study.contrast_maps import MIN_DISTANCE, random_contacts
from model.study.verification import draw_plates, felt_on
from model.table.table_file import build_table

MAX_CHI2 = 2.0
"""Largest chi² of a model that explains a measurement, so that answers may be promised from it."""

MAX_MODE_SHIFT = 2.0
"""Largest rms shift of the lowest modes, in standard deviations, of a plate that is known well:
beyond it fields between the sensors are others, whatever these hear."""

# Repeatability of a drive from one day to the next, which no measurement shows.
_DRIVE_GAIN, _DRIVE_PHASE_DEG = 0.01, 1.0

_MIN_VALUES = 16
_GAIN_STDS = 5.0  # beyond which a gain is wrong
_GAIN_ALLOWED, _PHASE_ALLOWED = 0.3, math.radians(20)  # whatever the rig's uncertainty

_PLATES = 60
_MARGIN = 0.013  # m, of fingers from the edges

_MISTAKEN = 0.01  # unexplained, beyond which a plate differs from the rig by more than parameters
_CLOCK_STDS = 4.0  # beyond which a clock is not as stated
_LISTED_STDS = 2.0  # from the rig's value, beyond which a parameter is listed

_ALWAYS_LISTED = (
    "thickness",
    "modulus",
    "stiffness",
    "damping",
    "loss",
    "gain",
    "phase",
    "supports",
)


@dataclass(frozen=True, eq=False)
class Identification:
    """A rig as its responses show it."""

    before: Rig
    """The rig as written."""
    rig: Rig
    """The rig with identified values and, where the model explains the measurement, their
    uncertainty."""
    values: Values
    """Values of the parameters, gains of sensors among them."""
    posterior: Posterior
    """Distribution of the parameters, wider by the disagreement of held-out paths."""
    chi2: float
    """Squared residuals per degree of freedom."""
    mode_shift: float
    """Rms by which the lowest modes had to shift, in standard deviations."""
    held_out: HeldOutPaths | None
    """Prediction of unseen paths, None where there are too few."""
    fitted: FittedModel
    seed: int
    """Seed of the contacts that a promise draws."""

    @property
    def is_explained(self) -> bool:
        """Whether the model explains the measurement, so that answers may rely on it."""
        return self.chi2 <= MAX_CHI2 and self.is_known_well

    @property
    def is_known_well(self) -> bool:
        """Whether the modes are those of the rig's plate, and with them fields between sensors."""
        return self.mode_shift <= MAX_MODE_SHIFT


def identify(
    rig: Rig, measurement: Measurement, *, seed: int = 0, progress: Progress = unseen
) -> Identification:
    """Identify a rig by a measurement on it; the same for the same data and seed.

    progress: called with the fits done and all, one of everything and one of each held-out share.
    Raises InputError for a rig with a part that does not scale, for a plate that was not linear or
    has changed during the measurement, for gains that no drive or sensor has (another unit, a wrong
    sign), and where a quantity that answers depend on stays unknown, with the tone and the sensor
    that would show it.
    """
    _check(rig, measurement)
    before, free = rig, solved_for(rig, float(measurement.frequencies[-1]))
    setting, fitted = fit_board(Setting(rig, free, measurement))
    rig = setting.rig
    values = Values.of(rig, fitted.space, fitted.best.x)
    posterior, shift = Posterior.of(fitted.space, fitted.best), _mode_shift(fitted)
    found = Identification(
        before=before,
        rig=rig,
        values=values,
        posterior=posterior,
        chi2=chi2(fitted),
        mode_shift=shift,
        held_out=None,
        fitted=fitted,
        seed=seed,
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
    progress(1 + HELD_OUT_FOLDS, 1 + HELD_OUT_FOLDS)
    known = rig_with(rig, values, uncertainty)
    return replace(found, rig=known, posterior=posterior, held_out=held_out)


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
    if measurement.count < _MIN_VALUES:
        raise InputError(
            f"a measurement must have at least {_MIN_VALUES} values, got {measurement.count}; "
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


def _mode_shift(fitted: FittedModel) -> float:
    """Root mean square of the shifts of modes in standard deviations, 0 without any."""
    shifts = fitted.best.x[fitted.space.of("mode_shifts")]
    return float(np.sqrt((shifts**2).mean())) if len(shifts) else 0.0


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
        if abs(one.real) > max(_GAIN_ALLOWED, _GAIN_STDS * gain)
        or abs(one.imag) > max(_PHASE_ALLOWED, _GAIN_STDS * phase)
    ]


@dataclass(frozen=True)
class ExpectedContrast:
    """Contrast [dB] with a number of quiet fingers, medians over sets of contacts."""

    quiet: int
    before: float
    """Given by half of the plates like the identified one, with answers of the rig as written."""
    after: float
    """The same with answers of the identified rig."""
    promised: float
    """Given by nine of ten of these plates with answers of the identified rig."""


def expected_contrast(
    found: Identification, *, frequencies: FloatArray | None = None, sets: int = 12
) -> list[ExpectedContrast]:
    """Expect contrasts for one, two and three quiet fingers; the same for the same seed.

    frequencies (f,) [Hz]: of the tables, by default the usual ones. Returns an empty list, since
    nothing can be promised, where the model does not explain the measurement or too few paths were
    measured to hold any out.
    """
    if not found.is_explained or found.held_out is None:
        return []
    written, identified = (
        build_table(rig, frequencies=frequencies, drive_mode="phased")
        for rig in (found.before, found.rig)
    )
    expected, plate = [], identified.plate
    shorter = min(plate.length, plate.width)
    margin = min(_MARGIN, shorter / 4)
    for quiet in (1, 2, 3):
        rng = np.random.default_rng([found.seed, quiet])
        apart = min(MIN_DISTANCE, shorter / (2 * (quiet + 1)))
        rows = []
        for _ in range(sets):
            places = random_contacts(rng, quiet + 1, plate, margin=margin, apart=apart)
            placed = Placement(places[:1], places[1:])
            plates = draw_plates(
                rng,
                identified.uncertainty,
                count=_PLATES,
                of=identified,
                contact_count=quiet + 1,
            )
            each = []
            for table in (written, identified):
                drive = query(table, placed, MIN_LEVEL_DB_SL).layers[0].excitation
                _, contrast = felt_on(identified, placed, drive, plates)
                assert contrast is not None  # noqa: S101  there are quiet fingers
                each.append(20 * np.log10(contrast))
            before, after = each
            rows.append((np.median(before), np.median(after), np.percentile(after, PERCENTILE)))
        expected.append(ExpectedContrast(quiet, *np.median(rows, axis=0).tolist()))
    return expected


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter less its value in the rig; per cent are those of the rig's value.

    Places of a mass count from the middle of the plate.
    """

    name: str
    kind: str
    difference: float
    error: float
    """Standard error of the difference."""
    before: float
    """Standard deviation before the measurement."""
    unit: str
    """Unit for people."""
    key: str
    """Unit for programs."""


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
    """Delay of an amplifier's clock against the first one's, as the plate shows it."""

    amplifier: str
    delay_us: float
    error_us: float
    """Standard error of the delay."""
    stated_us: float
    """Rms error of both clocks, as they and their lines state."""

    @property
    def is_believed(self) -> bool:
        """Whether the stated errors explain the delay; one true statement in 16 000 fails."""
        return abs(self.delay_us) <= _CLOCK_STDS * math.hypot(self.error_us, self.stated_us)


def clock_estimates(found: Identification) -> list[ClockEstimate]:
    """Delays of all amplifiers' clocks to that of the first one by name."""
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


def parameter_rows(found: Identification) -> list[str]:
    """Table of parameters: those that a rig file states, and all others that clearly differ.

    Those of the plate come first, then ERA by ERA.
    """
    places = {era.name: place for place, era in enumerate(found.rig.eras)}
    rows = []
    for each in estimates(found):
        if each.kind in _ALWAYS_LISTED or abs(each.difference) > _LISTED_STDS * each.error:
            unit = each.unit if each.unit in ("", "°") else f" {each.unit}"
            after = f"{with_error(each.difference, each.error, sign='+')}{unit}"
            if each.kind == "supports" and each.error > MAX_GUESSED * each.before:
                after = "not identified"
            rows.append((each.name, f"± {each.before:.2g}{unit}", after))
    return value_rows(sorted(rows, key=lambda row: places.get(row[0].rpartition(" ")[2], -1)))


def clock_rows(found: Identification) -> list[str]:
    """Lines of the clocks' delays, which the rig's gains correct, and of unbelievable ones."""
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


def value_rows(changes: Sequence[tuple[str, str, str]]) -> list[str]:
    """Table of values: name, before, and after with its standard error, as texts with units."""
    width = max((len(name) for name, _, _ in changes), default=0)
    return [f"{name:{width}}  {before} -> {after}" for name, before, after in changes]


def quality_rows(
    uncertainty: Uncertainty, *, held_out: str = "", error: float | None = None, beside: str
) -> list[str]:
    """Lines of the uncertainty that the new rig states, and of the held-out prediction.

    held_out: what was held out; error: of its prediction, relative to the response, None where too
    little was measured to hold any out; beside: a further note on the fit's errors.
    """
    found = (
        f"{held_out} predicted within {percent(error)} of the response"
        if error is not None
        else "too few sensors to leave any out"
    )
    return [f"uncertainty in the new rig: {uncertainty}", f"held out: {found}; {beside}"]


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
