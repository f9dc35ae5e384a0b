"""Rig check: compare measured responses with a rig.

`diagnose` first looks for errors in the rig file that describe another plate, then matches plate
and wiring (`model.estimate.plate_match`), and returns a `Verdict` with the state of each channel
and the findings of `model.estimate.findings`.

Before a fit (`model.estimate.screening`), it also rejects responses that contradict their
metadata. Each check looks for one error among the parameters that the fit leaves free.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, best_by, best_of
from model.errors import InputError
from model.estimate.findings import (
    MAX_FORM_ERROR,
    ChannelVerdict,
    Finding,
    Verdict,
    match_beyond,
    with_findings,
)
from model.estimate.gains import gains_of, row_rms
from model.estimate.hypotheses import Hypothesis, compare_hypotheses
from model.estimate.measurement import (
    LEAST_SENSORS,
    Measurement,
    check_enough_sensors,
    silent_sensors,
    typical,
)
from model.estimate.misread_files import (
    Correction,
    exchanged_sensors,
    other_meaning,
    reversed_axes,
)
from model.estimate.plate_match import (
    FALSE_ALARM,
    MAX_FIT_ERROR,
    MIN_COST_REDUCTION,
    MODEL_ERROR,
    Match,
    best_wiring,
    likeliest,
    match_plate,
)
from model.estimate.sensed_plate import SensedPlate, plate_of
from model.estimate.shape_match import ShapeMatch, match_responses, match_shapes
from model.rig.rig import Rig
from model.structure.attachments import PointLoad
from model.structure.exciter import Exciter
from model.structure.sources import Era
from model.structure.statics import GRAVITY
from model.study.expected_contrast import promise_margins

STRONG = 1.25
"""Gain from which a channel is strong, or weak below its inverse: 2 dB.

That is four times the tolerance of drives.
"""

LOOSE = 0.7
"""Share of its own stiffness below which an exciter that explains a plate is loose."""

MISSED_DB = 1.0
"""Largest miss of the promises of a table by half of its answers [dB]."""

_LEAST_FREQUENCIES = 4
_GAIN_STDS = 3.5  # of the rig's uncertainty, if larger
_MIN_COHERENCE = 0.6  # length of the mean of unit phasors of a reliable phase
_MAX_PHASE_ERROR = 45.0  # degrees
_DEAD = 0.03  # of the response that the rig predicts
_FAINT = 0.3  # of the prediction; dead if the shape matches no ERA either
_NO_SHAPE = 0.6  # MAC
_DEAD_CONFIDENCE = 0.99
_SENSOR_SCALE = (0.7, 1.4)
_MUTE = 0.1  # of the others' scale
_UPSIDE_DOWN = -0.5
_MORE_NOISE = 1.2  # model error of a second match, relative to the error of the first
_MAX_MODEL_ERROR = 0.3

_GLUES = np.geomspace(100.0, 1e5, 61)  # N/m
_RISES = 0.2  # of the logarithm of a gain over the frequencies
_EXPLAINS = 0.6  # of the median residual without glue
_MIN_CHANNELS = 3  # whose median shows a common error of the amplifier

_MAX_GAIN = 3.0  # of all channels together; a factor either way is another quantity or unit


class _Quantity(NamedTuple):
    """Quantity that responses can be by mistake: factor * (i omega)^power times the right one."""

    name: str
    remedy: str
    factor: float
    power: int = 0


_RIGHT_QUANTITY = _Quantity("acceleration per displacement", "", 1.0)
_WRONG_QUANTITIES = (
    _Quantity("g", f"multiply by {GRAVITY}", 1 / GRAVITY),
    _Quantity("mm/s² per m", "divide by 1000", 1e3),
    _Quantity("m/s² per mm", "multiply by 1000", 1e-3),
    _Quantity("m/s² per µm", "multiply by 1000000", 1e-6),
    _Quantity("g per mm", f"multiply by {1000 * GRAVITY}", 1e-3 / GRAVITY),
    _Quantity("g per µm", f"multiply by {1e6 * GRAVITY}", 1e-6 / GRAVITY),
    _Quantity("velocity in m/s", "multiply by i omega, 2 pi times the frequency", 1.0, -1),
    _Quantity("velocity in mm/s", "multiply by i omega / 1000", 1e3, -1),
    _Quantity("displacement in m", "multiply by -omega², omega 2 pi times the frequency", 1.0, -2),
    _Quantity("displacement in mm", "multiply by -omega² / 1000", 1e3, -2),
    _Quantity("displacement in µm", "multiply by -omega² / 1000000", 1e6, -2),
)


@dataclass(frozen=True)
class _Options:
    """Options of `diagnose`, and the findings about sensors that were left out so far."""

    false_alarm: float
    has_form: bool
    refuses: bool
    skipped: tuple[Finding, ...] = ()


def diagnose(
    rig: Rig,
    observation: Measurement,
    *,
    false_alarm: float = FALSE_ALARM,
    has_form: bool = False,
    refuses: bool = False,
) -> Verdict:
    """Compare a measurement with the rig's prediction.

    - false_alarm: false-alarm rate on correct plates.
    - has_form: whether to include form errors, and search for differences beyond their tolerances
      (needs sensors of known scale).
    - refuses: whether responses that contradict their metadata are an error.

    Raises InputError for fewer than three usable sensors or four frequencies.
    """
    return _diagnosed(rig, observation, _Options(false_alarm, has_form, refuses))


def _diagnosed(rig: Rig, observation: Measurement, options: _Options) -> Verdict:
    """Compare a measurement with the rig's prediction; see `diagnose`."""
    plate, observation, dead, silent = _without_silent_sensors(rig, observation)
    options = replace(options, skipped=options.skipped + silent)
    live = replace(observation, values=np.where(dead, np.nan, observation.values))
    shapes = match_shapes(plate, live.values)
    reverse = reversed_axes(plate, shapes, live, may_be_plugs=options.refuses)
    if reverse:
        return _corrected(reverse, options)
    misread = other_meaning(plate, shapes, live)
    if misread:
        return _corrected_board(misread, observation, options)
    if dead.any():
        shapes = match_shapes(plate, observation.values)
    if options.refuses:
        _check_quantity(plate, shapes, observation.values)
        _check_phases(plate, shapes, observation.values)
    dead |= _dead_channels(plate, observation.values, shapes)
    values = np.where(dead, np.nan, observation.values)
    if not np.isfinite(values).any():
        return _verdict_without_response(rig, observation, dead, options)
    shapes = replace(shapes, mac=np.where(dead[:, None], np.nan, shapes.mac))
    match = best_wiring(plate, values, shapes)
    exchanged = exchanged_sensors(match, observation)
    if exchanged:
        return _corrected(exchanged, options)
    match = _matched_to_noise(match, shapes)
    off_scale = _off_scale_sensors(match)
    if off_scale and len(observation.names) - len(off_scale) >= LEAST_SENSORS:
        is_off = np.isin(observation.names, [finding.of for finding in off_scale])
        options = replace(options, refuses=False, skipped=(*options.skipped, *off_scale))
        return _diagnosed(rig, observation.without(is_off), options)
    return _matched_verdict(match, observation, dead, options)


def _without_silent_sensors(
    rig: Rig, observation: Measurement
) -> tuple[SensedPlate, Measurement, NDArray[np.bool_], tuple[Finding, ...]]:
    """Leave out silent sensors.

    Returns the rig's plate, the measurement, a mask (n,) of dead channels, and the findings. Raises
    InputError if too few sensors or frequencies remain for a diagnosis.
    """
    if not np.isfinite(observation.values).any():
        raise InputError("no channel was driven; drive each in turn and measure again")
    check_enough_sensors(np.ones(len(observation.names), dtype=bool), observation)
    if len(observation.frequencies) < _LEAST_FREQUENCIES:
        raise InputError(
            f"a diagnosis needs at least {_LEAST_FREQUENCIES} frequencies, got "
            f"{len(observation.frequencies)}"
        )
    plate = plate_of(rig, observation)
    dead = _dead_channels(plate, observation.values)
    live = replace(observation, values=np.where(dead, np.nan, observation.values))
    silent = silent_sensors(live)
    if not live.count or not silent.any():
        return plate, observation, dead, ()
    check_enough_sensors(~silent, observation)
    findings = tuple(Finding("silent", name) for name in compress(observation.names, silent))
    audible = observation.without(silent)
    return plate_of(rig, audible), audible, dead, findings


def _corrected(correction: Correction, options: _Options) -> Verdict:
    """Return the verdict on a corrected rig and measurement, including the error of the file."""
    finding, rig, observation = correction
    if options.refuses:
        raise InputError(finding.rule)
    verdict = _diagnosed(rig, observation, options)
    return replace(verdict, findings=(finding, *verdict.findings))


def _corrected_board(
    correction: Correction, observation: Measurement, options: _Options
) -> Verdict:
    """Return the verdict on a board whose file has a value the wrong way round.

    Only the file is judged; the plate is checked after it is corrected. observation: including
    dead channels.
    """
    finding, rig, _ = correction
    verdict = _corrected((finding, rig, observation), replace(options, has_form=False))
    findings = tuple(finding for finding in verdict.findings if finding.about != "plate")
    return replace(verdict, findings=findings, plate_matches=False, changes=None)


def _verdict_without_response(
    rig: Rig, observation: Measurement, dead: NDArray[np.bool_], options: _Options
) -> Verdict:
    """Return the verdict if no channel moves the plate."""
    channels = tuple(
        _without_response(rig, number, is_dead=is_dead)
        for number, is_dead in enumerate(dead.tolist())
    )
    return with_findings(
        Verdict(channels, observation.names, observation.frequencies, options.skipped)
    )


def _matched_to_noise(match: Match, shapes: ShapeMatch) -> Match:
    """Match again if there is more noise than usual, because parameters are then less certain."""
    error = float(np.clip(_MORE_NOISE * match.median_error, MODEL_ERROR, _MAX_MODEL_ERROR))
    if error <= MODEL_ERROR:
        return match
    return match_plate(
        match.plate, match.values, drives=match.drives, model_error=error, starts=shapes.starts
    )


def _matched_verdict(
    match: Match, observation: Measurement, dead: NDArray[np.bool_], options: _Options
) -> Verdict:
    """Judge the plate of a match, then the channels by the plate that explains them best.

    dead: mask (n,) of dead channels.
    """
    rig = match.plate.rig
    nominal = match
    beyond: list[Finding] = []
    if options.has_form:
        with_form, beyond = match_beyond(match)
        if with_form.error <= MAX_FORM_ERROR:
            match = with_form
    # Values that absorb an even less likely form error prove nothing on their own.
    limit = min([options.false_alarm, *(finding.chance for finding in beyond)])
    plate_matches = match.error <= MAX_FIT_ERROR and match.chance >= limit
    findings = options.skipped
    hypotheses: list[Hypothesis] = []
    if plate_matches:
        findings += tuple(beyond)
    else:
        hypotheses = compare_hypotheses(nominal)
    fitted = likeliest([match, *(hypothesis.match for hypothesis in hypotheses)])
    loose = _behind_glue(fitted)
    if not plate_matches:
        loose |= _loosened(match, hypotheses)
    changes = None
    if match.error <= MAX_FIT_ERROR:
        changes = plate_changes(rig, match)
    channels = _channels(fitted, rig, loose, dead, has_phases=observation.has_phases)
    verdict = Verdict(
        channels=tuple(channels),
        sensors=observation.names,
        frequencies=observation.frequencies,
        findings=findings,
        plate_matches=plate_matches,
        match=match,
        hypotheses=tuple(hypotheses),
        changes=changes,
    )
    return with_findings(verdict)


def _dead_channels(
    plate: SensedPlate, values: ComplexArray, shapes: ShapeMatch | None = None
) -> NDArray[np.bool_]:
    """Mask (n,) of driven channels with values (f, s, n) far below the model's.

    shapes: if given, weak channels without the shape of an ERA, whose response is noise, count too.
    """
    relative = np.abs(values / plate.responses())
    size = np.array([typical(relative[..., number]) for number in range(relative.shape[2])])
    dead: NDArray[np.bool_] = size < _DEAD
    if shapes is not None:
        best_mac = np.nan_to_num(shapes.medians).max(axis=1)
        dead |= (size < _FAINT) & (best_mac < _NO_SHAPE)
    return dead


def _off_scale_sensors(match: Match) -> list[Finding]:
    """Find sensors whose scale differs from the others', if the plate fits."""
    if match.median_error > MAX_FIT_ERROR:
        return []
    is_used = np.isfinite(match.values) & np.isfinite(match.predicted) & ~match.outliers
    model = np.where(is_used, match.predicted, 0)
    measured = np.where(is_used, match.values, 0)
    inner = model.conj() * measured
    inner = inner * np.exp(-1j * np.angle(inner.sum(axis=1, keepdims=True)))
    power = (np.abs(model) ** 2).sum(axis=(0, 2))
    scales = inner.real.sum(axis=(0, 2)) / np.maximum(power, 1e-300)
    scales = scales / np.median(scales)
    lowest, highest = _SENSOR_SCALE
    findings = []
    for name, scale in zip(match.fit.measurement.names, scales.tolist(), strict=True):
        if not lowest <= scale <= highest:
            findings.append(Finding(_scale_fault(scale), name, scale))
    return findings


def _scale_fault(scale: float) -> str:
    """Return the kind of finding for a sensor with a scale."""
    if scale < _UPSIDE_DOWN:
        return "upside down"
    return "mute" if abs(scale) < _MUTE else "off scale"


def _channels(
    match: Match, rig: Rig, loose: set[int], dead: NDArray[np.bool_], *, has_phases: bool
) -> Iterator[ChannelVerdict]:
    """Judge all channels of a rig with the best-fitting plate.

    loose: indices of channels with a loose exciter; dead (n,): mask of channels; has_phases:
    whether phases are relative to the drives.
    """
    shapes = match_responses(match.responses, match.values)
    for number, is_dead in enumerate(dead.tolist()):
        if is_dead or not np.isfinite(match.values[..., number]).any():
            yield _without_response(rig, number, is_dead=is_dead)
        else:
            is_loose = number in loose
            yield _channel(match, rig, shapes, number, is_loose=is_loose, has_phases=has_phases)


def _channel(
    match: Match, rig: Rig, shapes: ShapeMatch, number: int, *, is_loose: bool, has_phases: bool
) -> ChannelVerdict:
    """Judge a channel with a response, by index; see `_channels`."""
    driven = match.drives[number]
    phase, coherence = None, 0.0
    if has_phases:
        is_outlier = match.outliers[..., number]
        predicted = np.where(is_outlier, np.nan, match.predicted[..., number])
        phase, coherence = mean_phase(match.values[..., number], predicted)
    gain = _relative_gain(match, rig, number)
    strong_gain = _strong_gain(rig, number)
    states = []
    if is_loose:
        states.append("loose")
    if driven != number:
        states.append("other ERA")
    if gain > strong_gain:
        states.append("strong")
    elif gain < 1 / strong_gain and not is_loose:
        states.append("weak")
    states += _phase_states(phase)
    rivals = [rival for rival in range(len(rig.eras)) if rival != driven]
    confidence = min(shapes.confidence(number, driven, rival) for rival in rivals)
    if "inverted" in states:
        confidence = min(confidence, coherence)
    era = rig.eras[number]
    wired = rig.wiring[era.name]
    mac = shapes.medians[number]
    return ChannelVerdict(
        era=era.name,
        amplifier=wired.amplifier,
        channel=wired.number,
        states=tuple(states) or ("well",),
        drives=rig.eras[driven].name,
        gain=gain,
        phase=phase,
        mac_own=float(mac[number]),
        mac_found=float(mac[driven]),
        confidence=confidence,
    )


def _relative_gain(match: Match, rig: Rig, number: int) -> float:
    """Return the gain of a channel relative to the gain of the ERA that it drives."""
    era = rig.eras[number]
    driven = rig.eras[match.drives[number]]
    # Commands are shares of the stroke of the ERA to which the rig wires the channel.
    gain = float(match.gains[number]) * era.full_level / driven.full_level
    return gain / float(np.median(np.abs(driven.gain(match.plate.frequencies))))


def _strong_gain(rig: Rig, number: int) -> float:
    """Return the gain from which a channel is strong."""
    uncertainty = rig.uncertainty
    # Responses cannot separate a force factor from a gain.
    force_std = 0.0 if isinstance(rig.eras[number], Era) else uncertainty.stiffness
    return max(STRONG, math.exp(_GAIN_STDS * math.hypot(uncertainty.gain, force_std)))


def _phase_states(phase: float | None) -> list[str]:
    """Return the problem of a phase error [degrees], if it is one."""
    if phase is None or abs(phase) <= _MAX_PHASE_ERROR:
        return []
    return ["inverted"] if abs(phase) >= 90 else ["out of phase"]


def _without_response(rig: Rig, number: int, *, is_dead: bool) -> ChannelVerdict:
    """Verdict on a channel that is dead or was not driven."""
    name = rig.eras[number].name
    wired = rig.wiring[name]
    if not is_dead:
        return ChannelVerdict(name, wired.amplifier, wired.number, ("not driven",))
    return ChannelVerdict(
        name, wired.amplifier, wired.number, ("dead",), gain=0.0, confidence=_DEAD_CONFIDENCE
    )


def mean_phase(measured: ComplexArray, predicted: ComplexArray) -> tuple[float | None, float]:
    """Return the mean phase [degrees] of values (f, s) relative to predicted ones, and its
    coherence.

    The phase is None if the coherence (0 to 1) is too low.
    """
    products = predicted.conj() * measured
    inner = np.where(np.isfinite(products), products, 0).sum(axis=1)
    inner = inner[np.abs(inner) > 0]
    if not len(inner):
        return None, 0.0
    mean = complex(np.mean(inner / np.abs(inner)))
    if abs(mean) < _MIN_COHERENCE:
        return None, abs(mean)
    return math.degrees(np.angle(mean)), abs(mean)


def _loosened(match: Match, hypotheses: Sequence[Hypothesis]) -> set[int]:
    """Return the channels of exciters that differ most, or are the likeliest hypothesis.

    Each acts with less than its own stiffness.
    """
    rig = match.plate.rig
    parameters = match.plate.parameters
    farthest = parameters[best_of(np.abs(match.z))].era
    shares = []
    for hypothesis in hypotheses[:1]:
        if hypothesis.era:
            shares.append((hypothesis.era, hypothesis.value / hypothesis.expected))
    for parameter in parameters:
        if parameter.era and parameter.era == farthest and parameter.is_factor:
            shares.append((parameter.era, parameter.of(match.rig) / parameter.of(rig)))
    loose = set()
    for era, share in shares:
        if share <= LOOSE and isinstance(rig.era(era), Exciter):
            loose.add(era)
    return {n for n, number in enumerate(match.drives) if rig.eras[number].name in loose}


def _behind_glue(match: Match) -> set[int]:
    """Return the channels whose exciter clearly acts through a spring of glue.

    A spring z between coil and plate gives gains g_f ~ G |z / (z + D(w_f))|, where the dynamic
    stiffness D of the exciter decreases above the resonance of the magnet: the gain rises with
    frequency. A change common to all channels comes from the amplifier.
    """
    values = np.where(match.outliers, np.nan, match.values)
    gains = np.abs(gains_of(match.responses[..., match.drives], values))
    sizes = np.log(np.where(gains > 0, gains, np.nan))
    driven = np.flatnonzero(np.isfinite(sizes).any(axis=0)).tolist()
    if len(driven) < _MIN_CHANNELS:
        return set()
    sizes[:, driven] -= np.nanmedian(sizes[:, driven], axis=0)
    glued = set()
    for number in driven:
        rivals = [rival for rival in driven if rival != number]
        size = sizes[:, number] - np.nanmedian(sizes[:, rivals], axis=1)
        exciter = match.rig.eras[match.drives[number]]
        if isinstance(exciter, Exciter) and _rises_like_glue(size, exciter, match.plate.omega):
            glued.add(number)
    return glued


def _rises_like_glue(size: FloatArray, exciter: Exciter, omega: FloatArray) -> bool:
    """Whether a spring of glue explains the logarithms of an exciter's gains (f,) clearly."""
    stiffness = exciter.dynamic_stiffness(omega)
    transmitted = -np.log(np.abs(1 + stiffness / _GLUES[:, None]))  # (glues, f)
    residuals = np.vstack([size, size - transmitted])
    residuals -= np.nanmedian(residuals, axis=1, keepdims=True)
    without_glue, *with_glue = np.nanmedian(np.abs(residuals), axis=1).tolist()
    best = int(np.argmin(with_glue))
    rise = np.ptp(transmitted[best][np.isfinite(size)])
    return bool(with_glue[best] < _EXPLAINS * without_glue and rise > _RISES)


def plate_changes(rig: Rig, match: Match) -> dict[str, float]:
    """Return relative differences of the most probable plate from a rig's, by kind of value.

    For ERAs, the mean; bolts are skipped, since most rigs have no bolt mass.
    """
    changes = {}
    for kind in ("modulus", "loss_factor", "stiffness", "damping"):
        relative = []
        for parameter in match.plate.parameters:
            if parameter.kind == kind and parameter.of(rig):
                relative.append(parameter.of(match.rig) / parameter.of(rig) - 1)
        if relative:
            changes[kind] = float(np.mean(relative))
    return changes


def judged_by_promises(verdict: Verdict, rig: Rig) -> Verdict:
    """Add the margins of the promises of the rig's table, on the matched plate.

    Returns the verdict unchanged if no plate fits, or if the rig has no table or no room for four
    fingers.
    """
    if verdict.match is None or verdict.changes is None:
        return verdict
    # The plate of a table has no finger on it.
    loads: list[object] = [*verdict.match.rig.masses]
    masses = tuple(load for load in loads if isinstance(load, PointLoad))
    margins = promise_margins(rig, replace(verdict.match.rig, masses=masses))
    findings = verdict.findings
    if margins:
        missed = -float(np.median(margins))
        if missed > MISSED_DB:
            findings = (*findings, Finding("promise", "table", missed))
    return replace(verdict, promise_margins=margins, findings=findings)


def check_meaning(rig: Rig, measurement: Measurement) -> None:
    """Raise InputError for a rig whose grain or resonances are clearly the wrong ones.

    Also for a plate that was not linear, or that has changed during the measurement.
    """
    measurement.check()
    observation = replace(measurement, errors=None, has_phases=False)  # bases lag
    plate = plate_of(rig, observation)
    misread = other_meaning(plate, match_shapes(plate, observation.values), observation)
    if misread:
        finding, _, _ = misread
        raise InputError(finding.rule)


def _check_quantity(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> None:
    """Raise InputError if the gains of all channels indicate another quantity or unit."""
    model = plate.responses(plate.start(*shapes.start))[..., shapes.nearest]
    gains = gains_of(model, values)
    sizes = np.log(row_rms(values) / row_rms(model))[:, 0]
    is_driven = np.isfinite(gains)
    omega = plate.omega[:, None]

    def distance(quantity: _Quantity) -> float:
        """Return the distance of gains from the gains of a quantity, in size and phase."""
        expected = quantity.factor * (1j * omega) ** quantity.power
        size_error = np.abs(sizes - np.log(np.abs(expected)))[is_driven]
        phase_error = np.angle(gains / expected)[is_driven]
        return float(np.median(size_error) + 1 - np.median(np.cos(phase_error)))

    level = float(np.median(sizes[is_driven]))
    nearest = best_by(_WRONG_QUANTITIES, lambda quantity: -distance(quantity))
    gap = distance(nearest)
    if abs(level) < np.log(_MAX_GAIN) or distance(_RIGHT_QUANTITY) < gap:
        return
    ratio = f"{np.exp(level):.3g} times the prediction"
    if gap < np.log(_MAX_GAIN):
        raise InputError(
            "responses must be acceleration per base displacement in 1/s²; values appear to be in "
            f"{nearest.name}: all are {ratio}; {nearest.remedy}"
        )
    raise InputError(
        f"responses must match the rig within a factor of {_MAX_GAIN:g}, got {ratio}; check their "
        "unit and the stroke of the ERAs"
    )


def _check_phases(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> None:
    """Raise InputError for conjugated phases."""
    match = best_wiring(plate, values, shapes)
    conjugate = best_wiring(plate, values.conj(), shapes)
    if conjugate.fit.cost < match.fit.cost - MIN_COST_REDUCTION:
        raise InputError(
            "phases must be for exp(+i omega t), but appear to be conjugated: with the signs of "
            "all imaginary parts changed, the model fits better "
            f"({100 * conjugate.error:.1f} % unexplained instead of {100 * match.error:.1f} %); "
            "change the signs"
        )
