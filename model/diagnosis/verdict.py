"""Diagnosis of a rig's plate and channels by measured responses."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, best_by, best_of
from model.calibration.fit import SensedPlate, plate_of
from model.calibration.responses import LEAST_SENSORS, Responses, check_enough_sensors
from model.diagnosis.assignment import (
    ChannelPhase,
    ShapeMatch,
    match_responses,
    match_shapes,
    phases_of_drive,
)
from model.diagnosis.beyond_tolerances import MAX_ERROR, BeyondTolerances, match_with_form
from model.diagnosis.causes import Explanation, explain
from model.diagnosis.diagnosis_screening import (
    BadSensor,
    dead_channels,
    off_scale,
    usable_sensors,
)
from model.diagnosis.exchanged_sensors import (
    ExchangedSensors,
    ReversedAxes,
    exchanged_sensors,
    reversed_axes,
)
from model.diagnosis.glue import behind_glue
from model.diagnosis.other_meaning import OtherMeaning, other_meaning
from model.diagnosis.plate_match import (
    FALSE_ALARM,
    MAX_FIT_ERROR,
    MODEL_ERROR,
    Match,
    match_plate,
    plate_changes,
)
from model.errors import InputError
from model.rig.rig import Channel, Rig
from model.structure.attachments import Era

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
