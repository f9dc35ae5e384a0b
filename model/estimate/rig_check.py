"""Rig check: compare measured responses with a rig.

`diagnose` first looks for errors in the rig file that describe another plate, then matches plate
and wiring (`model.estimate.plate_match`), and returns a `Verdict` with the state of each channel
and the findings of `model.estimate.findings`.

Before a fit (`model.estimate.calibrate.check_consistency`), it also rejects responses that
contradict their metadata. Each check looks for one error among the parameters that the fit leaves
free.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, best_by, best_of
from model.errors import InputError
from model.estimate.findings import (
    MAX_FORM_ERROR,
    ChannelVerdict,
    Correction,
    Finding,
    Verdict,
    cycles,
    exchanged_sensors,
    match_beyond,
    other_meaning,
    reversed_axes,
    with_findings,
)
from model.estimate.fit import SensedPlate, gains_of, plate_of, row_rms
from model.estimate.measurement import (
    LEAST_SENSORS,
    Measurement,
    check_enough_sensors,
    silent_sensors,
    typical,
)
from model.estimate.plate_match import (
    FALSE_ALARM,
    MAX_FIT_ERROR,
    MIN_COST_REDUCTION,
    MODEL_ERROR,
    Hypothesis,
    Match,
    ShapeMatch,
    best_wiring,
    compared,
    likeliest,
    match_plate,
    match_responses,
    match_shapes,
)
from model.quantities import percent
from model.rig.rig import Rig
from model.structure.attachments import GRAVITY, Era, PointLoad
from model.structure.exciter import Exciter
from model.study.expected_contrast import promise_margins
from model.study.verification import MIN_KEPT_SHARE

STRONG = 1.25
"""Gain from which a channel is strong, or weak below its inverse: 2 dB.

That is four times the variation of drives.
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
_SENSOR_SCALE = (0.7, 1.4)
_MUTE = 0.1  # of the others' scale
_UPSIDE_DOWN = -0.5
_MIN_CHANGE = 0.03  # relative, of a reported value

_GLUES = np.geomspace(100.0, 1e5, 61)  # N/m
_RISES = 0.2  # of the logarithm of a gain over the frequencies
_EXPLAINS = 0.6  # of the median deviation without glue
_MIN_CHANNELS = 3  # whose median shows a common error of the amplifier

_MAX_GAIN = 3.0  # of all channels together; a factor either way is another quantity or unit
_QUANTITIES = (
    ("g", f"multiply by {GRAVITY}", 1 / GRAVITY, 0),
    ("mm/s² per m", "divide by 1000", 1e3, 0),
    ("m/s² per mm", "multiply by 1000", 1e-3, 0),
    ("m/s² per µm", "multiply by 1000000", 1e-6, 0),
    ("g per mm", f"multiply by {1000 * GRAVITY}", 1e-3 / GRAVITY, 0),
    ("g per µm", f"multiply by {1e6 * GRAVITY}", 1e-6 / GRAVITY, 0),
    ("velocity in m/s", "multiply by i omega, 2 pi times the frequency", 1.0, -1),
    ("velocity in mm/s", "multiply by i omega / 1000", 1e3, -1),
    ("displacement in m", "multiply by -omega², omega 2 pi times the frequency", 1.0, -2),
    ("displacement in mm", "multiply by -omega² / 1000", 1e3, -2),
    ("displacement in µm", "multiply by -omega² / 1000000", 1e6, -2),
)
"""Quantities that responses may be by mistake: name, remedy, factor and power.

They are factor * (i omega)^power times acceleration per displacement.
"""


def diagnose(
    rig: Rig,
    observation: Measurement,
    *,
    false_alarm: float = FALSE_ALARM,
    has_form: bool = False,
    refuses: bool = False,
    skipped: tuple[Finding, ...] = (),
) -> Verdict:
    """Compare a measurement with the rig's prediction.

    - false_alarm: false-alarm rate on correct plates.
    - has_form: whether to include form errors, and search for deviations beyond their tolerances
      (needs sensors of known scale).
    - refuses: whether responses that contradict their metadata are an error.
    - skipped: findings about sensors that were left out before.

    Raises InputError for fewer than three usable sensors or four frequencies.
    """
    plate, observation, dead, silent = _heard(rig, observation)
    skipped += silent

    def corrected(found: Correction, *, has_form: bool) -> Verdict:
        """Return the verdict on the corrected rig and measurement, including the error found."""
        correction, rig, observation = found
        if refuses:
            raise InputError(correction.rows[0].partition(": ")[2])
        verdict = diagnose(
            rig, observation, false_alarm=false_alarm, has_form=has_form, skipped=skipped
        )
        return replace(verdict, findings=(correction, *verdict.findings))

    live = replace(observation, values=np.where(dead, np.nan, observation.values))
    shapes = match_shapes(plate, live.values)
    if reverse := reversed_axes(plate, shapes, live, may_be_plugs=refuses):
        return corrected(reverse, has_form=has_form)
    if other := other_meaning(plate, shapes, live):
        verdict = corrected((*other[:2], observation), has_form=False)
        # The board of the file is corrected first.
        kept = tuple(each for each in verdict.findings if each.about != "plate")
        return replace(verdict, findings=kept, plate_matches=False, changes=None)
    if dead.any():
        shapes = match_shapes(plate, observation.values)
    if refuses:
        _check_quantity(plate, shapes, observation.values)
        _check_phases(plate, shapes, observation.values)
    dead |= _dead_channels(plate, observation.values, shapes)
    values = np.where(dead, np.nan, observation.values)
    if not np.isfinite(values).any():
        channels = tuple(_without_response(rig, n, is_dead=bool(dead[n])) for n in range(len(dead)))
        return with_findings(Verdict(channels, observation.names, observation.frequencies, skipped))
    shapes = replace(shapes, mac=np.where(dead[:, None], np.nan, shapes.mac))
    match = best_wiring(plate, values, shapes)
    if exchanged := exchanged_sensors(match, observation):
        return corrected(exchanged, has_form=has_form)
    # With more noise than usual parameters are less certain.
    error = float(np.clip(1.2 * match.median_error, MODEL_ERROR, 0.3))
    if error > MODEL_ERROR:
        match = match_plate(
            plate, values, drives=match.drives, model_error=error, starts=shapes.starts
        )
    off = _off_scale(match)
    if off and len(observation.names) - len(off) >= LEAST_SENSORS:
        wrong = np.isin(observation.names, [each.of for each in off])
        return diagnose(
            rig,
            observation.without(wrong),
            false_alarm=false_alarm,
            has_form=has_form,
            skipped=(*skipped, *off),
        )
    return _matched_verdict(
        match, observation, dead, has_form=has_form, false_alarm=false_alarm, skipped=skipped
    )


def _heard(
    rig: Rig, observation: Measurement
) -> tuple[SensedPlate, Measurement, NDArray[np.bool_], tuple[Finding, ...]]:
    """Leave out silent sensors.

    Returns the rig's plate at the others, what these measured, a mask (n,) of dead channels and the
    findings of the silent ones. Raises InputError where too little is left to say anything.
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
    found = tuple(Finding("silent", name) for name in compress(observation.names, silent))
    observation = observation.without(silent)
    return plate_of(rig, observation), observation, dead, found


def _matched_verdict(
    match: Match,
    observation: Measurement,
    dead: NDArray[np.bool_],
    *,
    false_alarm: float,
    has_form: bool,
    skipped: tuple[Finding, ...],
) -> Verdict:
    """Judge the plate of a match, then the channels by the plate that explains them best.

    dead: mask (n,) of dead channels; further parameters as `diagnose`.
    """
    rig, nominal, beyond = match.plate.rig, match, list[Finding]()
    if has_form:
        with_form, beyond = match_beyond(match)
        match = with_form if with_form.error <= MAX_FORM_ERROR else match
    # Values that absorb an even less likely form error prove nothing on their own.
    limit = min([false_alarm, *(each.chance for each in beyond)])
    matches = match.error <= MAX_FIT_ERROR and match.chance >= limit
    hypotheses = [] if matches else compared(nominal)
    fitted = likeliest([match, *(each.match for each in hypotheses)])
    loose = _behind_glue(fitted) | (set() if matches else _loosened(match, hypotheses))
    verdict = Verdict(
        tuple(_channels(fitted, rig, loose, dead, has_phases=observation.has_phases)),
        observation.names,
        observation.frequencies,
        (*skipped, *(beyond if matches else ())),
        matches,
        match,
        tuple(hypotheses),
        plate_changes(rig, match) if match.error <= MAX_FIT_ERROR else None,
    )
    return with_findings(verdict)


def _dead_channels(
    plate: SensedPlate, values: ComplexArray, shapes: ShapeMatch | None = None
) -> NDArray[np.bool_]:
    """Mask (n,) of driven channels with values (f, s, n) far below the model's.

    shapes: if given, weak channels without the shape of an ERA, whose response is noise, count too.
    """
    share = np.abs(values / plate.responses())
    size = np.array([typical(share[..., number]) for number in range(share.shape[2])])
    dead = size < _DEAD
    if shapes is not None:
        best = np.nan_to_num(shapes.medians).max(axis=1)
        dead |= (size < _FAINT) & (best < _NO_SHAPE)
    return np.asarray(dead)


def _off_scale(match: Match) -> list[Finding]:
    """Find sensors whose scale differs from the others', if the plate fits."""
    if match.median_error > MAX_FIT_ERROR:
        return []
    known = np.isfinite(match.values) & np.isfinite(match.predicted) & ~match.outliers
    model, measured = np.where(known, match.predicted, 0), np.where(known, match.values, 0)
    inner = model.conj() * measured
    inner = inner * np.exp(-1j * np.angle(inner.sum(axis=1, keepdims=True)))
    power = (np.abs(model) ** 2).sum(axis=(0, 2))
    scales = inner.real.sum(axis=(0, 2)) / np.maximum(power, 1e-300)
    found, names = [], match.fit.measurement.names
    for name, scale in zip(names, (scales / np.median(scales)).tolist(), strict=True):
        if not _SENSOR_SCALE[0] <= scale <= _SENSOR_SCALE[1]:
            kind = "mute" if abs(scale) < _MUTE else "off scale"
            found.append(Finding("upside down" if scale < _UPSIDE_DOWN else kind, name, scale))
    return found


def _channels(
    match: Match, rig: Rig, loose: set[int], dead: NDArray[np.bool_], *, has_phases: bool
) -> Iterator[ChannelVerdict]:
    """Judge all channels of a rig with the best-fitting plate.

    loose: indices of channels with a loose exciter; dead (n,): mask of channels; has_phases:
    whether phases are relative to the drives.
    """
    shapes, values = match_responses(match.responses, match.values), match.values
    predicted, known = np.where(match.outliers, np.nan, match.predicted), rig.uncertainty
    for n, driven in enumerate(match.drives):
        era, own = rig.eras[n], rig.eras[driven]
        if dead[n] or not np.isfinite(values[..., n]).any():
            yield _without_response(rig, n, is_dead=bool(dead[n]))
            continue
        # Commands are shares of the stroke of the ERA to which the rig wires the channel.
        gain = float(match.gains[n]) * era.full_level / own.full_level
        gain /= float(np.median(np.abs(own.gain(match.plate.model.frequencies))))
        others = (other for other in range(len(dead)) if other != driven)
        confidence = min(shapes.confidence(n, driven, other) for other in others)
        phase, coherence = None, 0.0
        if has_phases:
            phase, coherence = mean_phase(values[..., n], predicted[..., n])
        states = ["other ERA"] if driven != n else []
        # Responses cannot separate a force factor from a gain.
        varies = 0.0 if isinstance(era, Era) else known.stiffness
        strong = max(STRONG, math.exp(_GAIN_STDS * math.hypot(known.gain, varies)))
        if not 1 / strong <= gain <= strong:
            states.append("weak" if gain < 1 else "strong")
        if phase is not None and abs(phase) >= 90:
            states.append("inverted")
            confidence = min(confidence, coherence)
        elif phase is not None and abs(phase) > _MAX_PHASE_ERROR:
            states.append("out of phase")
        if n in loose:
            states = ["loose", *(each for each in states if each != "weak")]
        wired, mac = rig.wiring[era.name], shapes.medians[n]
        yield ChannelVerdict(
            era.name,
            wired.amplifier,
            wired.number,
            tuple(states) or ("well",),
            own.name,
            gain,
            phase,
            float(mac[n]),
            float(mac[driven]),
            confidence,
        )


def _without_response(rig: Rig, number: int, *, is_dead: bool) -> ChannelVerdict:
    """Verdict on a channel that is dead or was not driven."""
    name = rig.eras[number].name
    wired = rig.wiring[name]
    found = ChannelVerdict(name, wired.amplifier, wired.number, ("not driven",))
    return replace(found, states=("dead",), gain=0.0, confidence=0.99) if is_dead else found


def mean_phase(measured: ComplexArray, predicted: ComplexArray) -> tuple[float | None, float]:
    """Return the mean phase [degrees] of values (f, s) relative to predicted ones, and its
    coherence.

    The phase is None if the coherence (0 to 1) is too low.
    """
    products = predicted.conj() * measured
    inner = np.where(np.isfinite(products), products, 0).sum(axis=1)
    inner = inner[np.abs(inner) > 0]
    mean = complex(np.mean(inner / np.abs(inner))) if len(inner) else 0j
    reliable = abs(mean) >= _MIN_COHERENCE
    return (math.degrees(np.angle(mean)) if reliable else None), abs(mean)


def _loosened(match: Match, hypotheses: Sequence[Hypothesis]) -> set[int]:
    """Return the channels of exciters that differ most, or are the likeliest hypothesis.

    Each acts with less than its own stiffness.
    """
    rig, rows = match.plate.rig, match.plate.rows
    farthest = rows[best_of(np.abs(match.z))].era
    shares = [(each.era, each.value / each.expected) for each in hypotheses[:1] if each.era]
    acts = [row for row in rows if row.era and row.era == farthest and row.is_factor]
    shares += [(row.era, row.of(match.rig) / row.of(rig)) for row in acts]
    found = {era for era, share in shares if share <= LOOSE and isinstance(rig.era(era), Exciter)}
    return {n for n, number in enumerate(match.drives) if rig.eras[number].name in found}


def _behind_glue(match: Match) -> set[int]:
    """Return the channels whose exciter clearly acts through a spring of glue.

    A spring z between coil and plate gives gains g_f ~ G |z / (z + D(w_f))|, where the dynamic
    stiffness D of the exciter decreases above the resonance of the magnet: the gain rises with
    frequency. A change common to all channels comes from the amplifier.
    """
    drives, kept = match.drives, np.where(match.outliers, np.nan, match.values)
    gains = np.abs(gains_of(match.responses[..., drives], kept))
    sizes = np.log(np.where(gains > 0, gains, np.nan))
    driven: NDArray[np.bool_] = np.asarray(np.isfinite(sizes).any(axis=0))
    if driven.sum() < _MIN_CHANNELS:
        return set()
    sizes[:, driven] -= np.nanmedian(sizes[:, driven], axis=0)
    found = set()
    for n in np.flatnonzero(driven).tolist():
        era, others = match.rig.eras[drives[n]], driven & (np.arange(len(drives)) != n)
        own = sizes[:, n] - np.nanmedian(sizes[:, others], axis=1)
        if isinstance(era, Exciter):
            stiffness = era.dynamic_stiffness(match.plate.model.omega)
            through = -np.log(np.abs(1 + stiffness / _GLUES[:, None]))  # (glues, f)
            left = np.vstack([own, own - through])
            left -= np.nanmedian(left, axis=1, keepdims=True)
            without, *behind = np.nanmedian(np.abs(left), axis=1).tolist()
            best = int(np.argmin(behind))
            rise = np.ptp(through[best][np.isfinite(own)])
            if behind[best] < _EXPLAINS * without and rise > _RISES:
                found.add(n)
    return found


def plate_changes(rig: Rig, match: Match) -> dict[str, float]:
    """Return relative differences of the most probable plate from a rig's, by kind of value.

    For ERAs, the mean; bolts are skipped, since most rigs have no bolt mass.
    """
    changes = {}
    for kind in ("modulus", "loss_factor", "stiffness", "damping"):
        rows = [row for row in match.plate.rows if row.kind == kind and row.of(rig)]
        if rows:
            changes[kind] = float(np.mean([row.of(match.rig) / row.of(rig) - 1 for row in rows]))
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
    masses = tuple(each for each in loads if isinstance(each, PointLoad))
    margins = promise_margins(rig, replace(verdict.match.rig, masses=masses))
    missed = -float(np.median(margins)) if margins else 0.0
    found = [Finding("promise", "table", missed)] if missed > MISSED_DB else []
    return replace(verdict, promise_margins=margins, findings=(*verdict.findings, *found))


def check_meaning(rig: Rig, measurement: Measurement) -> None:
    """Raise InputError for a rig whose grain or resonances are clearly the wrong ones.

    Also for a plate that was not linear, or that has changed during the measurement.
    """
    measurement.check()
    observation = replace(measurement, errors=None, has_phases=False)  # bases lag
    plate = plate_of(rig, observation)
    found = other_meaning(plate, match_shapes(plate, observation.values), observation)
    if found:
        raise InputError(found[0].rows[0].partition(": ")[2])


def _check_quantity(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> None:
    """Raise InputError if the gains of all channels indicate another quantity or unit."""
    model = plate.model.at(plate.moved(*shapes.start)).responses[..., shapes.nearest]
    gains = gains_of(model, values)
    size = np.log(row_rms(values) / row_rms(model))[:, 0]
    known = np.isfinite(gains)
    omega = plate.model.omega[:, None]

    def distance(factor: float, power: int) -> float:
        """Return the distance of gains from a quantity's gains, in size and phase."""
        expected = factor * (1j * omega) ** power
        off = np.abs(size - np.log(np.abs(expected)))[known]
        phase = np.angle(gains / expected)[known]
        return float(np.median(off) + 1 - np.median(np.cos(phase)))

    level = float(np.median(size[known]))
    name, remedy, factor, power = best_by(_QUANTITIES, lambda each: -distance(*each[2:]))
    gap = distance(factor, power)
    if abs(level) < np.log(_MAX_GAIN) or distance(1.0, 0) < gap:
        return
    if gap < np.log(_MAX_GAIN):
        raise InputError(
            "responses must be acceleration per base displacement in 1/s²; values appear to be in "
            f"{name}: all are {np.exp(level):.3g} times the prediction; {remedy}"
        )
    raise InputError(
        f"responses must match the rig within a factor of {_MAX_GAIN:g}, got "
        f"{np.exp(level):.3g} times the prediction; check their unit and the stroke of the ERAs"
    )


def _check_phases(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> None:
    """Raise InputError for conjugated phases."""
    match, other = (best_wiring(plate, each, shapes) for each in (values, values.conj()))
    if other.fit.cost < match.fit.cost - MIN_COST_REDUCTION:
        raise InputError(
            "phases must be for exp(+i omega t), but appear to be conjugated: with the signs of "
            "all imaginary parts changed, the model fits better "
            f"({100 * other.error:.1f} % unexplained instead of {100 * match.error:.1f} %); "
            "change the signs"
        )


def verdict_rows(verdict: Verdict) -> list[str]:
    """Return lines of findings with their remedies, or a line that all is well."""
    rows = [row for each in verdict.findings for row in each.rows]
    if verdict.is_well and not verdict.about("sensor"):
        wiring = "WIRING WELL: every driven channel drives its own ERA"
        all_well = "ALL WELL: plate and channels match the rig"
        rows.append(wiring if difference_rows(verdict) else all_well)
    return rows


def difference_rows(verdict: Verdict) -> list[str]:
    """Line on a plate that keeps too little of the rig's promises; empty if it keeps enough."""
    kept = verdict.kept_share
    if verdict.changes is None or kept is None or kept >= MIN_KEPT_SHARE:
        return []
    names = {"loss_factor": "loss factor", "stiffness": "ERA stiffness", "damping": "ERA damping"}
    changes = ", ".join(
        f"{names.get(kind, kind)} {100 * change:+.0f} %"
        for kind, change in verdict.changes.items()
        if abs(change) >= _MIN_CHANGE
    )
    within = "within tolerances, but off its nominal values: " if verdict.plate_matches else ""
    if verdict.about("form"):
        within, changes = "", "in a way that no parameter describes"
    return [
        f"PLATE DIFFERS: {within}{changes or 'single ERAs or bolts'}; the plate keeps "
        f"{percent(kept)} of the promises of the rig's table: calibrate it with "
        "`era calibrate`"
    ]


def channel_table(verdict: Verdict) -> list[str]:
    """Table of the channels with a header line."""
    rows = [f"{'ERA':8} {'channel':12} {'drives':8} {'gain':>6} {'phase':>7} {'MAC':>6}  verdict"]
    for channel in verdict.channels:
        gain = "-" if channel.gain is None else f"{channel.gain:.2f}"
        phase = "-" if channel.phase is None else f"{channel.phase:+.0f}°"
        mac = "-" if channel.mac_found is None else f"{channel.mac_found:.3f}"
        rows.append(
            f"{channel.era:8} {f'{channel.amplifier}:{channel.channel}':12} "
            f"{channel.drives or '-':8} {gain:>6} {phase:>7} {mac:>6}  "
            f"{', '.join(channel.states)}"
        )
    return rows


def as_json(verdict: Verdict) -> dict[str, Any]:
    """Verdict as JSON; units are in the keys."""
    match, beyond = verdict.match, verdict.about("load", "form")
    corrections: dict[str, Any] = {
        "grain": None,
        "resonance_is": {},
        "exchanged_sensors": {},
        "reversed_axes": [],
    }
    for each in verdict.about("file"):
        corrections |= each.json
    return {
        "all_well": verdict.is_well,
        "channels": [
            {
                "era": channel.era,
                "amplifier": channel.amplifier,
                "channel": channel.channel,
                "states": list(channel.states),
                "drives": channel.drives,
                "gain": channel.gain,
                "phase_deg": channel.phase,
                "mac_of_the_rigs_era": channel.mac_own,
                "mac_of_the_era_found": channel.mac_found,
                "confidence": channel.confidence,
            }
            for channel in verdict.channels
        ],
        "swapped": [[each.era for each in cycle] for cycle in cycles(verdict.channels)],
        "wiring_matches": verdict.wiring_matches,
        "plate": {
            "matches": verdict.plate_matches,
            **corrections,
            "beyond": {
                "kind": beyond[0].kind,
                "thicker_at_end_of_x": None,
                "thicker_at_end_of_y": None,
                "farthest": None,
                "standard_deviations": None,
                **beyond[0].json,
                "loads": [load for each in beyond for load in each.json.get("loads", ())],
            }
            if beyond
            else None,
            "changes": verdict.changes or {},
            "kept_share": verdict.kept_share,
            "promise_margins_db": [*verdict.promise_margins],
            "unexplained": match and match.error,
            "farthest_standard_deviations": match and match.worst,
            "parameters": []
            if match is None
            else [
                {
                    "parameter": parameter.name,
                    "unit": parameter.unit,
                    "expected": parameter.of(match.plate.rig),
                    "found": parameter.of(match.rig),
                    "standard_deviations": float(z),
                }
                for parameter, z in zip(match.plate.rows, match.z, strict=True)
            ],
            "explanations": [
                {
                    "key": each.key,
                    "unit": each.unit,
                    "expected": each.expected,
                    "found": each.value,
                    "explains": each.explains,
                    "likelihood": each.share,
                    "unexplained": each.match.error,
                }
                for each in verdict.hypotheses
            ],
        },
        "bad_sensors": [
            {
                "sensor": each.of,
                "problem": each.rows[0]
                .removeprefix(f"SENSOR {each.of} ")
                .removesuffix(": left out"),
            }
            for each in verdict.about("sensor")
        ],
        "sensor_count": len(verdict.sensors),
        "drive_frequencies_hz": verdict.frequencies.tolist(),
        "findings": verdict_rows(verdict),
    }
