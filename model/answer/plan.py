"""Answer all fingers together, and decide which fingers give way if not all can be served.

Every finger that requests a vibration gets its own, as long as the worst finger has the minimum
contrast. Otherwise fingers share: the nearest first, and only if they allow it. Two fingers that
could not be separated even if they were alone on the plate come before two that merely allow
sharing. If that is not enough, vibrations are served one after the other, by priority and arrival,
each only if the previous ones leave room for it. A vibration that cannot be kept from the nearest
finger in any case comes last. If not even the first can be served, the best answer tried is
returned. Limits that fingers set always hold; if necessary, a vibration is held back.

Modulation, the levels that quiet fingers allow and the amplifiers' limits follow
(`model.answer.adjustments`).
"""

import math
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import filterfalse
from typing import Any

import numpy as np

from model.answer.adjustments import (
    as_quiet_fingers_allow,
    as_ramps_allow,
    gains_within,
    is_served,
    scaled,
    with_gains,
    with_modulation,
)
from model.answer.answer import (
    APART_HZ,
    MIN_CONTRAST_DB,
    NO_LIMITS,
    SAME_LEVEL,
    Answer,
    Limits,
)
from model.answer.question import Contents, Stream, Tones
from model.answer.stimulus import (
    ANY,
    MIN_LEVEL_DB_SL,
    Finger,
    Placement,
    Stimulus,
    check_fingers,
    together,
)
from model.answer.tone_search import choose_tones
from model.arrays import NEARLY, Point, best_by
from model.drive_modes import UNRESTRICTED, checked_mode
from model.errors import InputError
from model.finger import FELT_DB_SL, STRONG_DB_SL, decibels
from model.structure.fingertips import with_patches
from model.table.record import SAME_FREQUENCY
from model.table.table import LocalizationTable

MAX_SEPARATE = 5
"""Maximum number of sharing fingers that first get separate vibrations.

With more, 34 of 36 sets with two quiet fingers ended with one vibration for all.
"""

CONTENTS_A_STEP = 3
"""Each round merges one in this many vibrations, and at least one."""


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
    """Answer all fingers together, each with its own vibration.

    Args:
        table: localization table of the plate.
        fingers: with their stimuli.
        quiet: more fingers, which should feel nothing.
        drive_mode: by default the table's; must be `phased` for more than one vibration.
        shaped: whether the amplifiers play shaped onsets and endings, which `Timing` adds.
        apart_hz: minimum distance of the frequencies from each other and from avoided_hz,
            if their bands allow it.
        avoided_hz: frequencies of vibrations that are playing already.
        bands_may_swap: whether fingers can swap bands.
        min_contrast_db: promised contrast of the worst finger below which fingers give way.
        limits: of the amplifiers.

    A modulated stimulus becomes steady if its modulation would leave a finger unserved, if its side
    bands do not fit, if it is shared, or if clocks are not synchronized. If stroke and limits do
    not allow all levels, lower priorities are reduced first, and louder ones first among equal
    priorities.

    Raises InputError for fingers that contradict each other, and for a band without frequencies.
    """
    if not 0 <= apart_hz < math.inf:  # False for NaN
        raise InputError(f"apart_hz must be a distance of frequencies in Hz, got {apart_hz}")
    quiet_fingers = map(_quiet_finger, quiet)
    all_fingers = (*fingers, *quiet_fingers)
    check_fingers(all_fingers, table.plate)
    search = _Search(
        table=table,
        fingers=all_fingers,
        drive_mode=checked_mode(drive_mode or table.drive_mode),
        is_shaped=shaped,
        apart_hz=apart_hz,
        avoided=_rows_near(table, avoided_hz, apart_hz),
        bands_may_swap=bands_may_swap,
        limits=limits,
        min_contrast_db=min_contrast_db,
    )
    result = search.solve()
    result = search.within_limits(result)
    notes = (*_steady_notes(result), *_level_notes(result))
    if not notes:
        return result  # a copy would lose cached results
    return replace(result, applied=(*result.applied, *notes))


def _quiet_finger(position: Point | Finger) -> Finger:
    """Convert to a finger that should feel nothing."""
    return position if isinstance(position, Finger) else Finger(position)


def _rows_near(
    table: LocalizationTable, frequencies: Sequence[float], apart_hz: float
) -> frozenset[int]:
    """Return rows of the table that are too close to frequencies [Hz]."""
    rows: set[int] = set()
    for frequency in frequencies:
        distance = np.abs(table.frequencies - frequency)
        rows.update(np.flatnonzero(distance < apart_hz - SAME_FREQUENCY).tolist())
    return frozenset(rows)


def query(
    table: LocalizationTable,
    placed: Placement,
    level_db_sl: float = STRONG_DB_SL,
    *,
    drive_mode: str | None = None,
    **stimulus: Any,
) -> Answer:
    """Answer fingers that feel one vibration and others that feel nothing; see `answer`."""
    fingers = together(placed, Stimulus(level_db_sl, **stimulus))
    return answer(table, fingers, drive_mode=drive_mode)


def prepare_answers(table: LocalizationTable, drive_mode: str | None = None) -> None:
    """Compute in advance the data for the first answer of a table in a drive mode."""
    center = (table.plate.length / 2, table.plate.width / 2)
    for quiet in ((), ((0.0, 0.0),)):
        placed = Placement((center,), quiet)
        query(table, placed, MIN_LEVEL_DB_SL, drive_mode=drive_mode)


def _steady_notes(result: Answer) -> Iterator[str]:
    """Yield notes about vibrations that are steady although their stimulus is modulated."""
    tones_of = Counter(result.tones.owners)
    for number, stream in enumerate(result.contents.streams):
        finger = result.asked[stream.targets[0]]
        is_modulated = finger.stimulus is not None and finger.stimulus.modulation_hz is not None
        if is_modulated and tones_of[number] == 1:
            yield f"vibration of {_at(finger)} is steady"


def _level_notes(result: Answer) -> Iterator[str]:
    """Yield notes about vibrations that are weaker than requested, with the reason."""
    for stream in result.contents.streams:
        first = stream.targets[0]
        is_continuous = stream.duration is None
        nominal_level, promised_level = result.tones.level_db_sl[first]
        level = promised_level if is_continuous else nominal_level
        is_reached = level >= stream.level_db_sl - SAME_LEVEL
        if stream.limit_db_sl is not None or is_reached:
            continue
        if result.stroke_factor < 1 - NEARLY or is_continuous:
            reason = "the limit of the ERAs' stroke and the amplifiers"
        else:
            reason = "so that quiet fingers feel at most half of it"
        at = _at(result.asked[first])
        yield f"vibration of {at} is lowered to {level:.1f} dB SL, {reason}"


@dataclass(frozen=True)
class _Plan:
    """Assignment of fingers to contents, by index; all others that are protected are quiet."""

    contents: tuple[tuple[int, ...], ...]
    """Fingers of each content, its own first."""
    applied: tuple[str, ...] = ()
    """Changes to the requests, one sentence each."""


@dataclass(frozen=True, kw_only=True)
class _Search:
    """Search for an answer; fingers are numbered in their order."""

    table: LocalizationTable
    fingers: tuple[Finger, ...]
    drive_mode: str
    is_shaped: bool
    apart_hz: float
    avoided: frozenset[int]
    """Rows of the table's frequencies that are playing already, or are too close to these."""
    bands_may_swap: bool
    limits: Limits
    min_contrast_db: float

    def solve(self) -> Answer:
        """Assign vibrations to fingers, then set modulation and levels.

        First, each finger has its own vibration. Until all have enough contrast, fingers share, and
        are then served one after the other. Otherwise the best answer tried is returned.
        """
        plan = self._first_plan()
        self._check_drive_mode(plan)
        plan, tried = self._share_until_served(plan)
        result = tried[-1]
        if self._fails(result):
            result = self._serve_in_turn(plan, tried)
        if result.tones.worst_db < self.min_contrast_db:  # NaN for a single finger
            note = f"no answer reaches {self.min_contrast_db:g} dB: the best one tried is used"
            result = replace(result, applied=(*result.applied, note))
        if self.drive_mode == UNRESTRICTED and not self.table.clocks.groups:
            result = with_modulation(self.table, result, playable=self.limits.frequencies)
        if any(stream.limit_db_sl is not None for stream in result.contents.streams):
            result = as_quiet_fingers_allow(self.table, result)
        return result

    def within_limits(self, result: Answer) -> Answer:
        """Reduce the answer to the amplifiers' limits.

        If this would leave a finger unserved, all fingers are planned again at the lower levels.
        """
        result = as_ramps_allow(self.table, result, self.limits)
        factor = self.limits.factor_within(result.layers, self.table)
        if factor >= 1 - NEARLY:
            return result
        if len(result.contents.streams) > 1:
            result = self._lowered_by_priority(result)
            factor = self.limits.factor_within(result.layers, self.table)
        return scaled(result, float(decibels(factor))) if factor < 1 else result

    def _lowered_by_priority(self, result: Answer) -> Answer:
        """Lower the vibrations, low priorities first, until limits hold."""
        gains = gains_within(self.table, result, self.limits)
        lowered = with_gains(self.table, result, gains)
        if is_served(lowered, result):
            return lowered
        softer = replace(self, fingers=_softer(result, gains.tolist()))
        return replace(softer.solve(), asked=self.fingers)

    def _check_drive_mode(self, plan: _Plan) -> None:
        """Raise InputError for several vibrations in a drive mode that plays only one."""
        if len(plan.contents) > 1 and self.drive_mode != UNRESTRICTED:
            raise InputError(
                f"drive mode must be {UNRESTRICTED} for separate vibrations of several fingers, "
                f"got {self.drive_mode}, which plays one; if the amplifiers support it, use "
                f"drive_mode={UNRESTRICTED!r}, or --mode {UNRESTRICTED} with era table query or "
                "build"
            )

    def _fails(self, result: Answer) -> bool:
        """Return whether a finger has less contrast than the common minimum, or than it
        requires."""
        return _is_out_of_bounds(result) or result.tones.worst_db < self.min_contrast_db

    def _share_until_served(self, plan: _Plan) -> tuple[_Plan, list[Answer]]:
        """Let fingers share until all are served; return the last plan, and all answers tried."""
        tried = [self._measure(plan)]
        while self._fails(tried[-1]):
            shared = self._with_more_shared(plan)
            if shared == plan:
                break
            plan = shared
            tried.append(self._measure(plan))
        return plan, tried

    def _first_plan(self) -> _Plan:
        """Return a plan with a separate vibration for each finger, unless fingers must or can
        share."""
        plan = _Plan(self._first_contents)
        return self._many_joined(plan) if len(plan.contents) > MAX_SEPARATE else plan

    @cached_property
    def _first_contents(self) -> tuple[tuple[int, ...], ...]:
        """Return the fingers of each vibration in the first plan; fingers that must share are
        together."""
        groups: list[list[int]] = []
        for number, finger in enumerate(self.fingers):
            if finger.stimulus is None:
                continue
            for group in groups:
                if finger.must_feel_one_with(self.fingers[group[0]]):
                    group.append(number)
                    break
            else:
                groups.append([number])
        return tuple(map(tuple, groups))

    def _with_more_shared(self, plan: _Plan) -> _Plan:
        """Let the nearest two fingers share that cannot be separated, else the nearest that allow
        it."""
        for _ in range(max(1, len(plan.contents) // CONTENTS_A_STEP)):
            pair = self._nearest(plan, are_apart=False)
            if not pair or self._contrast_alone(*pair) >= self.min_contrast_db:
                pair = self._nearest(plan)
            if not pair:
                break
            plan = self._joined(plan, pair)
        return plan

    def _nearest(self, plan: _Plan, *, are_apart: bool = True) -> tuple[tuple[int, ...], ...]:
        """Return the nearest two contents that can be merged, empty if no two can.

        are_apart: whether each finger could be served with its own vibration.
        """
        distances: dict[tuple[tuple[int, ...], ...], float] = {}
        for number, second in enumerate(plan.contents):
            for first in plan.contents[:number]:
                pairs = self._finger_pairs(second, first)
                if all(a.may_feel_one_with(b, are_apart=are_apart) for a, b in pairs):
                    distances[first, second] = min(math.dist(a.at, b.at) for a, b in pairs)
        if not distances:
            return ()
        return best_by([*distances], lambda contents: -distances[contents])

    def _contrast_alone(self, own: Sequence[int], others: Sequence[int]) -> float:
        """Return the contrast [dB] of the nearest own and other finger, if only these were
        touching.

        Independent of their stimuli; infinite without others.
        """
        pairs = self._finger_pairs(own, others)
        if not pairs:
            return math.inf
        felt, quiet = best_by(pairs, lambda pair: -math.dist(pair[0].at, pair[1].at))
        nearest_pair = (
            replace(felt, stimulus=Stimulus()),
            replace(quiet, stimulus=None, is_protected=True),
        )
        alone = replace(self, fingers=nearest_pair, avoided=frozenset())
        return alone._measure(_Plan(((0,),))).tones.worst_db

    def _finger_pairs(
        self, group: Sequence[int], other_group: Sequence[int]
    ) -> list[tuple[Finger, Finger]]:
        """Return all pairs of fingers from two groups."""
        fingers = self.fingers
        return [(fingers[a], fingers[b]) for a in group for b in other_group]

    def _protected_from(self, felt: Sequence[int]) -> list[int]:
        """Return the fingers that must not feel the vibration of the given fingers."""
        protected = []
        for number, finger in enumerate(self.fingers):
            if number not in felt and finger.is_protected and not finger.is_load:
                protected.append(number)
        return protected

    def _serve_in_turn(self, plan: _Plan, tried: Sequence[Answer]) -> Answer:
        """Serve contents one after another, each only if all earlier ones still meet their
        requirements.

        If not even the first can be served, the best of the answers tried is returned.
        """
        order = [*plan.contents]
        if len(order) > 1:  # each key needs an answer
            order.sort(key=lambda content: self._order_key(content, tried[-1]))
        served: list[tuple[int, ...]] = []
        result = self._measure(replace(plan, contents=()))
        with_content = dict.fromkeys(order, tried[-1])
        for content in order:
            attempt = tried[-1]
            if len(served) + 1 < len(order):
                chosen = {*served, content}
                contents = tuple(filter(chosen.__contains__, plan.contents))
                attempt = self._measure(replace(plan, contents=contents))
            with_content[content] = attempt
            if not self._fails(attempt):
                result = attempt
                served.append(content)
            elif content == order[0] and not _is_out_of_bounds(attempt):
                attempts = (*tried, attempt)
                within_bounds = [*filterfalse(_is_out_of_bounds, attempts)]
                result = best_by(within_bounds, worst_of)
                break
        return self._with_held_back(result, with_content)

    def _order_key(self, content: Sequence[int], together: Answer) -> tuple[bool, bool, int, bool]:
        """Return the sort key of a content served in turn; together: the answer with all contents.

        First come fingers that others disturb, then higher priorities, then protected fingers. Last
        come contents that could not even be kept from the finger next to their own.
        """
        first = self.fingers[content[0]]
        return (
            self._contrast_alone(content, self._protected_from(content)) < self.min_contrast_db,
            {*content}.isdisjoint(together.disturbed),
            -first.priority,
            not first.is_protected,
        )

    def _with_held_back(
        self, result: Answer, with_content: Mapping[tuple[int, ...], Answer]
    ) -> Answer:
        """Record the contents that are held back, with the contrast each would have been
        promised."""
        felt = {finger for stream in result.contents.streams for finger in stream.targets}
        held: list[tuple[int, float, bool]] = []
        notes: list[str] = []
        for content, attempt in with_content.items():
            if not felt.isdisjoint(content):
                continue
            for finger in content:
                contrast = attempt.tones.contrast_db[finger][2]
                held.append((finger, contrast, bool(attempt.disturbed)))
            first = self.fingers[content[0]]
            what = "held back" if first.is_protected else "neither served nor protected"
            notes.append(f"vibration of {_at(first)} is {what}")
        return replace(result, held=tuple(held), applied=(*result.applied, *notes))

    def _joined(self, plan: _Plan, contents: Sequence[tuple[int, ...]]) -> _Plan:
        """Return the plan with some contents merged into the one with the highest priority."""
        by_priority = sorted(contents, key=lambda content: -self.fingers[content[0]].priority)
        host, guests = by_priority[0], by_priority[1:]
        joined = sum(guests, host)
        plan_contents = []
        for content in plan.contents:
            if content == host:
                plan_contents.append(joined)
            elif content not in guests:
                plan_contents.append(content)
        at = _at(self.fingers[host[0]])
        notes = [f"{_at(self.fingers[guest[0]])} shares the vibration of {at}" for guest in guests]
        return replace(plan, contents=tuple(plan_contents), applied=(*plan.applied, *notes))

    def _many_joined(self, plan: _Plan) -> _Plan:
        """Return the plan with a single content for more than MAX_SEPARATE sharing fingers."""
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
        """Return the first row of the table's frequencies and one past the last for each finger's
        band."""
        frequencies = self.table.frequencies.tolist()
        bands: dict[int, tuple[int, int]] = {}
        for number, finger in enumerate(self.fingers):
            if finger.stimulus is None:
                continue
            low, high = finger.stimulus.band_hz
            first, end = bisect_left(frequencies, low), bisect_right(frequencies, high)
            if first == end:
                nearest = min(frequencies, key=lambda frequency: abs(frequency - low))
                raise InputError(
                    f"band of {_at(finger)} must be LOW-HIGH in Hz and contain a frequency of the "
                    f"table, {frequencies[0]:g} to {frequencies[-1]:g} Hz (nearest: {nearest:g} "
                    f"Hz), got {low:g}-{high:g}; build a table with others: era table "
                    "build --frequencies"
                )
            bands[number] = first, end
        return bands

    def _contents(self, plan: _Plan) -> Contents:
        """Return the contents of a plan for the tone search."""
        streams = tuple(self._stream(content) for content in plan.contents)
        quiet = tuple(self._protected_from(sum(plan.contents, ())))
        background = None
        if len(streams) == 1 and not quiet:
            targets = [self.fingers[finger].at for finger in streams[0].targets]
            background = self.table.background(targets)
        leaves_none = False
        for stream in streams:
            for band in stream.bands:
                leaves_none = leaves_none or self.avoided.issuperset(range(*band))
        positions, loads = with_patches(
            [finger.at for finger in self.fingers],
            [finger.load for finger in self.fingers],
            (self.table.plate.length, self.table.plate.width),
        )
        return Contents(
            places=tuple(positions),
            loads=tuple(loads),
            streams=streams,
            quiet=quiet,
            apart_hz=self.apart_hz,
            background=background,
            drive_mode=self.drive_mode,
            is_shaped=self.is_shaped,
            avoided=() if leaves_none else tuple(self.avoided),
        )

    def _stream(self, content: Sequence[int]) -> Stream:
        """Return the stream of a content: its first finger's stimulus at the highest requested
        level."""
        fingers = [self.fingers[number] for number in content]
        stimuli = [finger.stimulus for finger in fingers if finger.stimulus is not None]
        stimulus = stimuli[0]
        level = max([requested.level_db_sl for requested in stimuli])
        if stimulus.course is not None:
            level += stimulus.course.strongest_db
        limit = None
        if stimulus.is_limit:
            limit = level
            level = min(level, FELT_DB_SL)
        bands = tuple(self._bands.values()) if self.bands_may_swap else (self._bands[content[0]],)
        return Stream(
            targets=tuple(content),
            level_db_sl=float(level),
            bands=bands,
            priority=max([finger.priority for finger in fingers]),
            duration=stimulus.duration,
            limit_db_sl=limit,
            course=stimulus.course,
        )

    def _measure(self, plan: _Plan) -> Answer:
        """Choose the tones of a plan and compute the sensations of all fingers."""
        table, contents = self.table, self._contents(plan)
        if contents.streams:
            tones = choose_tones(table, contents)
        else:
            tones = Tones.none(len(contents.places), len(table.threshold_sets))
        notes = plan.applied
        ignores_avoided = len(contents.avoided) < len(self.avoided)
        if not tones.is_apart or ignores_avoided:
            notes = (*notes, f"frequencies are closer than {self.apart_hz:g} Hz")
        return Answer(
            asked=self.fingers,
            contents=contents,
            tones=tones,
            held=(),
            applied=notes,
            eras=table.eras,
            frequencies=table.frequencies,
            highest_drives=table.highest_drives,
            thresholds=table.thresholds,
        )


def _softer(result: Answer, gains_db: Sequence[float]) -> tuple[Finger, ...]:
    """Return the fingers of an answer, at the frequencies of their layers, with gains [dB]."""
    softer = list(result.asked)
    for layer, gain in zip(result.layers, gains_db, strict=True):
        for number in layer.fingers:
            finger = softer[number]
            if finger.stimulus is not None and layer.frequency is not None:
                level = max(MIN_LEVEL_DB_SL, finger.stimulus.level_db_sl + gain)
                band = layer.frequency, layer.frequency
                stimulus = replace(finger.stimulus, level_db_sl=level, band_hz=band)
                softer[number] = replace(finger, stimulus=stimulus)
    return tuple(softer)


def _is_out_of_bounds(result: Answer) -> bool:
    """Return whether a finger has less contrast, or more of others' contents, than it allows."""
    is_one_of_many = len(result.contents.streams) > 1  # a single content cannot give way
    return (is_one_of_many and result.lacks_contrast) or bool(result.disturbed)


def worst_of(result: Answer) -> float:
    """Return the promised contrast [dB] of the worst finger, infinite for a single finger."""
    return math.inf if result.promised_worst_db is None else result.promised_worst_db


def _at(finger: Finger) -> str:
    return f"({finger.at[0]:g}, {finger.at[1]:g}) m"
