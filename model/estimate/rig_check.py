"""Rig check: compare measured responses with a rig.

`diagnose` first looks for errors in the rig file that describe another plate, then matches plate
and wiring (`model.estimate.plate_match`), and returns a `Verdict` with the state of each channel
and the findings of `model.estimate.findings`.

Before a fit (`model.estimate.screening`), it also rejects responses that contradict their
metadata. Each check looks for one error among the parameters that the fit leaves free.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray
from model.errors import InputError
from model.estimate.findings import MAX_FORM_ERROR, match_beyond, with_findings
from model.estimate.hypotheses import Hypothesis, compare_hypotheses
from model.estimate.loose_exciters import channels_behind_glue, loosened_channels
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
    MODEL_ERROR,
    Match,
    best_wiring,
    likeliest,
    match_plate,
)
from model.estimate.quantity_check import check_phases, check_quantity
from model.estimate.sensed_plate import SensedPlate, plate_of
from model.estimate.shape_match import ShapeMatch, match_responses, match_shapes
from model.estimate.verdict import ChannelVerdict, Finding, Verdict
from model.rig.rig import Rig
from model.structure.attachments import PointLoad
from model.structure.sources import Era
from model.study.expected_contrast import promise_margins

STRONG = 1.25
"""Gain from which a channel is strong, or weak below its inverse: 2 dB.

That is four times the tolerance of drives.
"""

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
        check_quantity(plate, shapes, observation.values)
        check_phases(plate, shapes, observation.values)
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
    loose = channels_behind_glue(fitted)
    if not plate_matches:
        loose |= loosened_channels(match, hypotheses)
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
