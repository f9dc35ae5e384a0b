"""Diagnosis of a rig's plate and channels by measured responses.

Which resonance the file of exciters gives: of the light coil alone, or of the glued magnet.

An exciter pushes a plate against its magnet: well above the resonance of that on the glued coil by
its whole force, far below it hardly, and with the opposite sign. A file that takes a sheet's
`free` resonance for the `mounted` one thus describes exciters of which all look reversed, and weak
by another factor at each frequency. With both meanings the plate is fitted as coarsely as for its
grain (`model.diagnosis.plate_match.match_shapes`); of twelve boards as bought the gains that are
left vary over frequency by 0.15 to 0.43 (standard deviation of their logarithms) with the right
one, and by 1.2 or more with the other.

What a rig's file says the wrong way round of two, found before anything is fitted to it.

What a rig's table promises, and what of it the plate keeps that a measurement is most like.

Whatever is off, contrast tells whether it matters.

Checks of measured responses before a rig is fitted to them: are they what they claim to be?

A fit can absorb almost any error of a measurement: gains take wrong units, springs a swapped plug,
outlier rejection whole sensors. Each check here looks for one such error alone, in what the fit
would leave free, and names it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray, best_by, best_of
from model.calibration.calibrate import wrong_size
from model.calibration.fit import SensedPlate, plate_of, project_gains, row_rms
from model.calibration.responses import LEAST_SENSORS, Responses, Screening, check_enough_sensors
from model.diagnosis.causes import (
    MAX_ERROR,
    BadSensor,
    BeyondTolerances,
    ExchangedSensors,
    Explanation,
    ReversedAxes,
    TurnedGrain,
    behind_glue,
    dead_channels,
    exchanged_sensors,
    explain,
    match_with_form,
    off_scale,
    reversed_axes,
    turned_grain,
    usable_sensors,
)
from model.diagnosis.plate_match import (
    FALSE_ALARM,
    MAX_FIT_ERROR,
    MODEL_ERROR,
    ChannelPhase,
    Match,
    ShapeMatch,
    match_plate,
    match_responses,
    match_shapes,
    phases_of_drive,
    plate_changes,
)
from model.errors import InputError
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_summary import exciters_of, sections_of
from model.structure.attachments import Era, PointLoad
from model.study.contrast_maps import random_contacts
from model.study.verification import draw_plates, felt_on
from model.table.table_file import build_table

_OTHER = {"free": "mounted", "mounted": "free"}
_VARYING = 0.8  # standard deviation of logarithms of gains, as no drive has it
_CLEARLY = 0.5  # of that as written


@dataclass(frozen=True)
class MisreadResonance:
    """Exciters whose resonance in the rig is the other one.

    rig: with the right ones; meant, as_written: `free` and `mounted`, by exciter; frequency: of the
    glued magnet [Hz] by exciter; variation, variation_as_written: of gains over frequency, standard
    deviations of their logarithms.
    """

    rig: Rig
    meant: Mapping[str, str]
    frequency: Mapping[str, float]
    variation: float
    variation_as_written: float

    label = "RESONANCE"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        (meant, *_), (glued, *_) = self.meant.values(), self.frequency.values()
        names = ", ".join(self.meant)
        return (
            f"resonance_is of {names} must be {meant}, got {_OTHER[meant]}: with it {meant} a "
            f"glued magnet resonates at {glued:.0f} Hz, and gains vary by a factor of "
            f"{math.exp(self.variation):.2g} over frequency, as written by "
            f"{math.exp(self.variation_as_written):.2g}; correct the rig"
        )


def misread_resonance(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> MisreadResonance | None:
    """Find exciters with the other meaning of their resonances where that is clearly the measured.

    shapes: of the observation, by the rig's plate. None without a resonance in the file.
    """
    rig = plate.rig
    as_written = {
        name: str(section.values["resonance_is"])
        for name, section in sections_of(rig).items()
        if not section.stiffness
    }
    if not as_written:
        return None
    variation_as_written = _variation(plate, shapes, observation)
    if not variation_as_written > _VARYING:
        return None
    for which in dict.fromkeys(as_written.values()):
        meant = {name: _OTHER[which] for name, own in as_written.items() if own == which}
        other = rig.replaced(eras={name: {"resonance_is": each} for name, each in meant.items()})
        sensed = plate_of(other, observation)
        found = _variation(sensed, match_shapes(sensed, observation.values), observation)
        if found < _CLEARLY * variation_as_written:
            glued = {e.name: e.magnet_frequency for e in exciters_of(other) if e.name in meant}
            return MisreadResonance(other, meant, glued, found, variation_as_written)
    return None


def _variation(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> float:
    """Standard deviation over frequency of the logarithm of gains, the median channel's."""
    model = plate.responses(plate.moved(*shapes.start))[:, list(shapes.nearest)]
    values = observation.values
    weight = np.isfinite(values) / row_rms(values)[:, :, None]
    gains, _ = project_gains(model, values, weight)
    driven = np.isfinite(gains).sum(axis=0) > 1
    with np.errstate(divide="ignore"):
        sizes = np.log(np.abs(gains[:, driven]))
    return float(np.median(np.nanstd(sizes, axis=0))) if driven.any() else 0.0


OtherMeaning: TypeAlias = TurnedGrain | MisreadResonance
"""A rig with the other of two values, of which the measurement clearly is."""


def other_meaning(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> OtherMeaning | None:
    """Find what the rig of a plate says the wrong way round, the grain first; None for nothing.

    shapes: of the observation, by that plate.
    """
    return turned_grain(plate, shapes, observation) or misread_resonance(plate, shapes, observation)


def check_meaning(rig: Rig, observation: Responses) -> None:
    """Raise InputError for a rig that clearly says something the wrong way round."""
    plate = plate_of(rig, observation)
    found = other_meaning(plate, match_shapes(plate, observation.values), observation)
    if found:
        raise InputError(str(found))


MISSED_DB = 1.0
"""By which half of a table's answers may miss their promises [dB]."""

STRONG = 1.25
"""Gain of a channel: 2 dB either way, four times what a drive varies."""

_GAIN_STDS = 3.5  # of the rig's uncertainty, where that allows more
LOOSE = 0.7
"""Share of its own stiffness below which an exciter that explains a plate is loose."""

_NEARLY_ALL = 0.75  # of the channels
_LEAST_FREQUENCIES = 4
_MIN_CONFIDENCE = 0.99  # in another ERA than the rig's
_MIN_COST_REDUCTION = 20.0  # by another wiring than the rig's
_MAX_PHASE_ERROR = 45.0  # degrees

Check: TypeAlias = Callable[[SensedPlate, ShapeMatch, Responses], None]
"""Of responses at usable sensors, by the plate there and what its shapes are most like."""

ChannelState: TypeAlias = Literal[
    "well",
    "dead",
    "loose",
    "weak",
    "strong",
    "other ERA",
    "inverted",
    "out of phase",
    "not driven",
]


@dataclass(frozen=True)
class ChannelVerdict:
    """A channel: the ERA to which the rig wires it, the one that it drives, and its states.

    states: "well" alone if nothing is wrong; drives: None for a channel that is dead or was not
    driven; gain: relative to the command and the rig's gains; phase [degrees], None if unknown;
    mac_own, mac_found: median MAC with the rig's ERA and with the one found; confidence 0..1 in
    drives and states.
    """

    era: str
    channel: Channel
    states: tuple[ChannelState, ...]
    drives: str | None
    gain: float | None
    phase: float | None
    mac_own: float | None
    mac_found: float | None
    confidence: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """Result of a diagnosis.

    plate_matches: whether the rig's plate within its priors explains the measurement; match: that
    plate; explanations: other plates that do, most likely first, if it does not; bad_sensors: left
    out; swapped: cycles of channels by their ERAs; changes: see `plate_changes`, None without a
    plate that fits; sensors: names of those that were not left out; beyond: what of a plate that
    matches is beyond tolerances, None for nothing or where it was not sought; promise_margins: by
    what that plate exceeds the contrasts that the rig's table promises [dB], none where they were
    not compared; corrections: what the files say wrongly of the board or of places of sensors; all
    else is of the corrected ones.
    """

    channels: tuple[ChannelVerdict, ...]
    plate_matches: bool
    match: Match | None
    explanations: tuple[Explanation, ...]
    bad_sensors: tuple[BadSensor, ...]
    swapped: tuple[tuple[str, ...], ...]
    changes: dict[str, float] | None
    sensors: tuple[str, ...]
    frequencies: FloatArray
    beyond: BeyondTolerances | None = None
    promise_margins: tuple[float, ...] = ()
    corrections: tuple[OtherMeaning | ExchangedSensors | ReversedAxes, ...] = ()

    @property
    def wiring_matches(self) -> bool:
        """Whether every driven channel drives its ERA as the rig says."""
        return all(set(channel.states) <= {"well", "not driven"} for channel in self.channels)

    @property
    def common_state(self) -> ChannelState | None:
        """Strong or weak where nearly all channels are, of which a sensor is the likelier cause."""
        driven = [channel.states for channel in self.channels if channel.gain]
        states: tuple[ChannelState, ...] = ("strong", "weak")
        for state in states:
            count = sum(state in each for each in driven)
            if count > 1 and count >= _NEARLY_ALL * len(driven):
                return state
        return None

    @property
    def is_well(self) -> bool:
        """Whether no fault was found."""
        return (
            self.plate_matches
            and self.wiring_matches
            and self.beyond is None
            and not self.misses_promises
            and not self.corrections
        )

    @property
    def is_of_another_rig(self) -> bool:
        """Whether the board that was found is not that of the file."""
        return any(isinstance(each, OtherMeaning) for each in self.corrections)

    @property
    def all_inverted(self) -> bool:
        """Whether all of several channels have the sign that is opposite to the sensors'."""
        found = ["inverted" in each.states for each in self.channels if each.drives is not None]
        return len(found) > 1 and all(found)

    @property
    def kept_share(self) -> float | None:
        """Share of the table's promises that the plate keeps, None where they were not compared."""
        return float(np.mean(np.array(self.promise_margins) >= 0)) if self.promise_margins else None

    @property
    def missed_db(self) -> float:
        """By how much half of the table's answers miss their promises [dB]; 0 if not compared."""
        return -float(np.median(self.promise_margins)) if self.promise_margins else 0.0

    @property
    def misses_promises(self) -> bool:
        """Whether half of all answers give clearly less contrast than the table promises."""
        return self.missed_db > MISSED_DB


def diagnose(
    rig: Rig,
    observation: Responses,
    *,
    false_alarm: float = FALSE_ALARM,
    check: Check | None = None,
    has_form: bool = False,
) -> Verdict:
    """Compare a measurement with the rig's prediction.

    false_alarm: share of plates as written of which a value may be called wrong; check: that
    responses are what they claim, before channels are judged by their size; then corrections are
    errors; has_form: whether the
    plate may have form errors, and what is beyond them is sought, by sensors of known scale.
    Raises InputError for fewer than three usable sensors or four frequencies.
    """
    if not observation.measured.any():
        raise InputError("no channel was driven; drive each in turn and measure again")
    check_enough_sensors(np.ones(len(observation.sensors), dtype=bool), observation)
    if len(observation.frequencies) < _LEAST_FREQUENCIES:
        raise InputError(
            f"a diagnosis needs at least {_LEAST_FREQUENCIES} frequencies, got "
            f"{len(observation.frequencies)}"
        )
    plate = plate_of(rig, observation)
    dead = dead_channels(plate, observation)
    observation, removed = usable_sensors(observation, dead)
    if removed:
        plate = plate_of(rig, observation)
    shapes = match_shapes(plate, observation.values)
    live = replace(observation, values=np.where(dead[:, None], np.nan, observation.values))
    of_live = match_shapes(plate, live.values)
    turned = reversed_axes(plate, of_live, live)
    if turned is not None and (check is not None or not turned.is_wiring):
        if check is not None:
            raise InputError(str(turned))
        put_right = turned.put_right(observation, rig)
        found = diagnose(rig, put_right, false_alarm=false_alarm, has_form=has_form)
        return replace(found, corrections=(turned, *found.corrections))
    other = other_meaning(plate, of_live, live)
    if other is not None:
        if check is not None:
            raise InputError(str(other))
        found = diagnose(other.rig, observation, false_alarm=false_alarm)
        corrections = (other, *found.corrections)
        return replace(found, plate_matches=False, changes=None, corrections=corrections)
    if check is not None:
        check(plate, shapes, observation)
    dead |= dead_channels(plate, observation, shapes)
    values = np.where(dead[:, None], np.nan, observation.values)
    shapes = replace(shapes, mac=np.where(dead[:, None], np.nan, shapes.mac))
    if not np.isfinite(values).any():
        channels = tuple(
            _without_response(rig, number, is_dead=bool(dead[number]))
            for number in range(len(rig.eras))
        )
        return Verdict(
            channels,
            True,
            None,
            (),
            removed,
            (),
            None,
            observation.sensors,
            observation.frequencies,
        )
    match, drives = best_wiring(plate, values, shapes)
    live = replace(observation, values=values)
    if exchanged := exchanged_sensors(live, match.responses[:, list(drives)]):
        if check is not None:
            raise InputError(str(exchanged))
        put_right = exchanged.put_right(observation)
        found = diagnose(rig, put_right, false_alarm=false_alarm, has_form=has_form)
        return replace(found, corrections=(exchanged, *found.corrections))
    # With more noise than usual parameters are less certain.
    error = float(np.clip(1.2 * match.median_error, MODEL_ERROR, 0.3))
    if error > MODEL_ERROR:
        match = match_plate(plate, values, drives=drives, model_error=error, starts=shapes.starts)
    off = off_scale(observation, values, match)
    if off and len(observation.sensors) - len(off) >= LEAST_SENSORS:
        wrong = np.isin(observation.sensors, [each.name for each in off])
        again = diagnose(
            rig, observation.without(wrong), false_alarm=false_alarm, has_form=has_form
        )
        return replace(again, bad_sensors=(*removed, *off, *again.bad_sensors))
    beyond = None
    if has_form:
        with_form, beyond = match_with_form(plate, observation, values, drives)
        if with_form.error <= MAX_ERROR:
            match = with_form
    # Values that stand in for a form error that is less likely say nothing of themselves.
    limit = min(false_alarm, beyond.chance if beyond else 1.0)
    matches = match.error <= MAX_FIT_ERROR and match.chance >= limit
    explanations: Sequence[Explanation] = ()
    fitted = match
    if not matches:
        explanations = explain(
            plate,
            observation.points,
            observation.frequencies,
            values,
            drives=drives,
            model_error=error,
        )
        tried = [match, *(each.match for each in explanations)]
        fitted = best_by(tried, lambda each: -each.cost)
    shapes = match_responses(fitted.responses, values)
    predicted = np.where(fitted.outliers | dead[:, None], np.nan, fitted.predicted)
    phases = phases_of_drive(observation, predicted)
    channels = tuple(
        _channel(
            rig, number, observation, shapes, drives, fitted, phases[number], bool(dead[number])
        )
        for number in range(len(rig.eras))
    )
    if not matches:
        channels = tuple(_loose(each, rig, match, explanations) for each in channels)
    on_glue = behind_glue(fitted, values, drives)
    channels = tuple(
        _as_loose(each) if off else each for each, off in zip(channels, on_glue, strict=True)
    )
    return Verdict(
        channels,
        matches,
        match,
        tuple(explanations),
        removed,
        _cycles(rig, drives, dead),
        plate_changes(rig, match) if match.error <= MAX_FIT_ERROR else None,
        observation.sensors,
        observation.frequencies,
        beyond if matches else None,
    )


def best_wiring(
    plate: SensedPlate, values: ComplexArray, shapes: ShapeMatch
) -> tuple[Match, tuple[int, ...]]:
    """Best plate and wiring for values (f, e, s): the rig's unless another is clearly better.

    shapes: what they are most like.
    """
    own = tuple(range(values.shape[1]))
    nearest = tuple(
        era if era == i or shapes.confidence(i, era, i) >= _MIN_CONFIDENCE else i
        for i, era in enumerate(shapes.nearest)
    )
    found = [
        (match_plate(plate, values, drives=drives, starts=shapes.starts), drives)
        for drives in dict.fromkeys([own, nearest])
    ]
    return best_by(found, lambda each: -each[0].cost - _MIN_COST_REDUCTION * (each[1] != own))


def _channel(
    rig: Rig,
    number: int,
    observation: Responses,
    shapes: ShapeMatch,
    drives: Sequence[int],
    match: Match,
    phase: ChannelPhase,
    is_dead: bool,
) -> ChannelVerdict:
    era = rig.eras[number]
    if is_dead or not observation.measured[number]:
        return _without_response(rig, number, is_dead=is_dead)
    driven = drives[number]
    # Commands are shares of the stroke of the ERA to which the rig wires the channel.
    gain = float(match.gains[number]) * era.full_level / rig.eras[driven].full_level
    gain /= float(np.median(np.abs(rig.eras[driven].gain(observation.frequencies))))
    states: list[ChannelState] = []
    confidence = min(
        shapes.confidence(number, driven, other)
        for other in range(len(rig.eras))
        if other != driven
    )
    if driven != number:
        states.append("other ERA")
    known = rig.uncertainty
    # No response tells a force factor from a gain.
    varies = 0.0 if isinstance(era, Era) else known.stiffness
    strong = max(STRONG, math.exp(_GAIN_STDS * math.hypot(known.gain, varies)))
    if gain < 1 / strong:
        states.append("weak")
    elif gain > strong:
        states.append("strong")
    if phase.sign < 0:
        states.append("inverted")
    elif phase.degrees is not None and abs(phase.degrees) > _MAX_PHASE_ERROR:
        states.append("out of phase")
    if phase.sign < 0:
        confidence = min(confidence, phase.confidence)
    mac = np.nanmedian(shapes.mac[:, number], axis=0)
    return ChannelVerdict(
        era.name,
        rig.wiring[era.name],
        tuple(states) or ("well",),
        rig.eras[driven].name,
        gain,
        phase.degrees,
        float(mac[number]),
        float(mac[driven]),
        confidence,
    )


def _loose(
    channel: ChannelVerdict, rig: Rig, match: Match, explanations: Sequence[Explanation]
) -> ChannelVerdict:
    """The same, loose where its exciter is what is farthest off, or the likeliest explanation.

    And acts with less than it would.
    """
    drives = channel.drives
    if drives is None or isinstance(rig.era(drives), Era):
        return channel
    shares = [each.value / each.expected for each in explanations[:1] if each.cause.era == drives]
    if match.plate.rows[best_of(np.abs(match.z))].era == drives:
        acts = [row for row in match.plate.rows if row.era == drives and row.is_factor]
        shares += [row.of(match.rig) / row.of(rig) for row in acts]
    if min(shares, default=1.0) > LOOSE:
        return channel
    return _as_loose(channel)


def _as_loose(channel: ChannelVerdict) -> ChannelVerdict:
    """The same, loose, which makes it weak as well."""
    others = (each for each in channel.states if each not in ("well", "weak", "loose"))
    return replace(channel, states=("loose", *others))


def _without_response(rig: Rig, number: int, *, is_dead: bool) -> ChannelVerdict:
    """Verdict on a channel that is dead or was not driven."""
    name = rig.eras[number].name
    state: ChannelState = "dead" if is_dead else "not driven"
    gain, confidence = (0.0, 0.99) if is_dead else (None, 0.0)
    return ChannelVerdict(
        name, rig.wiring[name], (state,), None, gain, None, None, None, confidence
    )


def _cycles(
    rig: Rig, drives: Sequence[int], dead: NDArray[np.bool_]
) -> tuple[tuple[str, ...], ...]:
    """Cycles of channels that drive each other's ERAs."""
    found: list[tuple[str, ...]] = []
    for start in range(len(drives)):
        cycle = [start]
        while (after := drives[cycle[-1]]) not in cycle:
            cycle.append(after)
        # Each is found once from every channel in it.
        is_first = after == start == min(cycle)
        if is_first and len(cycle) > 1 and not dead[cycle].any():
            found.append(tuple(rig.eras[number].name for number in cycle))
    return tuple(found)


_ANSWERS = 30  # ten each with one, two and three quiet fingers


def judged_by_promises(verdict: Verdict, rig: Rig) -> Verdict:
    """The verdict with what the plate keeps of the promises to random fingers, solved exactly.

    As it is where no plate fits, and for a rig that makes no table or has no room for four fingers.
    """
    if verdict.match is None or verdict.changes is None:
        return verdict
    rng, margins = np.random.default_rng(0), []
    # The plate of a table has no finger on it.
    loads: list[object] = [*verdict.match.rig.masses]
    masses = tuple(each for each in loads if isinstance(each, PointLoad))
    plate = replace(verdict.match.rig, masses=masses)
    try:
        table = build_table(rig, drive_mode="phased")
        there = build_table(plate, frequencies=table.frequencies, drive_mode="phased")
        for number in range(_ANSWERS):
            fingers = 2 + number % 3
            places = random_contacts(rng, fingers, rig.plate)
            placed = Placement(places[:1], places[1:])
            answer = query(table, placed)
            none = Uncertainty.none()
            exact = draw_plates(rng, none, of=there, count=1, contact_count=fingers)
            felt = felt_on(there, placed, answer.layers[0].excitation, exact).contrast
            promised = answer.fingers[0].promised_contrast_db
            assert felt is not None  # noqa: S101  there are quiet fingers
            assert promised is not None  # noqa: S101
            margins.append(float(20 * np.log10(felt[0])) - promised)
    except InputError:
        return verdict
    return replace(verdict, promise_margins=tuple(margins))


GRAVITY = 9.80665  # m/s², standard
_MAX_GAIN = 3.0  # of all channels together; a factor either way is another quantity or unit
_MAX_FREQUENCIES = 16  # ample for every check
_CLEAR = 20.0  # difference of costs


@dataclass(frozen=True)
class _Quantity:
    """What responses may be instead of acceleration per displacement: name, remedy, and factor.

    factor * (i omega)^power times that is recorded.
    """

    name: str
    remedy: str
    factor: float
    power: int = 0


_QUANTITIES = (
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


def check_consistency(rig: Rig, responses: Responses) -> Screening:
    """Refuse responses that are not what they claim; return what of them a fit can use.

    Raises InputError that names the cause: too few sensors or frequencies, another quantity or
    unit, a grain along the other side, the other meaning of a resonance, conjugated phases, sensors
    at swapped places, swapped or inverted channels.
    """
    rows = np.unique(
        np.linspace(0, len(responses.frequencies) - 1, _MAX_FREQUENCIES).round().astype(int)
    )
    observation = replace(
        responses, frequencies=responses.frequencies[rows], values=responses.values[rows]
    )
    if observation.measured.any() and not (np.abs(observation.values) > 0).any():
        raise InputError("measured responses must not all be zero; check that ERAs were driven")
    # Values of the plate that are off are what a calibration is for.
    verdict = diagnose(rig, observation, false_alarm=0.0, check=_check_claims)
    _check_wiring(verdict)
    _check_size(verdict)
    assert verdict.match is not None  # noqa: S101  some channels have the rig's gain
    return Screening(
        np.array(["dead" in channel.states for channel in verdict.channels]),
        np.isin(responses.sensors, [each.name for each in verdict.bad_sensors if each.is_mute]),
        verdict.match.x[verdict.match.plate.numbers],
    )


def _check_claims(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> None:
    """Raise InputError where responses are of another quantity or phase."""
    _check_quantity(plate, shapes, observation)
    _check_phases(plate, shapes, observation)


def _check_quantity(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> None:
    """Raise InputError where gains of all channels are those of another quantity or unit."""
    model = plate.responses(plate.moved(*shapes.start))[:, list(shapes.nearest)]
    weight = np.isfinite(observation.values) / row_rms(observation.values)[:, :, None]
    gains, _ = project_gains(model, observation.values, weight)
    size = np.log(row_rms(observation.values) / row_rms(model))
    known = np.isfinite(gains)
    omega = 2 * np.pi * observation.frequencies[:, None]

    def distance(factor: float, power: int) -> float:
        """Of gains from those of a quantity, by size and by phase."""
        expected = factor * (1j * omega) ** power
        off = np.abs(size - np.log(np.abs(expected)))[known]
        phase = np.angle(gains / expected)[known]
        return float(np.median(off) + 1 - np.median(np.cos(phase)))

    level = float(np.median(size[known]))
    own = distance(1.0, 0)
    nearest = best_by(_QUANTITIES, lambda each: -distance(each.factor, each.power))
    gap = distance(nearest.factor, nearest.power)
    if abs(level) < np.log(_MAX_GAIN) or own < gap:
        return
    if gap < np.log(_MAX_GAIN):
        raise InputError(
            f"responses must be acceleration per base displacement in 1/s², got {nearest.name}, as "
            f"it looks: all are {np.exp(level):.3g} of what the rig predicts; {nearest.remedy}"
        )
    raise InputError(
        f"responses must be those of the rig to a factor of {_MAX_GAIN:g}, got "
        f"{np.exp(level):.3g} of what it predicts; check their unit and the stroke of the ERAs"
    )


def _check_phases(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> None:
    """Raise InputError for conjugated phases."""
    match, _ = best_wiring(plate, observation.values, shapes)
    other, _ = best_wiring(plate, observation.values.conj(), shapes)
    if other.cost < match.cost - _CLEAR:
        raise InputError(
            "phases must be for exp(+i omega t), got conjugated ones, as it looks: with the signs "
            "of all imaginary parts changed the plate explains the responses better "
            f"({100 * other.error:.1f} % unexplained instead of {100 * match.error:.1f} %); "
            "change them"
        )


def _check_wiring(verdict: Verdict) -> None:
    """Raise InputError for channels that drive another ERA or have the opposite sign."""
    swapped = {era for cycle in verdict.swapped for era in cycle}
    for cycle in verdict.swapped:
        raise InputError(
            f"channels must drive the ERAs of the rig, got swapped ones: those of "
            f"{_joined(cycle)} drive each other's ERA, as it looks; correct the plugs, the names "
            "in the file, or the channels in the rig, or the sensors' positions if they are "
            "mirrored, and measure again"
        )
    for channel in verdict.channels:
        if "other ERA" in channel.states and channel.era not in swapped:
            raise InputError(
                f"channels must drive the ERAs of the rig, got ERA {channel.drives} driven by that "
                f"of {channel.era}, as it looks; correct the plug or the names in the file"
            )
    inverted = [channel.era for channel in verdict.channels if "inverted" in channel.states]
    if inverted:
        raise InputError(
            f"signs must be upwards positive for sensors and ERAs, got opposite ones of "
            f"{_joined(inverted)}; swap the two wires of these, or turn the sensors over if it is "
            "all of them"
        )


def _check_size(verdict: Verdict) -> None:
    """Raise InputError where another length or width of the plate explains the responses best."""
    if verdict.plate_matches or not verdict.explanations:
        return
    best = verdict.explanations[0]
    if best.cause.is_geometry and best.match.error <= MAX_FIT_ERROR:
        raise wrong_size(best.cause.key, best.expected, best.value)


def _joined(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
