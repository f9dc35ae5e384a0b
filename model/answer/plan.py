"""One answer to all fingers, and what is done where not all can be served.

A promise below the least contrast at the worst finger is not served as requested. First fingers
share, the nearest first and only where they allow it: two that could not be kept apart were they
alone on the plate, then two that may share anyway. What still does not fit is served in turn, by
priority and arrival: each vibration that those before it leave room for. What could not be kept
from the finger beside its own anyway comes last. Where the first cannot be served either, the best
tried is, but for bounds that fingers state themselves: these hold, if by silence.

Contents whose strength beats 10 to 30 times a second: a carrier and two side bands.

Of a full modulation each side band has half the amplitude of the carrier. At the carrier's weights
side bands leak 3 to 12 dB more: each has weights of its own, found like those of a content of its
frequency. The carrier is chosen for all three together, near the best steady one.
"""

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from model.answer.answer import MIN_CONTRAST_DB, NO_LIMITS, SAME_LEVEL, Answer, Limits
from model.answer.promise import (
    as_quiet_fingers_allow,
    as_ramps_allow,
    gains_within,
    scaled,
    share_stroke,
    with_gains,
    with_tones,
)
from model.answer.stimulus import (
    ANY,
    APART_HZ,
    MIN_LEVEL_DB_SL,
    Contents,
    Finger,
    Placement,
    Stimulus,
    Stream,
    Tones,
    check_fingers,
    together,
)
from model.answer.tone_search import choose_tones
from model.arrays import NEARLY, FloatArray, Point, best_by, best_of
from model.drive_modes import UNRESTRICTED, checked_mode
from model.errors import InputError
from model.finger import FELT_DB_SL, STRONG_DB_SL, decibels
from model.table.table import SAME_FREQUENCY, LocalizationTable

_SHARES = np.array([1.0, 0.5, 0.5])  # amplitudes of carrier and side bands
_ALL_DB = 20 * math.log10(float(np.linalg.norm(_SHARES)))  # of all three above the carrier
_NEAR = 2  # carriers tried on each side of the steady one, by frequencies of the table
_SAME = 0.5  # Hz; by which both side bands may differ in distance from the carrier
_ROUNDING_DB = 1e-3  # of a promise that stays the same


def with_modulation(
    table: LocalizationTable,
    found: Answer,
    *,
    playable: tuple[float, float],
) -> Answer:
    """Return an answer modulated as its fingers ask, where that leaves all fingers served.

    playable: lowest and highest frequency [Hz] of side bands. These are as far below as above the
    carrier, where the table has a frequency nearest to the modulation, and APART_HZ from all tones
    of other contents. A shared content is steady. Levels are lowered to what the stroke allows.
    """
    for number, stream in enumerate(found.contents.streams):
        stimulus, tones = found.asked[stream.targets[0]].stimulus, found.tones
        modulation = None if stimulus is None else stimulus.modulation_hz
        if stimulus is None or modulation is None or len(stream.targets) > 1:
            continue
        alone = cache(_alone_at(table, found, number))
        limits = max(playable[0], table.frequencies[0]), min(playable[1], table.frequencies[-1])
        owners, rows = np.array(tones.owners), np.array(tones.rows)
        taken = table.frequencies[rows[owners != number]]
        tried = [
            each
            for each in _carriers(table, int(rows[owners == number][0]), modulation)
            if _fits(table.frequencies[each], modulation, stimulus.band_hz, limits, taken)
        ]
        if not tried:
            continue
        best = tried[best_of([_contrast_db([alone(row) for row in each]) for each in tried])]
        own, kept = [alone(row) for row in best], np.flatnonzero(owners != number)
        shares = _SHARES * 10 ** (-_ALL_DB / 20) * [each.gains[0] for each in own]
        modulated = with_tones(
            table,
            found,
            np.append(rows[kept], best),
            [*(tones.weights[each] for each in kept.tolist()), *(each.weights[0] for each in own)],
            np.append(owners[kept], [number] * len(own)),
            np.append(np.array(tones.gains)[kept], shares),
        )
        modulated = _within_stroke(table, modulated)
        if is_served(modulated, found):
            found = modulated
    return found


def is_served(found: Answer, steady: Answer) -> bool:
    """Whether all fingers have what they require, and no less than 6 dB unless they had less."""
    worst, before = found.promised_worst_db, steady.promised_worst_db
    if (
        worst is not None
        and before is not None
        and worst < min(MIN_CONTRAST_DB, before - _ROUNDING_DB)
    ):
        return False
    return not (found.lacks_contrast or found.disturbed)


def _carriers(table: LocalizationTable, steady: int, modulation: float) -> Iterator[list[int]]:
    """Rows of carriers near a steady one, and of the side bands nearest to a modulation [Hz]."""
    frequencies = table.frequencies
    for carrier in range(max(steady - _NEAR, 0), min(steady + _NEAR + 1, len(frequencies))):
        f = frequencies[carrier]
        above = int(np.argmin(np.abs(frequencies - f - modulation)))
        yield [carrier, int(np.argmin(np.abs(frequencies - 2 * f + frequencies[above]))), above]


def _fits(
    tones: FloatArray,
    modulation: float,
    band: tuple[float, float],
    limits: tuple[float, float],
    taken: FloatArray,
) -> bool:
    """Whether carrier and side bands [Hz] are even, within the limits, and apart from others."""
    f, below, above = tones
    gap, reach = above - f, max(above - f, modulation)
    is_even = gap > 0 and abs(f - below - gap) <= _SAME
    is_within = band[0] <= f <= band[1] and limits[0] <= f - reach and f + reach <= limits[1]
    is_apart = all(abs(tone - other) >= APART_HZ for tone in tones for other in taken)
    return bool(is_even and is_within and is_apart)


def _alone_at(table: LocalizationTable, found: Answer, number: int) -> Callable[[int], Tones]:
    """Finds a content's tone at a row of the table's frequencies, all other fingers quiet."""
    stream, contents = found.contents.streams[number], found.contents
    (finger,), course = stream.targets, stream.course
    level_db_sl = stream.level_db_sl - (0.0 if course is None else course.strongest_db)
    others = tuple(n for n in range(len(contents.places)) if n != finger)
    background = None if others else table.background([contents.places[finger]])

    def alone(row: int) -> Tones:
        one = Stream((finger,), level_db_sl, ((row, row + 1),))
        asked = replace(contents, streams=(one,), quiet=others, background=background)
        return choose_tones(table, asked)

    return alone


def _contrast_db(tones: Sequence[Tones]) -> float:
    """Promised contrast of a carrier and side bands [dB]: what leaks adds up."""
    own = np.array([each.worst_db for each in tones])
    leaks = (_SHARES**2 * 10 ** (-own / 10))[np.isfinite(own)]
    return _ALL_DB - float(decibels(np.sqrt(leaks.sum()))) if len(leaks) else math.inf


def _within_stroke(table: LocalizationTable, found: Answer) -> Answer:
    """The answer with contents lowered to what the stroke allows of all tones together."""
    tones, streams = found.tones, found.contents.streams
    rows, owners, gains = (np.array(each) for each in (tones.rows, tones.owners, tones.gains))
    drives = np.zeros((len(streams), len(table.eras)))
    np.add.at(drives, owners, gains[:, None] * np.abs(tones.weights))
    reached = [min(tones.level_db_sl[finger][1] for finger in each.targets) for each in streams]
    levels = np.maximum(10 ** (np.array(reached) / 20), 1e-9)  # silent ones
    priorities = [each.priority for each in streams]
    factors, factor = share_stroke(np.ones(len(streams)), drives, levels, priorities)
    if factor < 1 - NEARLY:
        found = with_tones(table, found, rows, tones.weights, owners, gains * factors[owners])
    least_db = float(decibels(levels * factors / found.contents.levels).min())
    of_all = 1.0 if least_db > -SAME_LEVEL else 10 ** (least_db / 20)
    return replace(found, tones=replace(found.tones, stroke_factor=of_all))


MAX_SEPARATE = 5
"""Fingers that may share, up to which each has a vibration of its own at first.

Of more, one for all was the end in 34 of 36 sets with two quiet fingers.
"""

CONTENTS_A_STEP = 3
"""Of so many vibrations one gives way before what is left is measured, at least one in all."""


def answer(
    table: LocalizationTable,
    fingers: Sequence[Finger],
    *,
    quiet: Sequence[Point | Finger] = (),
    drive_mode: str | None = None,
    shaped: bool = False,
    apart_hz: float = APART_HZ,
    avoided_hz: Sequence[float] = (),
    bands_may_swap: bool = False,
    min_contrast_db: float = MIN_CONTRAST_DB,
    limits: Limits = NO_LIMITS,
) -> Answer:
    """Answer all fingers at once, each with a vibration of its own.

    quiet: more fingers, which are to feel nothing; drive_mode: the table's own if None, which must
    be `phased` for more than one vibration; shaped: whether the amplifiers play shaped onsets and
    endings, which `Timing` adds; apart_hz: distance of the vibrations' frequencies, from each other
    and from avoided_hz, which play already, where their bands allow it; bands_may_swap: whether a
    finger may have the band of another one; min_contrast_db: below which the promise at the worst
    finger is not served as requested; limits: of the amplifiers. A stimulus whose modulation would
    leave a finger unserved, or whose side bands do not fit, is steady, as is a shared one, and all
    where clocks are not held. Levels are lowered where stroke and limits do not allow all: of the
    lower priorities first, of one priority the louder ones first.
    Raises InputError for fingers that contradict each other, and a band without frequencies.
    """
    if not 0 <= apart_hz < math.inf:  # False for NaN
        raise InputError(f"apart_hz must be a distance of frequencies in Hz, got {apart_hz}")
    every = (*fingers, *[each if isinstance(each, Finger) else Finger(each) for each in quiet])
    check_fingers(every, table.plate)
    mode = checked_mode(drive_mode or table.drive_mode)
    avoided = _avoided(table, avoided_hz, apart_hz)
    answering = _Answering(table, every, mode, shaped, apart_hz, avoided, bands_may_swap, limits)
    found = answering.within_limits(answering.solve(min_contrast_db), min_contrast_db)
    changed = _changed(found)
    return replace(found, applied=(*found.applied, *changed)) if changed else found


def query(
    table: LocalizationTable,
    placed: Placement,
    level_db_sl: float = STRONG_DB_SL,
    *,
    drive_mode: str | None = None,
    **stimulus: Any,
) -> Answer:
    """Answer fingers that feel one vibration, and others that feel nothing, as `answer`."""
    fingers = together(placed, Stimulus(level_db_sl, **stimulus))
    return answer(table, fingers, drive_mode=drive_mode)


def prepare_answers(table: LocalizationTable, drive_mode: str | None = None) -> None:
    """Compute ahead what the first answer of a table in a drive mode needs."""
    centre = (table.plate.length / 2, table.plate.width / 2)
    for quiet in ((), ((0.0, 0.0),)):
        placed = Placement((centre,), quiet)
        query(table, placed, MIN_LEVEL_DB_SL, drive_mode=drive_mode)


def _changed(found: Answer) -> list[str]:
    """What became of modulations and levels, in words."""
    steady, lowered = [], []
    for number, stream in enumerate(found.contents.streams):
        first = stream.targets[0]
        stimulus = found.asked[first].stimulus
        is_modulated = stimulus is not None and stimulus.modulation_hz is not None
        if is_modulated and list(found.tones.owners).count(number) == 1:
            steady.append(f"vibration of {_at(found.asked[first])} is steady")
        lasts = stream.duration is None
        is_reached = found.tones.level_db_sl[first][lasts] >= stream.level_db_sl - SAME_LEVEL
        if stream.limit_db_sl is None and not is_reached:
            level = found.tones.level_db_sl[first][lasts]
            why = (
                "all that the ERAs' stroke and the amplifiers allow"
                if found.stroke_factor < 1 - NEARLY or lasts
                else "so that quiet fingers feel half of it at most"
            )
            at = _at(found.asked[first])
            lowered.append(f"vibration of {at} is lowered to {level:.1f} dB SL, {why}")
    return [*steady, *lowered]


@dataclass(frozen=True)
class _Plan:
    """Which fingers, by index, feel which content; all others that are protected are quiet.

    contents: the fingers of each, its own first; applied: what was changed, in words.
    """

    contents: tuple[tuple[int, ...], ...]
    applied: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Answering:
    """Fingers on a table's plate, numbered in their order."""

    table: LocalizationTable
    fingers: tuple[Finger, ...]
    drive_mode: str
    is_shaped: bool
    apart_hz: float
    avoided: frozenset[int]
    bands_may_swap: bool
    limits: Limits

    def solve(self, min_contrast_db: float) -> Answer:
        """Share and serve in turn until the worst finger has the contrast, else the best tried."""
        plan = _Plan(self._first_contents)
        if len(plan.contents) > MAX_SEPARATE:
            plan = self._many_joined(plan)
        if len(plan.contents) > 1 and self.drive_mode != UNRESTRICTED:
            raise InputError(
                f"drive mode must be {UNRESTRICTED} for a vibration of each of several fingers, "
                f"got {self.drive_mode}, which plays one; where the amplifiers play it give "
                f"drive_mode={UNRESTRICTED!r}, or --mode {UNRESTRICTED} to era table query or build"
            )
        tried = [found := self._measure(plan)]
        while (
            _fails(found, min_contrast_db)
            and (shared := self._with_more_shared(plan, min_contrast_db)) != plan
        ):
            tried.append(found := self._measure(plan := shared))
        if _fails(found, min_contrast_db):
            found = self._in_turn(plan, tried, min_contrast_db)
        if found.tones.worst_db < min_contrast_db:  # NaN for a finger alone
            below = f"nothing reaches {min_contrast_db:g} dB: the best that was tried is served"
            found = replace(found, applied=(*found.applied, below))
        if self.drive_mode == UNRESTRICTED and not self.table.clocks.groups:
            found = with_modulation(self.table, found, playable=self.limits.frequencies)
        is_limited = any(stream.limit_db_sl is not None for stream in found.contents.streams)
        return as_quiet_fingers_allow(self.table, found) if is_limited else found

    def within_limits(self, found: Answer, min_contrast_db: float) -> Answer:
        """The answer lowered to what the amplifiers' limits allow.

        Where a finger would not be served any more, by the rule again at the lower levels.
        """
        found = as_ramps_allow(self.table, found, self.limits)
        if (factor := self.limits.factor_within(found.layers, self.table)) >= 1 - NEARLY:
            return found
        if len(found.contents.streams) > 1:
            gains = gains_within(self.table, found, self.limits)
            lowered = with_gains(self.table, found, gains)
            if not is_served(lowered, found):
                lowered = replace(self, fingers=_softer(found, gains.tolist())).solve(
                    min_contrast_db
                )
                lowered = replace(lowered, asked=self.fingers)
            found = lowered
            factor = self.limits.factor_within(found.layers, self.table)
        return scaled(found, float(decibels(factor))) if factor < 1 else found

    @cached_property
    def _first_contents(self) -> tuple[tuple[int, ...], ...]:
        """The fingers of each vibration at first: of one name where they must feel one."""
        found: list[list[int]] = []
        for number, finger in enumerate(self.fingers):
            if finger.stimulus is None:
                continue
            for content in found:
                if finger.must_feel_one_with(self.fingers[content[0]]):
                    content.append(number)
                    break
            else:
                found.append([number])
        return tuple(map(tuple, found))

    def _with_more_shared(self, plan: _Plan, min_contrast_db: float) -> _Plan:
        """The plan in which the nearest two fingers share that cannot be apart, else that may."""
        for _ in range(max(1, len(plan.contents) // CONTENTS_A_STEP)):
            pair = self._nearest(plan, are_apart=False)
            if not pair or self._contrast_alone(*pair) >= min_contrast_db:
                pair = self._nearest(plan)
            if not pair:
                break
            plan = self._joined(plan, pair)
        return plan

    def _nearest(self, plan: _Plan, *, are_apart: bool = True) -> tuple[tuple[int, ...], ...]:
        """The nearest two contents that may be one, none without such.

        are_apart: whether each finger could be served by one of its own.
        """
        fingers, pairs = self.fingers, dict[tuple[tuple[int, ...], ...], float]()
        for number, one in enumerate(plan.contents):
            for other in plan.contents[:number]:
                both = [(fingers[a], fingers[b]) for a in one for b in other]
                if all(a.may_feel_one_with(b, are_apart=are_apart) for a, b in both):
                    pairs[other, one] = -min(math.dist(a.at, b.at) for a, b in both)
        return best_by([*pairs], pairs.__getitem__) if pairs else ()

    def _contrast_alone(self, own: Sequence[int], others: Sequence[int]) -> float:
        """Contrast of the nearest two of own and other fingers, were only these on the plate.

        Whatever they feel; infinite without others.
        """
        pairs = [(self.fingers[a], self.fingers[b]) for a in own for b in others]
        if not pairs:
            return math.inf
        one, other = best_by(pairs, lambda each: -math.dist(each[0].at, each[1].at))
        both = replace(one, stimulus=Stimulus()), replace(other, stimulus=None)
        alone = replace(self, fingers=both, avoided=frozenset())
        return alone._measure(_Plan(((0,),))).tones.worst_db

    def _quiet_beside(self, felt: Sequence[int]) -> list[int]:
        """The fingers that must not feel what these fingers feel."""
        return [
            number
            for number, each in enumerate(self.fingers)
            if number not in felt and (each.stimulus is None or each.is_protected)
        ]

    def _in_turn(self, plan: _Plan, tried: Sequence[Answer], min_contrast_db: float) -> Answer:
        """Serve each content that those served before it leave what all need.

        A finger that others disturb first, then by priority, then who is protected, then the
        earliest; last what could not be kept from the finger beside its own, were no other on the
        plate. Where the first cannot be served, the best of tried is.
        """
        every, served = tried[-1], list[tuple[int, ...]]()
        order = sorted(
            plan.contents,
            key=lambda each: (
                self._contrast_alone(each, self._quiet_beside(each)) < min_contrast_db,
                {*each}.isdisjoint(every.disturbed),
                -self.fingers[each[0]].priority,
                not self.fingers[each[0]].is_protected,
            ),
        )
        found, without = self._measure(replace(plan, contents=())), dict.fromkeys(order, every)
        for content in order:
            more, chosen = every, [*served, content]
            if len(chosen) < len(order):
                contents = tuple([each for each in plan.contents if each in chosen])
                more = self._measure(replace(plan, contents=contents))
            without[content] = more
            if not _fails(more, min_contrast_db):
                found, served = more, chosen
            elif content == order[0] and not _is_out_of_bounds(more):
                allowed = [each for each in (*tried, more) if not _is_out_of_bounds(each)]
                found = best_by(allowed, worst_of)
                break
        felt = {finger for stream in found.contents.streams for finger in stream.targets}
        held = [each for each in order if felt.isdisjoint(each)]
        return replace(
            found,
            held=tuple(
                (finger, without[each].tones.contrast_db[finger][2], bool(without[each].disturbed))
                for each in held
                for finger in each
            ),
            applied=(
                *found.applied,
                *(
                    f"vibration of {_at(first)} is "
                    f"{'held back' if first.is_protected else 'neither served nor protected'}"
                    for first in [self.fingers[each[0]] for each in held]
                ),
            ),
        )

    def _joined(self, plan: _Plan, contents: Sequence[tuple[int, ...]]) -> _Plan:
        """The plan with some of its contents as one, that of the highest priority."""
        one, *others = sorted(contents, key=lambda each: -self.fingers[each[0]].priority)
        fingers = sum(others, one)
        at = _at(self.fingers[one[0]])
        return replace(
            plan,
            contents=tuple(
                fingers if each == one else each for each in plan.contents if each not in others
            ),
            applied=(
                *plan.applied,
                *(f"{_at(self.fingers[each[0]])} shares the vibration of {at}" for each in others),
            ),
        )

    def _many_joined(self, plan: _Plan) -> _Plan:
        """The plan with one content for more than MAX_SEPARATE fingers that may all share."""
        groups = defaultdict[str | bool, list[tuple[int, ...]]](list)
        for content in plan.contents:
            finger = self.fingers[content[0]]
            if finger.may_feel_one_with(finger):
                groups[finger.sharing == ANY or str(finger.name)].append(content)
        for group in groups.values():
            if len(group) > MAX_SEPARATE:
                plan = self._joined(plan, group)
        return plan

    @cached_property
    def _bands(self) -> dict[int, tuple[int, int]]:
        """The first of the rows that each finger may have, and one past the last."""
        frequencies, bands = self.table.frequencies.tolist(), {}
        for number, finger in enumerate(self.fingers):
            if finger.stimulus is None:
                continue
            low, high = finger.stimulus.band_hz
            first, end = bisect_left(frequencies, low), bisect_right(frequencies, high)
            if first == end:
                nearest = min(frequencies, key=lambda each: abs(each - low))
                raise InputError(
                    f"band of {_at(finger)} must be LOW-HIGH in Hz and hold a frequency of the "
                    f"table, {frequencies[0]:g} to {frequencies[-1]:g} Hz, of which {nearest:g} Hz "
                    f"is the nearest, got {low:g}-{high:g}; build a table with others: era table "
                    "build --frequencies"
                )
            bands[number] = first, end
        return bands

    def _contents(self, plan: _Plan) -> Contents:
        """A plan for a kernel."""
        bands, streams, background = self._bands, [], None
        for fingers in plan.contents:
            own = tuple(bands.values()) if self.bands_may_swap else (bands[fingers[0]],)
            first = self.fingers[fingers[0]]
            stimulus, priority, level = first.stimulus, first.priority, -math.inf
            for finger in fingers:
                other = self.fingers[finger]
                level = max(level, other.stimulus.level_db_sl if other.stimulus else level)
                priority = max(priority, other.priority)
            duration, limit, course = None, None, None
            if stimulus is not None:
                duration, course = stimulus.duration, stimulus.course
                if course is not None:
                    level += course.strongest_db
                if stimulus.is_limit:
                    level, limit = min(level, FELT_DB_SL), level
            of_stimulus = duration, limit, course
            streams.append(Stream(fingers, float(level), own, priority, *of_stimulus))
        quiet = tuple(self._quiet_beside(sum(plan.contents, ())))
        if len(streams) == 1 and not quiet:
            places = [self.fingers[finger].at for finger in streams[0].targets]
            background = self.table.background(places)
        return Contents(
            tuple([each.at for each in self.fingers]),
            tuple([each.load for each in self.fingers]),
            tuple(streams),
            quiet,
            self.apart_hz,
            background=background,
            drive_mode=self.drive_mode,
            is_shaped=self.is_shaped,
            avoided=self._avoided_by(streams),
        )

    def _avoided_by(self, streams: Sequence[Stream]) -> tuple[int, ...]:
        """The rows to be avoided; none where a content would be left without any."""
        bands = [{*range(*band)} for stream in streams for band in stream.bands]
        return () if any(band <= self.avoided for band in bands) else tuple(self.avoided)

    def _measure(self, plan: _Plan) -> Answer:
        """What fingers feel of a plan's contents."""
        table, contents, applied = self.table, self._contents(plan), plan.applied
        if contents.streams:
            tones = choose_tones(table, contents)
        else:
            tones = Tones.none(len(contents.places), len(table.threshold_sets))
        if not tones.is_apart or len(contents.avoided) < len(self.avoided):
            applied += (f"frequencies are nearer than {self.apart_hz:g} Hz",)
        given = self.fingers, contents, tones, (), applied
        return Answer(*given, table.eras, table.frequencies, table.highest_drives, table.thresholds)


def _avoided(
    table: LocalizationTable, avoided_hz: Sequence[float], apart_hz: float
) -> frozenset[int]:
    """The rows of a table's frequencies that are too near to some that play already [Hz]."""
    near = [np.abs(table.frequencies - each) < apart_hz - SAME_FREQUENCY for each in avoided_hz]
    return frozenset(np.flatnonzero(np.any(near, axis=0)).tolist() if near else ())


def _softer(found: Answer, gains_db: Sequence[float]) -> tuple[Finger, ...]:
    """The fingers of an answer, each at the frequency of its layer and at a lower level."""
    softer = list(found.asked)
    for layer, gain in zip(found.layers, gains_db, strict=True):
        for number in layer.fingers:
            finger = softer[number]
            if finger.stimulus is not None and layer.frequency is not None:
                level = max(MIN_LEVEL_DB_SL, finger.stimulus.level_db_sl + gain)
                band = layer.frequency, layer.frequency
                stimulus = replace(finger.stimulus, level_db_sl=level, band_hz=band)
                softer[number] = replace(finger, stimulus=stimulus)
    return tuple(softer)


def _fails(found: Answer, min_contrast_db: float) -> bool:
    """Whether a finger has less contrast than any must have, or than it asks for."""
    return _is_out_of_bounds(found) or found.tones.worst_db < min_contrast_db


def _is_out_of_bounds(found: Answer) -> bool:
    """Whether a finger has less contrast, or more of others' contents, than it allows."""
    is_one_of_many = len(found.contents.streams) > 1  # one alone cannot give way to others
    return (is_one_of_many and found.lacks_contrast) or bool(found.disturbed)


def worst_of(found: Answer) -> float:
    """Return the least contrast of all fingers that is promised; infinite for one alone."""
    return math.inf if found.promised_worst_db is None else found.promised_worst_db


def _at(finger: Finger) -> str:
    return f"({finger.at[0]:g}, {finger.at[1]:g}) m"
