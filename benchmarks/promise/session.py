"""One session of a case on a plate of its own: what its fingers were promised, and what they felt.

Control loop, serial lines and amplifiers run in virtual time, the plate in time under the fingers;
a witness reads every byte. What fingers feel is noted over time, and parted by contents: all that
moved the bases is played once more on the same plate under the same fingers, only the voices of a
finger's own layers, or only those of all others. Voices are divided by the threshold at their
frequency, by each set of thresholds by which the rig's promises hold, so that accelerations are
levels of sensation.

A click has a content of its own at its finger, whether that feels what lasts besides or not. All
levels are of 40 ms: the click's of its duration, others' the strongest while it plays and rings.
"""

import asyncio
import math
import operator
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from benchmarks.setting import random_contacts
from controller.effects.player import CLICK_ABOVE_DB
from controller.play.intent import CLICK, FingerSensation, HapticIntent, Pulse, Target
from controller.play.loop import PlayReport
from controller.play.slots import CROSSFADE, FALL_AFTER
from controller.sources.touch import ContactKey
from drivers.playing import Voice
from kit.chain import Chain
from kit.clock import run_virtual
from model.answer.answer_report import Timing
from model.arrays import FloatArray
from model.finger import FINGERTIP_RADIUS, detection_threshold
from model.rig.rig import Rig
from registry import threads
from sim.amplifier.readings import StraightClock
from sim.bench.bench import Bench
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant import imperfections
from sim.plant.imperfections import Imperfections, draw_imperfections, motion_of, realised
from sim.plant.plant import FingerPlacement
from sim.transport.simulated_line import PROMPT

STRONGEST = 0.040  # s

Span = tuple[float, float]


class _Part(Bench):
    """A bench whose ERAs play only some voices; owners: fingers by layer.

    threshold: name of the set by which voices are divided.
    """

    def __init__(
        self,
        rig: Rig,
        drawn: Imperfections,
        now: float,
        is_heard: Callable[[int | None], bool],
        threshold: str,
    ) -> None:
        super().__init__(rig, now=now, imperfections=drawn)
        self.is_heard, self.threshold = is_heard, threshold
        self.owners: Mapping[int, int] = {}

    def _motion(self, index: int, playing: Sequence[Voice], clock: StraightClock) -> Any:
        errors, terms = self._errors[index], []
        for voice in (*playing, *imperfections.of_voices(playing, errors.harmonic)):
            if self.is_heard(self.owners.get(voice.layer)):
                at = np.array([voice.frequency])
                threshold = float(detection_threshold(at, self.threshold)[0])
                motion = motion_of(
                    [voice],
                    clock,
                    stroke=self.rig.eras[index].full_level,
                    delay=self._delays[index],
                )
                terms += realised(motion, replace(errors, gain=errors.gain / threshold))
        return tuple(terms)


@dataclass
class Log:
    """What happened on a bench, by time [s]: fingers, voices, and whose layers are whose."""

    rig: Rig
    drawn: Imperfections
    start: float
    steps: list[tuple[float, Callable[[_Part], None]]] = field(default_factory=list)

    def watch(self, bench: Any) -> None:
        """Note the voices of a bench from now on, and its fingers, with the plate under them."""
        apply, place = bench._apply, bench._place

        def applied(index: int, playing: tuple[Voice, ...], clock: StraightClock) -> None:
            self.steps.append((bench.time, lambda part: part._apply(index, playing, clock)))
            apply(index, playing, clock)

        def placed(placement: FingerPlacement) -> None:
            self.steps.append((placement.time, lambda part: part._place(placement)))
            place(placement)

        bench._apply, bench._place = applied, placed

    def own(self, owners: Mapping[int, int], time: float) -> None:
        """Note whose content each layer has from a time [s] on."""
        self.steps.append((time, lambda part: setattr(part, "owners", {**part.owners, **owners})))

    def replayed(self, is_heard: Callable[[int | None], bool], until: float) -> list[Bench]:
        """Benches on which some voices have been played up to a time [s], by set of thresholds."""
        found: list[Bench] = []
        for name in dict.fromkeys((self.rig.threshold, *self.rig.promised_thresholds)):
            part = _Part(self.rig, self.drawn, self.start, is_heard, name)
            for time, change in sorted(self.steps, key=lambda each: each[0]):
                part.advance(time)
                change(part)
            part.advance(until)
            found.append(part)
        return found


@dataclass(frozen=True)
class Heard:
    """What a finger felt in a session, of its own and of others', by set of thresholds."""

    finger: int
    own: list[Bench]
    foreign: list[Bench]

    @classmethod
    def by(cls, finger: int, log: Log, until: float) -> "Heard":
        """By a finger up to a time [s]; its clicks, of the complement, are neither."""
        own = log.replayed(lambda owner: owner == finger, until)
        return cls(finger, own, log.replayed(lambda o: o not in (finger, ~finger), until))

    def own_db_sl(self, *spans: Span, strongest: bool = False) -> FloatArray:
        """Levels of its own content, mean over the fingertip, in spans of time [s] together."""
        return np.array([self._level(each, spans, strongest, is_mean=True) for each in self.own])

    def foreign_db_sl(self, *spans: Span, strongest: bool = False) -> FloatArray:
        """Levels of all others' at the loudest point; strongest: of 40 ms."""
        levels = [self._level(each, spans, strongest, is_mean=False) for each in self.foreign]
        return np.array(levels)

    def contrast_db(self, *spans: Span, strongest: bool = False) -> float:
        """Own above foreign level in spans of time [s], the least over the sets."""
        own, foreign = (
            each(*spans, strongest=strongest) for each in (self.own_db_sl, self.foreign_db_sl)
        )
        return float((own - foreign).min())

    def short_until(self, least_db: float, time: float) -> float:
        """How long [ms] after a time [s] it first feels a contrast over 40 ms; a second at most.

        In steps of 5 ms.
        """
        for after in range(0, 1000, 5):
            start = time + after / 1000
            if self.contrast_db((start, start + STRONGEST)) >= least_db:
                return float(after)
        return 1000.0

    def _level(self, bench: Bench, spans: Sequence[Span], strongest: bool, is_mean: bool) -> float:
        records = [bench.fingers.felt(*span)[str(self.finger)] for span in spans]
        squares = np.cumsum(np.concatenate([each.accelerations for each in records]) ** 2, axis=0)
        count = round(STRONGEST * bench.sample_rate) if strongest else len(squares) - 1
        powers: FloatArray = 2 * (squares[count:] - squares[:-count]) / count
        if not is_mean:
            return float(10 * np.log10(powers.max() + 1e-12))
        return float(20 * np.log10((np.sqrt(powers) @ records[0].weights).max() + 1e-6))


DURATION, CLICK_LEVEL_DB_SL, RINGING, PAUSE = 0.040, 20.0, 0.060, 0.6  # s, dB SL


@dataclass
class Clicked:
    """Of the clicks of a session, each promised and felt [dB].

    contrasts: of the click, above its own at other fingers and above others' at its own; foreign:
    levels at the others meanwhile, negative, so that more is better; restated: contrasts of their
    own contents meanwhile; over_own: level of the click above what lasts at its finger, felt alone.
    """

    contrasts: list[tuple[float, float]] = field(default_factory=list)
    foreign: list[tuple[float, float]] = field(default_factory=list)
    restated: list[tuple[float, float]] = field(default_factory=list)
    over_own: list[float] = field(default_factory=list)


def owner_of(one: Any) -> int:
    """The finger that a layer plays for, its complement for a click."""
    id = int(one.content.targets[0][0].key.id)
    return ~id if one.content.key[1] == CLICK else id


def click_at(key: ContactKey, now: float) -> Target:
    """The target of a click from a time [s] on."""
    pulse = Pulse(DURATION, now)
    return Target(key, CLICK_LEVEL_DB_SL, pulse, content="click", above_db=CLICK_ABOVE_DB)


async def clicks(on: Any, wanted: Any, fingers: Sequence[int]) -> list[tuple[int, PlayReport]]:
    """Let fingers click, one after the other; returns the report of each click that was played."""
    found = list[tuple[int, PlayReport]]()
    for id in fingers:
        count = len(on.applied)
        wanted.click = click_at(ContactKey("panel", id), threads.now())
        on.controller.cycle.request_update()
        await asyncio.sleep(0)
        await on.hold(PAUSE)
        reports = [each for each in on.applied[count:] if _layers_of(each, ~id)]
        found += [(id, each) for each in reports[:1]]
    return found


def measured(
    log: Log, reports: Sequence[tuple[int, PlayReport]], fingers: int, until: float
) -> Clicked:
    """What was felt of clicks up to a time [s] by so many fingers, beside what was promised."""
    found = Clicked()
    every = {id: Heard.by(id, log, until) for id in range(fingers)} if reports else {}
    alone = {id: log.replayed(partial(operator.eq, ~id), until) for id, _ in reports}
    for id, report in reports:
        promised = {each.contact.key.id: each for each in report.targets}
        during, after = _spans(report.time)
        others, click = [other for other in range(fingers) if other != id], alone[id]
        own = Heard(id, click, click).own_db_sl(during)
        leaks = [
            Heard(other, click, click).foreign_db_sl(after, strongest=True) for other in others
        ]
        foreign = every[id].foreign_db_sl(during)
        contrast = promised[id].sensation.promised_contrast_db
        if contrast is not None:
            loudest = np.max([*leaks, foreign], axis=0)
            found.contrasts.append((contrast, float((own - loudest).min())))
        if _layers_of(report, id):
            found.over_own.append(float((own - every[id].own_db_sl(during))[0]))
        for other in others:
            _note(found, other, report, promised.get(other), every[other])
    return found


def _note(
    found: Clicked,
    id: int,
    report: PlayReport,
    promised: FingerSensation | None,
    heard: Heard,
) -> None:
    """Note what another finger felt of a click."""
    during, after = _spans(report.time)
    foreign = heard.foreign_db_sl(after, strongest=True)
    if promised is None:
        (levels,) = [each for key, each in report.quiet_levels.items() if key.id == id]
        found.foreign.append((-max(levels), -float(foreign.max())))
        return
    if promised.sensation.foreign_level_db_sl is not None:
        found.foreign.append((-promised.sensation.foreign_level_db_sl, -float(foreign.max())))
    if promised.sensation.promised_contrast_db is not None:
        contrast = float((heard.own_db_sl(during) - foreign).min())
        found.restated.append((promised.sensation.promised_contrast_db, contrast))


def _spans(since: float) -> tuple[Span, Span]:
    return (since, since + DURATION), (since, since + DURATION + RINGING)


def _layers_of(report: PlayReport, owner: int) -> list[int]:
    return [n for n, one in report.contents.items() if owner_of(one) == owner]


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
    def promised(self) -> Mapping[int, FingerSensation]:
        return _promises(self.applied)

    @property
    def served(self) -> list[int]:
        return [
            id for id, each in self.promised.items() if each.sensation.verdict in ("own", "mixed")
        ]


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
    return on_plate(CASES[number], _timing(number), seed)


def on_plate(case: Case, timing: Timing, seed: int) -> Outcome:
    """Run a case on the plate of a seed."""
    return run_virtual(_Session(case, timing, seed).run())  # type: ignore[no-any-return]


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
        places, tip = draw(count), FINGERTIP_RADIUS * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        while not plate.covers((places[:, None] + tip).reshape(-1, 2)).all():  # beside a cut-out
            places = draw(count)
        self._places: list[Point] = [(float(x), float(y)) for x, y in places]
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
        async with Chain.armed(
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
            (steady.promised[id].sensation.promised_contrast_db, felt(steady, id))
            for id in steady.served
        ]
        return [(a, b) for a, b in both if a is not None and b is not None]

    start = pairs(first)
    promises = [each.sensation.promised_contrast_db for each in first.promised.values()]
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
                if promised.sensation.promised_contrast_db is not None:
                    until = each.time + NEXT
                    spans = [one for one in event.path if each.time <= one[0] < one[1] <= until]
                    above = mover.contrast_db(*spans) - promised.sensation.promised_contrast_db
                    found.events[ANSWERS].append(above)
        else:
            _noted(event, found, heard, timing, case)
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
    promises: Sequence[Mapping[int, FingerSensation]],
    heard: Mapping[int, Heard],
    span: Span,
) -> list[float]:
    """Foreign level of the strongest 40 ms at fingers, above the most of what is promised."""
    return [
        float(heard[id].foreign_db_sl(span, strongest=True).max()) - _most(id, *promises)
        for id in ids
    ]


def _promises(report: PlayReport) -> dict[int, FingerSensation]:
    return {each.contact.key.id: each for each in report.targets}


def _most(id: int, *promises: Mapping[int, FingerSensation]) -> float:
    """The foreign level at a finger by the one of several promises that says most."""
    levels = [each[id].sensation.foreign_level_db_sl for each in promises]
    return max([each for each in levels if each is not None], default=-math.inf)


def _noted(
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
        promised = after[id].sensation.promised_contrast_db
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


Found = Mapping[Case, Sequence[Outcome]]


def as_markdown(found: Found) -> str:
    """A table of steady contrasts, with a row of all cases, and one of what happens in events."""
    clicked = {case: each for case, each in found.items() if case.clicks}
    found = {case: each for case, each in found.items() if not case.clicks}
    lines = _of_clicks(clicked) if clicked else []
    if not found:
        return "\n".join(lines)
    lines += [
        "| | plates | goal | promised [dB] (10 %) | felt [dB] (10 %) | served | promise kept |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, each in found.items():
        promised, felt = np.array([one.worst for one in each]).T
        lines.append(
            f"| {case.title} | {len(each)} | {'-' if case.goal_db is None else case.goal_db} | "
            f"{_shown(promised)} | {_shown(felt)} | "
            f"{100 * np.mean([one.served for one in each]):.0f} % | "
            f"{_shown_kept(each)} |"
        )
    every = [one for each in found.values() for one in each]
    lines.append(f"| all | {len(every)} | - | - | - | - | {_shown_kept(every)} |")
    names = list(dict.fromkeys(n for each in found.values() for one in each for n in one.events))
    lines += ["", f"| | {' | '.join(names)} |", "|---|" + "---|" * len(names)]
    for case, each in found.items():
        columns = [[value for one in each for value in one.events.get(name, [])] for name in names]
        if any(columns):
            cells = [
                _shown(values, worst=_WORST.get(name, 90)) + _share(name, values)
                for name, values in zip(names, columns, strict=True)
            ]
            lines.append(f"| {case.title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _of_clicks(found: Found) -> list[str]:
    """A table of clicks, with what the others are said to feel meanwhile."""
    lines = [
        "| | plates | promised [dB] (10 %) | felt [dB] (10 %) | kept | others' foreign kept | "
        "others' contrast meanwhile [dB] (10 %) | kept | above own [dB] (10 %) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for case, each in found.items():
        clicked = [one.clicked for one in each if one.clicked is not None]
        contrasts, foreign, restated = (
            [pair for one in clicked for pair in getattr(one, name)]
            for name in ("contrasts", "foreign", "restated")
        )
        lines.append(
            f"| {case.title} | {len(each)} | {_shown([a for a, _ in contrasts])} | "
            f"{_shown([b for _, b in contrasts])} | {_kept(contrasts)} | {_kept(foreign)} | "
            f"{_shown([a for a, _ in restated])} | {_kept(restated)} | "
            f"{_shown([a for one in clicked for a in one.over_own])} |"
        )
    return [*lines, ""]


def _kept(pairs: Sequence[tuple[float, float]]) -> str:
    """Share of the promises that are kept, of pairs of promised and felt."""
    if not pairs:
        return "-"
    kept = np.mean([felt >= promised for promised, felt in pairs])
    return f"{100 * kept:.0f} % of {len(pairs)}"


_WORST = {ANSWERS: 10, "moves": 10, "first 100 ms, joining": 10, "first 100 ms, beside": 10}
"""Percentile that is the worst tenth, where that is not the 90th."""


def _share(name: str, values: Sequence[float]) -> str:
    """The share of answers that keep their promise."""
    if name != ANSWERS or not values:
        return ""
    return f", {100 * np.mean(np.array(values) >= 0):.0f} % of {len(values)} kept"


def kept(found: Sequence[Outcome]) -> float:
    """Share of the promises that are kept."""
    return float(np.mean([felt >= promised for one in found for promised, felt in one.fingers]))


def _shown_kept(found: Sequence[Outcome]) -> str:
    return _kept([pair for one in found for pair in one.fingers])


def _shown(values: Sequence[float] | np.ndarray, *, worst: float = 10) -> str:
    """Median, and the worst tenth in brackets."""
    if not len(values):
        return "-"
    return f"{np.median(values):.1f} ({np.percentile(values, worst):.1f})"
