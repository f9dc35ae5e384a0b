"""One session of a case on a plate of its own: what its fingers were promised, and what they felt.

Control loop, serial lines and amplifiers run in virtual time, the plate in time under the fingers;
a witness reads every byte.
"""

import asyncio
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.promise.cases import (
    CASES,
    CHANGES,
    HELD,
    JOINS,
    LEAVES,
    LEVEL_DB_SL,
    MOVES,
    Case,
    Point,
)
from benchmarks.promise.clicked import Clicked, clicks, measured, owner_of
from benchmarks.promise.heard import STRONGEST, Heard, Log, Span
from benchmarks.setting import random_contacts, support
from controller.play.intent import HapticIntent, Prediction, Target
from controller.play.loop import PlayReport
from controller.play.slots import CROSSFADE, FALL_AFTER
from model.answer.answer_report import Timing
from model.finger import FINGERTIP_RADIUS
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.imperfections import draw_imperfections
from sim.transport.simulated_line import PROMPT

_chain: Any = support("chain").Chain
_run_virtual: Any = support("virtual_lines").run_virtual

SETTLING, STEADY, FIRST, NEXT = 2.0, 0.25, 0.100, 0.080  # s
EARLY = 0.020  # s; by which amplifiers may start before another: less than between two cross-fades
SPEED, WAY = 0.2, 0.1  # m/s, m; of the finger that moves
STEP, REPORTED = 0.0025, 4
"""Steps [s] of the finger that moves, and lifts: longer ones would be taps on the plate. The panel
reports every fourth."""
ANSWERS = "answers while moving, above their promise"
"""Of the contrast over the next 80 ms; its share of 0 dB and more is what is kept."""
UNTIL = "joining, 3 dB short until [ms]"
"""After the commit: from then on a finger that joins feels, over 40 ms, no more than 3 dB less than
its steady promise. Until then foreign contents ring on, which were loud where it lands."""
STEPS = "cross-fades, foreign above promise"
"""Until anything else happens, and above what has been felt before: a landing may ring yet."""
LANDED = "100 to 300 ms after a landing, foreign above promise"
RUNG = 0.300  # s
LIFTING = np.arange(0.875, 0, -0.125)  # load of the finger, until the panel reports that it is off


@dataclass
class Outcome:
    """Of one session [dB].

    worst: promise and contrast of the worst finger when all contents are felt; fingers: promise and
    contrast of each finger that is served, after every event, too; served: share of the contents.
    events: figures by name; clicked: figures of clicks, without any other.
    """

    worst: tuple[float, float]
    served: float
    fingers: list[tuple[float, float]] = field(default_factory=list)
    events: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    clicked: Clicked | None = None


@dataclass(frozen=True)
class _Steady:
    """What has been promised to each finger, and the time [s] when it is measured."""

    applied: PlayReport
    until: float

    @property
    def span(self) -> tuple[float, float]:
        return self.until - STEADY, self.until

    @property
    def promised(self) -> Mapping[int, Prediction]:
        return _promises(self.applied)

    @property
    def served(self) -> list[int]:
        return [id for id, each in self.promised.items() if each.verdict in ("own", "mixed")]


@dataclass(frozen=True)
class _Event:
    """What the last finger with a content has done; time [s]: when its answer was commanded."""

    name: str
    time: float
    before: _Steady
    first: PlayReport
    after: _Steady
    path: tuple[tuple[float, float], ...] = ()
    answers: tuple[PlayReport, ...] = ()


class _Wanted:
    """Contents that fingers are to feel, and the last click."""

    def __init__(self) -> None:
        self.targets: dict[int, dict[str, Any]] = {}
        self.click: Target | None = None

    def intent(self, contacts: Any, now: float) -> HapticIntent:
        """Return the intent for contacts."""
        targets = [
            Target(each.key, LEVEL_DB_SL, content=str(each.key), **self.targets[each.key.id])
            for each in contacts
            if each.key.id in self.targets
        ]
        pulse = None if self.click is None else self.click.pulse
        if self.click is None or pulse is None or now >= pulse.end:
            return HapticIntent(tuple(targets))
        return HapticIntent((*targets, self.click), until=pulse.end)


@cache
def _timing(number: int) -> Timing:
    return Timing(CASES[number].table)


def outcome(number: int, seed: int) -> Outcome:
    """Run a case by its number on the plate of a seed."""
    case = CASES[number]
    return _run_virtual(_Session(case, _timing(number), seed).run())  # type: ignore[no-any-return]


class _Session:
    def __init__(self, case: Case, timing: Timing, seed: int) -> None:
        self._case, self._timing, self._rig = case, timing, case.rig
        plate = self._rig.plate
        draw = partial(
            random_contacts,
            np.random.default_rng([seed, 14]),
            size=(plate.length, plate.width),
            margin=FINGERTIP_RADIUS + 0.001,
        )
        count = case.contents + case.quiet
        self._places: list[Point] = [(float(x), float(y)) for x, y in draw(count)]
        if JOINS in case.events:  # elsewhere: where it left, others may be quiet yet
            ((x, y),) = draw(1, beside=self._places)
            self._landing = float(x), float(y)
        self._drawn = draw_imperfections(self._rig, seed=1000 + seed)
        self._wanted = _Wanted()
        self._last = case.contents - 1

    @property
    def _wires(self) -> SimulatedWire | dict[str, SimulatedWire]:
        """One line of all amplifiers, or one of each."""
        case = self._case
        kind = case.line or PROMPT
        one = SimulatedWire(
            "serial", speed=921_600, shared=True, line_kind=kind, seed=self._drawn.seed
        )
        if case.is_one_bus:
            return one
        return {name: replace(one, shared=False, line=name) for name in self._rig.amplifiers}

    async def run(self) -> Outcome:
        """All fingers at once, then each event."""
        on: Any
        async with _chain.armed(
            self._wires,
            self._rig,
            self._case.table,
            intent_source=self._wanted,
            timing=self._timing,
            imperfections=self._drawn,
        ) as on:
            on.must_be_felt = False
            log = Log(self._rig, self._drawn, threads.now())
            log.watch(on.far.bench)
            case = self._case
            contents = self._places[: case.contents]
            for id, band in enumerate(case.bands_for(contents)):
                of_last = case.modulation_hz if id == self._last else None
                self._wanted.targets[id] = {"band": band, "modulation_hz": of_last}
            await asyncio.sleep(HELD if len(self._rig.amplifiers) > 1 else 0)
            for id, at in enumerate(self._places):
                on.at[id] = at
                await on.hold(case.apart)
            if case.resting:
                await on.hold(case.resting)
            if case.clicks:
                await on.hold(SETTLING)
                clicked = await clicks(on, self._wanted, case.clicks)
                self._note_owners(log, on)
                on.far.bench.advance(threads.now())
                count = case.contents + case.quiet
                found = measured(log, clicked, count, threads.now())
                return Outcome((0.0, 0.0), len(clicked) / len(case.clicks), clicked=found)
            before = first = await self._settled(on)
            events = []
            for name in case.events:
                event = await self._event(on, name, before)
                events.append(event)
                before = event.after
            self._note_owners(log, on)
            on.far.bench.advance(before.until)
            return _measured(log, first, events, self._timing, self._case, on.applied)

    def _note_owners(self, log: Log, on: Any) -> None:
        for applied in on.applied:
            owners = {n: owner_of(one) for n, one in applied.contents.items()}
            log.own(owners, applied.time - EARLY)

    async def _settled(self, on: Any) -> _Steady:
        await on.hold(SETTLING)
        return _Steady(on.applied[-1], threads.now())

    async def _event(self, on: Any, name: str, before: _Steady) -> _Event:
        count, began, path = len(on.applied), threads.now(), [threads.now()]
        if name == LEAVES:
            for load in LIFTING:
                self._place(on, {str(self._last): float(load)})
                await asyncio.sleep(STEP)
            began = threads.now()
            del on.at[self._last]
        elif name == JOINS:
            on.at[self._last] = self._landing
        elif name == CHANGES:
            self._wanted.targets[self._last]["band"] = self._other_band(before)
        else:
            for number, at in enumerate(self._way(on.at)):
                on.at[self._last] = at
                if number % REPORTED == 0:
                    on.report()
                else:
                    self._place(on, {})
                await asyncio.sleep(STEP)
                path.append(threads.now())
        after = await self._settled(on)
        first = on.applied[min(count, len(on.applied) - 1)]
        answers = [each for each in on.applied[count:] if path[0] < each.time < path[-1] - NEXT]
        way = tuple(pairwise(path))
        return _Event(name, max(first.time, began), before, first, after, way, tuple(answers))

    def _place(self, on: Any, loads: Mapping[str, float]) -> None:
        """Place the fingers on the plate without a report of the panel."""
        fingers = {str(id): place for id, place in on.at.items()}
        on.far.bench.place_fingers(fingers, now=threads.now(), loads=loads)

    def _other_band(self, before: _Steady) -> tuple[float, float]:
        """A band of the changed content without its frequency."""
        frequencies = self._case.table.frequencies
        low, high = float(frequencies[0]), float(frequencies[-1])
        played = before.promised[self._last].frequency or low
        return (played + 30, high) if played < math.sqrt(low * high) else (low, played - 30)

    def _way(self, at: Mapping[int, Point]) -> Iterator[Point]:
        """The places on the way that leaves most room to other fingers and edges."""
        x, y = at[self._last]
        others = [place for id, place in at.items() if id != self._last]
        plate, edge = self._rig.plate, FINGERTIP_RADIUS + 0.001

        def along(way: Point) -> list[Point]:
            steps = np.arange(1, round(WAY / SPEED / STEP) + 1) * SPEED * STEP
            return [(x + float(s) * way[0], y + float(s) * way[1]) for s in steps]

        def room(way: Point) -> float:
            end_x, end_y = along(way)[-1]
            is_on = edge <= end_x <= plate.length - edge and edge <= end_y <= plate.width - edge
            return min(math.dist(a, o) for a in along(way) for o in others) if is_on else -1.0

        yield from along(max(((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)), key=room))


def _measured(
    log: Log,
    first: _Steady,
    events: list[_Event],
    timing: Timing,
    case: Case,
    applied: Sequence[PlayReport],
) -> Outcome:
    """What was felt in a session, beside what was promised."""
    until, last = events[-1].after.until if events else first.until, case.contents - 1
    heard = {id: Heard.by(id, log, until) for id in range(case.contents + case.quiet)}

    def felt(steady: _Steady, id: int) -> float | None:
        if len(steady.served) > 1:
            return heard[id].contrast_db(steady.span)
        others = [each.key.id for each in steady.applied.contacts if each.key.id != id]
        leaks = [heard[each].foreign_db_sl(steady.span) for each in others]
        if not leaks:
            return None
        return float((heard[id].own_db_sl(steady.span) - np.max(leaks, axis=0)).min())

    def pairs(steady: _Steady) -> list[tuple[float, float]]:
        both = [
            (steady.promised[id].promised_contrast_db, felt(steady, id)) for id in steady.served
        ]
        return [(a, b) for a, b in both if a is not None and b is not None]

    start = pairs(first)
    promises = [each.promised_contrast_db for each in first.promised.values()]
    found = Outcome(
        (min(each for each in promises if each is not None), min((b for _, b in start), default=0)),
        len(first.served) / (last + 1),
        start,
    )
    ends = [*[each.time for each in applied[2:]], until]
    for then, now, end in zip(applied, applied[1:], ends, strict=False):
        span = now.time, min(now.time + FALL_AFTER + CROSSFADE, end)
        if now.settled_after == CROSSFADE and span[1] - span[0] >= FIRST:
            found.events[STEPS] += _beside_step(then, now, heard, span)
        rings = now.time + FIRST, now.time + RUNG
        if _promises(now).keys() - _promises(then).keys() and rings[1] <= until:
            soon = [_promises(each) for each in applied if now.time <= each.time < rings[1]]
            found.events[LANDED] += _above(soon[0].keys(), soon, heard, rings)
    for event in events:
        found.fingers += pairs(event.after)
        if event.name == MOVES:
            mover = heard[last]
            resting = [mover.contrast_db(each.span) for each in (event.before, event.after)]
            found.events[MOVES].append(mover.contrast_db(*event.path) - float(np.mean(resting)))
            for each in event.answers:
                promised = _promises(each)[last]
                if promised.promised_contrast_db is not None:
                    until = each.time + NEXT
                    spans = [one for one in event.path if each.time <= one[0] < one[1] <= until]
                    above = mover.contrast_db(*spans) - promised.promised_contrast_db
                    found.events[ANSWERS].append(above)
        else:
            _note(event, found, heard, timing, case)
    return found


def _beside_step(
    then: PlayReport, now: PlayReport, heard: Mapping[int, Heard], span: Span
) -> list[float]:
    """Foreign level of a cross-fade where others feel the same, each above what is promised before
    and after, and what was felt just before."""
    promises = _promises(then), _promises(now)
    kept = [each.content for each in then.contents.values()]
    led = {one.content.key[0].id for one in now.contents.values() if one.content not in kept}
    beside = [id for id in promises[1] if id not in led]
    before = [heard[id].foreign_db_sl((span[0] - STRONGEST, span[0])).max() for id in beside]
    above = zip(beside, _above(beside, promises, heard, span), before, strict=True)
    return [over - max(0.0, float(rings) - _most(id, *promises)) for id, over, rings in above]


def _above(
    ids: Iterable[int],
    promises: Sequence[Mapping[int, Prediction]],
    heard: Mapping[int, Heard],
    span: Span,
) -> list[float]:
    """Foreign level of the strongest 40 ms at fingers, above the most of what is promised."""
    return [
        float(heard[id].foreign_db_sl(span, strongest=True).max()) - _most(id, *promises)
        for id in ids
    ]


def _promises(report: PlayReport) -> dict[int, Prediction]:
    return {each.contact.key.id: each for each in report.targets}


def _most(id: int, *promises: Mapping[int, Prediction]) -> float:
    """The foreign level at a finger by the one of several promises that says most."""
    levels = [each[id].foreign_level_db_sl for each in promises]
    return max([each for each in levels if each is not None], default=-math.inf)


def _note(
    event: _Event, found: Outcome, heard: Mapping[int, Heard], timing: Timing, case: Case
) -> None:
    """Note the first 100 ms of an event at every finger, beside what was promised."""
    span, last = (event.time, event.time + FIRST), case.contents - 1
    after, before = event.after.promised, event.before.promised
    onset = -math.inf
    contents, promised_level = (
        (event.before.applied, before[last].level_db_sl)
        if event.name == LEAVES
        else (event.first, after[last].level_db_sl)
    )
    for one in contents.contents.values():
        if owner_of(one) == last:
            contrast = timing.transient_contrast_db(one.layer, one.content.placement)
            if contrast is not None and promised_level is not None:
                level = promised_level - contrast
                onset = float(case.table.levels_by_set(level, one.layer.excitation).max())
    for id in event.after.served:
        foreign = float(heard[id].foreign_db_sl(span, strongest=True).max())
        promised = after[id].promised_contrast_db
        contrast = heard[id].contrast_db(span, strongest=True)
        if event.name == JOINS and promised is not None:
            kind = "first 100 ms, joining" if id == last else "first 100 ms, beside"
            found.events[kind].append(contrast - promised)
            if id == last:
                found.events[UNTIL].append(heard[id].short_until(promised - 3, event.time))
        if id != last and id in event.before.served:
            levels = [onset, _most(id, before, after)]
            found.events[f"{event.name}, above promise"].append(foreign - levels[1])
            expected = 10 * math.log10(sum(10 ** (each / 10) for each in levels) + 1e-12)
            found.events[event.name].append(foreign - expected)
