"""Diagnosis of a rig's plate and channels by measured responses, and checks before a calibration.

`diagnose` first finds what a rig's file says the wrong way round, then matches plate and wiring,
and gives a `Verdict` with a state for each channel. `judged_by_promises` adds how many of the rig's
promises the plate keeps that the measurement is most like: contrast tells whether a deviation
matters.

`check_consistency` refuses responses that are not what they claim to be. A fit can absorb almost
any error of a measurement: gains take wrong units, springs a swapped plug, outlier rejection whole
sensors. Each check looks for one such error alone, in what the fit would leave free, and names it.

A misread resonance: an exciter pushes a plate against its magnet, well above the resonance of the
magnet on the glued coil with its whole force, far below it hardly, and with the opposite sign. A
file that takes a sheet's `free` resonance for the `mounted` one thus describes exciters that all
look reversed, and weak by another factor at each frequency. On twelve boards as bought the gains
left by a coarse fit vary over frequency by 0.15 to 0.43 (standard deviation of their logarithms)
with the right meaning, and by 1.2 or more with the other."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray, best_by, best_of
from model.errors import InputError
from model.estimate.calibrate import wrong_size
from model.estimate.calibration_fit import SensedPlate, plate_of, project_gains, row_rms
from model.estimate.causes import (
    MAX_FORM_ERROR,
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
from model.estimate.measurement import LEAST_SENSORS, Responses, Screening, check_enough_sensors
from model.estimate.plate_match import (
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
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_summary import exciters_of, sections_of
from model.structure.attachments import Era, PointLoad
from model.study.contrast_maps import random_contacts
from model.study.verification import draw_plates, felt_on
from model.table.table_file import build_table

_OTHER_MEANING = {"free": "mounted", "mounted": "free"}
_MAX_VARIATION = 0.8  # standard deviation of logarithms of gains; no drive has more
_CLEARLY = 0.5  # of the variation as written

MISSED_DB = 1.0
"""Largest miss of the promises of a table by half of its answers [dB]."""

STRONG = 1.25
"""Gain from which a channel is strong, or weak below its inverse: 2 dB.

That is four times the variation of drives.
"""

_GAIN_STDS = 3.5  # of the rig's uncertainty, where that allows more
LOOSE = 0.7
"""Share of its own stiffness below which an exciter that explains a plate is loose."""

_NEARLY_ALL = 0.75  # of the channels
_LEAST_FREQUENCIES = 4
_MIN_CONFIDENCE = 0.99  # in another ERA than the rig's
_MIN_COST_REDUCTION = 20.0  # by another wiring than the rig's
_MAX_PHASE_ERROR = 45.0  # degrees

_ANSWERS = 30  # ten each with one, two and three quiet fingers

GRAVITY = 9.80665  # m/s², standard
_MAX_GAIN = 3.0  # of all channels together; a factor either way is another quantity or unit
_MAX_FREQUENCIES = 16  # ample for every check
_CLEAR = 20.0  # difference of costs

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


@dataclass(frozen=True)
class MisreadResonance:
    """Exciters whose resonance in the rig is the other one of `free` and `mounted`."""

    rig: Rig
    """The rig with the right ones."""
    meant: Mapping[str, str]
    """The right one of `free` and `mounted` by exciter."""
    frequency: Mapping[str, float]
    """Resonance of the glued magnet by exciter [Hz]."""
    variation: float
    """Standard deviation over frequency of the logarithms of gains, with the right ones."""
    variation_as_written: float
    """The same as written."""

    label = "RESONANCE"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        (meant, *_), (glued, *_) = self.meant.values(), self.frequency.values()
        written = _OTHER_MEANING[meant]
        names = ", ".join(self.meant)
        return (
            f"resonance_is of {names} must be {meant}, got {written}: with it {meant} "
            f"a glued magnet resonates at {glued:.0f} Hz, and gains vary by a factor of "
            f"{math.exp(self.variation):.2g} over frequency, as written by "
            f"{math.exp(self.variation_as_written):.2g}; correct the rig"
        )


OtherMeaning: TypeAlias = TurnedGrain | MisreadResonance
"""A rig with the other of two values, which clearly explains the measurement better."""


Check: TypeAlias = Callable[[SensedPlate, ShapeMatch, Responses], None]
"""Checks responses at usable sensors, with the plate there and the match of its shapes."""


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
    """A channel: the ERA to which the rig wires it, the one that it drives, and its states."""

    era: str
    """ERA to which the rig wires it."""
    channel: Channel
    states: tuple[ChannelState, ...]
    """What is wrong with it; "well" alone if nothing is."""
    drives: str | None
    """ERA that it drives, None for a dead channel or one that was not driven."""
    gain: float | None
    """Gain relative to the command and the rig's gains."""
    phase: float | None
    """Phase error [degrees], None if unknown."""
    mac_own: float | None
    """Median MAC with the rig's ERA."""
    mac_found: float | None
    """Median MAC with the ERA that it drives."""
    confidence: float
    """Confidence 0..1 in `drives` and `states`."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """Result of a diagnosis."""

    channels: tuple[ChannelVerdict, ...]
    plate_matches: bool
    """Whether the rig's plate within its priors explains the measurement."""
    match: Match | None
    """That plate."""
    explanations: tuple[Explanation, ...]
    """Other plates that explain it if the rig's does not, most likely first."""
    bad_sensors: tuple[BadSensor, ...]
    """Sensors left out."""
    swapped: tuple[tuple[str, ...], ...]
    """Cycles of channels by their ERAs."""
    changes: dict[str, float] | None
    """Relative differences from the rig as `plate_changes`, None without a plate that fits."""
    sensors: tuple[str, ...]
    """Names of the sensors that were used."""
    frequencies: FloatArray
    beyond: BeyondTolerances | None = None
    """What of a plate that matches is beyond tolerances, None for nothing or if not sought."""
    promise_margins: tuple[float, ...] = ()
    """Margins [dB] of the plate's contrasts over those that the rig's table promises; empty if they
    were not compared."""
    corrections: tuple[OtherMeaning | ExchangedSensors | ReversedAxes, ...] = ()
    """Errors in the files; all else is found with these corrected."""

    @property
    def wiring_matches(self) -> bool:
        """Whether every driven channel drives its ERA as the rig says."""
        return all(set(channel.states) <= {"well", "not driven"} for channel in self.channels)

    @property
    def common_state(self) -> ChannelState | None:
        """Strong or weak where nearly all channels are, most likely by the sensors."""
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
        """Median miss of the table's promises [dB]; 0 if they were not compared."""
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

    false_alarm: share of plates as written with a value that may be called wrong; check: raises
    InputError for responses that are not what they claim, before channels are judged by their size;
    with it corrections are errors, too; has_form: whether the plate may have form errors, so that
    deviations beyond their tolerances are sought, by sensors of known scale. Raises InputError for
    fewer than three usable sensors or four frequencies.
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
        if with_form.error <= MAX_FORM_ERROR:
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

    shapes: match of the values with the plate.
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
    """Mark a channel as loose if its exciter deviates most, or is the likeliest explanation.

    It must act with less than its own stiffness.
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
    """Mark a channel as loose, in place of weak."""
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


def judged_by_promises(verdict: Verdict, rig: Rig) -> Verdict:
    """Add the margins of promises to random fingers on the matched plate, solved exactly.

    The verdict stays as it is where no plate fits, and for a rig that has no table or no room for
    four fingers.
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
            _, felt = felt_on(there, placed, answer.layers[0].excitation, exact)
            promised = answer.fingers[0].promised_contrast_db
            assert felt is not None  # noqa: S101  there are quiet fingers
            assert promised is not None  # noqa: S101
            margins.append(float(20 * np.log10(felt[0])) - promised)
    except InputError:
        return verdict
    return replace(verdict, promise_margins=tuple(margins))


def check_consistency(rig: Rig, responses: Responses) -> Screening:
    """Check that responses are what they claim to be, and screen them for a fit.

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
        """Distance of gains from those of a quantity, by size and by phase."""
        expected = factor * (1j * omega) ** power
        off = np.abs(size - np.log(np.abs(expected)))[known]
        phase = np.angle(gains / expected)[known]
        return float(np.median(off) + 1 - np.median(np.cos(phase)))

    level = float(np.median(size[known]))
    own = distance(1.0, 0)
    name, remedy, factor, power = best_by(_QUANTITIES, lambda each: -distance(*each[2:]))
    gap = distance(factor, power)
    if abs(level) < np.log(_MAX_GAIN) or own < gap:
        return
    if gap < np.log(_MAX_GAIN):
        raise InputError(
            f"responses must be acceleration per base displacement in 1/s², got {name}, as "
            f"it looks: all are {np.exp(level):.3g} of what the rig predicts; {remedy}"
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


def check_meaning(rig: Rig, observation: Responses) -> None:
    """Raise InputError for a rig whose grain or resonances are clearly the wrong ones."""
    plate = plate_of(rig, observation)
    found = other_meaning(plate, match_shapes(plate, observation.values), observation)
    if found:
        raise InputError(str(found))


def other_meaning(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> OtherMeaning | None:
    """Find a value that the rig of a plate has the wrong way round, the grain first.

    shapes: match of the observation with that plate. None if neither is clearly wrong.
    """
    return turned_grain(plate, shapes, observation) or misread_resonance(plate, shapes, observation)


def misread_resonance(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> MisreadResonance | None:
    """Find exciters whose other resonance clearly explains the observation better.

    shapes: match of the observation with the rig's plate. None without a resonance in the file.
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
    if not variation_as_written > _MAX_VARIATION:
        return None
    for which in dict.fromkeys(as_written.values()):
        meant = {name: _OTHER_MEANING[which] for name, own in as_written.items() if own == which}
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
