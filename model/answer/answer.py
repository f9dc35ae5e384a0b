"""One answer to the requests of all fingers, and what is done where not all can be served.

A promise below the least contrast at the worst finger is not served as requested. In this order,
and each only where the requests allow it: the nearest two fingers that may share feel one content;
the finger of the lowest priority that need not be protected gives up content and protection; the
content of the lowest priority is held back. Of many contents several of these steps are one. Where
nothing reaches it, the best tried is served, but for bounds that requests state themselves: these
hold, if by silence.
"""

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from model.answer.modulation import SAME_LEVEL, with_modulation
from model.answer.question import checked_mode
from model.answer.request import (
    ANY_BAND,
    APART_HZ,
    MIN_CONTRAST_DB,
    Answer,
    Finger,
    Request,
    check_requests,
)
from model.answer.search import Contents, Stream, Tones
from model.answer.search_in_c import choose_tones
from model.arguments import expect_between
from model.choice import best_by, best_of
from model.drive_modes import UNRESTRICTED
from model.errors import InputError
from model.table.table import LocalizationTable

MAX_SEPARATE = 5
"""Fingers that may share, up to which each has a content of its own at first.

Of more, one content for all was the end in 34 of 36 sets with two quiet fingers.
"""

CONTENTS_A_STEP = 3
"""Of so many contents one gives way before what is left is measured, at least one in all."""


def answer(
    table: LocalizationTable,
    requests: Sequence[Request],
    fingers: Sequence[Finger] = (),
    *,
    apart_hz: float = APART_HZ,
    bands_may_swap: bool = False,
    drive_mode: str | None = None,
    min_contrast_db: float = MIN_CONTRAST_DB,
    playable: tuple[float, float] = ANY_BAND,
) -> Answer:
    """Answer the requests of all fingers at once, each with a tone of its own.

    fingers: those that are to feel nothing; drive_mode: the table's own if None, which must be
    `phased` for more than one content; apart_hz: distance of the contents' frequencies, where
    their bands allow it; bands_may_swap: whether a content may have the band of another one;
    min_contrast_db: below which the promise at the worst finger is not served as requested;
    playable: lowest and highest frequency of side bands [Hz]. A content whose modulation would
    leave a finger unserved, or whose side bands do not fit, is steady, as is a shared one. Levels
    are lowered where the ERAs' stroke does not allow all: of the lower priorities first, of one
    priority the louder ones first.
    Raises InputError for requests that contradict each other, and a band without frequencies.
    """
    expect_between(apart_hz, 0.0, what="apart_hz")
    check_requests(requests, fingers, table.plate)
    mode = checked_mode(drive_mode or table.drive_mode)
    answering = _Answering(table, tuple(requests), tuple(fingers), mode, apart_hz, bands_may_swap)
    found = answering.solve(min_contrast_db)
    if mode == UNRESTRICTED:
        found = with_modulation(table, found, playable=playable)
    played = [each for each in found.layers if each.excitation]
    changed = [
        f"content of {_at(each.request)} is steady"
        for each in played
        if each.request.modulation_hz is not None and not each.side_bands
    ]
    changed += [
        f"content of {_at(each.request)} is lowered to {each.promised_level_db_sl:.1f} dB SL, "
        "all that the ERAs' stroke allows"
        for each in played
        if each.promised_level_db_sl < each.request.level_db_sl - SAME_LEVEL
        and each.verdict != "shared"
    ]
    return replace(found, applied=(*found.applied, *changed)) if changed else found


@dataclass(frozen=True)
class _Plan:
    """Which fingers, by index, feel which content and which are quiet.

    contents: the fingers of each, its own first; quiet: those that are protected; held: contents
    given up, with the contrast that they would have had, and whether they would disturb a finger;
    applied: what was changed, in words.
    """

    contents: tuple[tuple[int, ...], ...]
    quiet: tuple[int, ...]
    held: tuple[tuple[int, float, bool], ...] = ()
    applied: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Answering:
    """Requests and quiet fingers on a table's plate, numbered in this order."""

    table: LocalizationTable
    requests: tuple[Request, ...]
    fingers: tuple[Finger, ...]
    drive_mode: str
    apart_hz: float
    bands_may_swap: bool

    def solve(self, min_contrast_db: float) -> Answer:
        """Change the plan until the worst finger has the contrast, else take the best tried."""
        count = len(self.requests)
        quiet = range(count, count + len(self.fingers))
        plan = self._many_joined(_Plan(tuple(zip(range(count), strict=True)), tuple(quiet)))
        if len(plan.contents) > 1 and self.drive_mode != UNRESTRICTED:
            raise InputError(
                f"drive mode must be {UNRESTRICTED} for a vibration of each of several fingers, "
                f"got {self.drive_mode}, which plays one; give drive_mode={UNRESTRICTED!r} where "
                "the amplifiers play it"
            )
        tried = [found := self._measure(plan)]
        while _is_out_of_bounds(found) or (
            found.tones.worst_db < min_contrast_db and len(plan.contents) > 1
        ):
            for _ in range(max(1, len(plan.contents) // CONTENTS_A_STEP)):
                plan = self._with_less(plan, found)
            tried.append(found := self._measure(plan))
        if not found.tones.worst_db < min_contrast_db:  # NaN where nobody else is there
            return found
        best = best_by([each for each in tried if not _is_out_of_bounds(each)], _worst_of)
        below = f"nothing reaches {min_contrast_db:g} dB: the best that was tried is served"
        return replace(best, applied=(*best.applied, below))

    def _with_less(self, plan: _Plan, found: Answer) -> _Plan:
        """The plan after the next step of the rule."""
        requests, contents = self.requests, plan.contents
        pairs = [
            (one, other)
            for number, one in enumerate(contents)
            for other in contents[:number]
            if all(requests[a].may_feel_one_with(requests[b]) for a in one for b in other)
        ]
        if pairs:
            near = [
                -min(math.dist(requests[a].at, requests[b].at) for a in one for b in other)
                for one, other in pairs
            ]
            return self._joined(plan, pairs[best_of(near)])
        disturbed = found.disturbed[:1]
        others = [each for each in contents if not {*disturbed}.intersection(each)]
        least = min(requests[each[0]].priority for each in others)
        lowest = [each for each in others if requests[each[0]].priority == least]
        open_ = [
            each for each in lowest if not any(requests[finger].is_protected for finger in each)
        ]
        given_up = (open_ or lowest)[-1]
        had = [found.tones.contrast_db[finger][2] for finger in given_up]
        verb = "is neither served nor protected" if open_ else "is held back"
        return _Plan(
            tuple(each for each in contents if each != given_up),
            plan.quiet if open_ else (*plan.quiet, *given_up),
            (
                *plan.held,
                *(
                    (finger, -math.inf if math.isnan(each) else each, bool(disturbed))
                    for finger, each in zip(given_up, had, strict=True)
                ),
            ),
            (*plan.applied, f"content of {_at(requests[given_up[0]])} {verb}"),
        )

    def _joined(self, plan: _Plan, contents: Sequence[tuple[int, ...]]) -> _Plan:
        """The plan with some of its contents as one, that of the highest priority."""
        one, *others = sorted(contents, key=lambda each: -self.requests[each[0]].priority)
        fingers = sum(others, one)
        at = _at(self.requests[one[0]])
        return replace(
            plan,
            contents=tuple(
                fingers if each == one else each for each in plan.contents if each not in others
            ),
            applied=(
                *plan.applied,
                *(f"{_at(self.requests[each[0]])} shares the content of {at}" for each in others),
            ),
        )

    def _many_joined(self, plan: _Plan) -> _Plan:
        """The plan with one content for more than MAX_SEPARATE fingers that may all share."""
        groups = defaultdict[str | bool, list[tuple[int, ...]]](list)
        for content in plan.contents:
            request = self.requests[content[0]]
            if request.may_feel_one_with(request):
                groups[request.may_share or str(request.content)].append(content)
        for group in groups.values():
            if len(group) > MAX_SEPARATE:
                plan = self._joined(plan, group)
        return plan

    @cached_property
    def _every(self) -> list[Request | Finger]:
        return [*self.requests, *self.fingers]

    @cached_property
    def _bands(self) -> list[tuple[int, int]]:
        """The first of the rows that each request may have, and one past the last."""
        frequencies, bands = self.table.frequencies.tolist(), []
        for request in self.requests:
            low, high = request.band_hz
            first, end = bisect_left(frequencies, low), bisect_right(frequencies, high)
            if first == end:
                nearest = min(frequencies, key=lambda each: abs(each - low))
                raise InputError(
                    f"band of {_at(request)} must be LOW-HIGH in Hz and hold a frequency of the "
                    f"table, {frequencies[0]:g} to {frequencies[-1]:g} Hz, of which {nearest:g} Hz "
                    f"is the nearest, got {low:g}-{high:g}"
                )
            bands.append((first, end))
        return bands

    def _contents(self, plan: _Plan) -> Contents:
        """A plan for a kernel."""
        bands, streams, background = self._bands, [], None
        for fingers in plan.contents:
            own = tuple(bands) if self.bands_may_swap else (bands[fingers[0]],)
            request = self.requests[fingers[0]]
            level, priority = request.level_db_sl, request.priority
            for finger in fingers[1:]:
                request = self.requests[finger]
                level = max(level, request.level_db_sl)
                priority = max(priority, request.priority)
            streams.append(Stream(fingers, level, own, priority))
        if len(streams) == 1 and not plan.quiet:
            places = [self.requests[finger].at for finger in streams[0].targets]
            background = self.table.background(places)
        return Contents(
            tuple([each.at for each in self._every]),
            tuple([each.load for each in self._every]),
            tuple(streams),
            plan.quiet,
            self.apart_hz,
            background=background,
            drive_mode=self.drive_mode,
        )

    def _measure(self, plan: _Plan) -> Answer:
        """What fingers feel of a plan's contents."""
        contents, applied = self._contents(plan), plan.applied
        if contents.streams:
            tones = choose_tones(self.table, contents)
        else:
            tones = Tones.none(len(contents.places))
        if not tones.is_apart:
            applied += (f"frequencies are nearer than {self.apart_hz:g} Hz",)
        given = self.requests, self.fingers, contents, tones, plan.held, applied
        return Answer(*given, self.table.eras, self.table.frequencies)


def _is_out_of_bounds(found: Answer) -> bool:
    """Whether a finger has less contrast, or more of others' contents, than it allows."""
    is_one_of_many = len(found.contents.streams) > 1  # one alone cannot give way to others
    return (is_one_of_many and found.lacks_contrast) or bool(found.disturbed)


def _worst_of(found: Answer) -> float:
    return math.inf if found.promised_worst_db is None else found.promised_worst_db


def _at(request: Request) -> str:
    return f"({request.at[0]:g}, {request.at[1]:g}) m"
