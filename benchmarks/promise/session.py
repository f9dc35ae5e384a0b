"""One session of a case on a plate of its own: promised and felt contrast of its fingers.

Control loop, serial lines and amplifiers run in virtual time, and the plate vibrates in time under
the fingers. A click has its own content at its finger. All levels are averages over 40 ms: over the
duration of a click, and over the strongest part of other contents while it plays and rings.
"""

import asyncio
import math
import operator
from collections import defaultdict
from collections.abc import Mapping, Sequence
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
    Band,
    Case,
    Point,
)
from benchmarks.promise.hearing import Heard, Log, Span, owner_of
from benchmarks.setting import random_contacts
from controller.effects.player import CLICK_ABOVE_DB
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.reports import PlayReport
from controller.play.selected_contents import FingerSensation
from controller.sources.touch import ContactKey
from kit.chain import Chain
from kit.clock import run_virtual
from model.answer.answer_report import Timing
from model.finger import FINGERTIP_RADIUS
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.imperfections import draw_imperfections
from sim.transport.simulated_line import PROMPT

CLICK_DURATION, CLICK_RINGING, CLICK_PAUSE = 0.040, 0.060, 0.6  # s
CLICK_LEVEL_DB_SL = 20.0
SETTLING, STEADY, FIRST, NEXT = 2.0, 0.25, 0.100, 0.080  # s
SPEED, WAY = 0.2, 0.1  # m/s, m; of the finger that moves
STEP, REPORTED = 0.0025, 4
"""Steps [s] of a finger that moves or lifts: longer ones would tap on the plate. The panel reports
every fourth step."""
LIFTING = np.arange(0.875, 0, -0.125)  # load of the finger until the panel reports that it is off
DIRECTIONS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))

ANSWERS = "answers while moving, above their promise"
JOINING = "joining: first 100 ms"
BESIDE = "joining: first 100 ms, other fingers"
UNTIL = "joining: 3 dB short until [ms]"

Promised = Mapping[int, FingerSensation]
Pair = tuple[float, float]
"""Promised and felt contrast [dB], or level [dB SL]."""


@dataclass
class Outcome:
    """Result of a session [dB].

    worst: promise and contrast of the worst finger while all contents play; fingers: both for each
    served finger, also after every event; served: share of the contents. events: figures by name;
    clicks: promised and felt contrast of clicks; others: minus the foreign levels at other fingers.
    """

    worst: Pair = (0.0, 0.0)
    served: float = 0.0
    fingers: list[Pair] = field(default_factory=list)
    events: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    clicks: list[Pair] = field(default_factory=list)
    others: list[Pair] = field(default_factory=list)


@dataclass(frozen=True)
class _Steady:
    """The report of a steady vibration, and the time [s] until which it is measured."""

    report: PlayReport
    until: float

    @property
    def span(self) -> Span:
        return self.until - STEADY, self.until

    @property
    def promised(self) -> Promised:
        return _promises(self.report)

    @property
    def served(self) -> list[int]:
        """Fingers that feel a content."""
        promised = self.promised.items()
        return [id for id, target in promised if target.sensation.verdict in ("own", "mixed")]


@dataclass(frozen=True)
class _Event:
    """An action of the last finger with a content; time [s]: of the commit of its answer.

    path: spans of the steps of a moving finger; answers: reports while it moves.
    """

    name: str
    time: float
    start: _Steady
    first: PlayReport
    end: _Steady
    path: tuple[Span, ...]
    answers: tuple[PlayReport, ...]


class _Wanted:
    """Contents by finger, and the last click."""

    def __init__(self) -> None:
        self.targets: dict[int, dict[str, Any]] = {}
        self.click: Target | None = None

    def intent(self, contacts: Any, now: float) -> HapticIntent:
        """Return the intent for contacts."""
        targets = []
        for contact in contacts:
            if contact.key.id in self.targets:
                stimulus = self.targets[contact.key.id]
                content = str(contact.key)
                targets.append(Target(contact.key, LEVEL_DB_SL, content=content, **stimulus))
        pulse = None if self.click is None else self.click.pulse
        if self.click is None or pulse is None or now >= pulse.end:
            return HapticIntent(tuple(targets))
        return HapticIntent((*targets, self.click), until=pulse.end)

    def has_effect_at(self, contact: Any) -> bool:
        """Whether a contact that comes down here has a target."""
        return contact.key.id in self.targets


@cache
def _timing(number: int) -> Timing:
    return Timing(CASES[number].table)


def outcome(number: int, seed: int) -> Outcome:
    """Run the case with a number on the plate of a seed."""
    return on_plate(CASES[number], _timing(number), seed)


def on_plate(case: Case, timing: Timing, seed: int) -> Outcome:
    """Run a case on the plate of a seed."""
    return run_virtual(_Session(case, timing, seed).run())  # type: ignore[no-any-return]


class _Session:
    def __init__(self, case: Case, timing: Timing, seed: int) -> None:
        self._case = case
        self._timing = timing
        self._rig = case.rig
        self._rng = np.random.default_rng([seed, 14])
        self._positions = self._draw(case.contents + case.quiet)
        while not self._are_on_plate(self._positions):
            self._positions = self._draw(case.contents + case.quiet)
        self._landing: Point | None = None
        if JOINS in case.events:
            # Elsewhere: where the finger left, others may still be quiet.
            (self._landing,) = self._draw(1, apart_from=self._positions)
        self._drawn = draw_imperfections(self._rig, seed=1000 + seed)
        self._wanted = _Wanted()
        self._last = case.contents - 1

    def _draw(self, count: int, *, apart_from: Sequence[Point] = ()) -> list[Point]:
        """Draw positions of fingers."""
        size = (self._rig.plate.length, self._rig.plate.width)
        margin = FINGERTIP_RADIUS + 0.001
        drawn = random_contacts(self._rng, count, size, margin=margin, beside=apart_from)
        return [(float(x), float(y)) for x, y in drawn]

    def _draw_touches(self) -> dict[int, Point]:
        """Draw the displacement [m] of each finger from its reported position."""
        rng = np.random.default_rng([self._drawn.seed, 15])
        offset = self._rig.uncertainty.touch_offset
        touches = offset * rng.standard_normal((len(self._positions), 2))
        return {id: (dx, dy) for id, (dx, dy) in enumerate(touches.tolist())}

    def _are_on_plate(self, positions: Sequence[Point]) -> bool:
        """Whether all fingertips are on the plate, which may have a cut-out."""
        around = FINGERTIP_RADIUS * np.array(DIRECTIONS)
        points = (np.array(positions)[:, None] + around).reshape(-1, 2)
        return bool(self._rig.plate.covers(points).all())

    @property
    def _wires(self) -> SimulatedWire | dict[str, SimulatedWire]:
        """One line for all amplifiers, or a line for each."""
        kind = self._case.line or PROMPT
        seed = self._drawn.seed
        line = SimulatedWire("serial", speed=921_600, shared=True, line_kind=kind, seed=seed)
        if self._case.is_one_bus:
            return line
        return {name: replace(line, shared=False, line=name) for name in self._rig.amplifiers}

    async def run(self) -> Outcome:
        """Put all fingers on the plate; then run each event, or the clicks."""
        case = self._case
        chain: Any
        async with Chain.armed(
            self._wires,
            self._rig,
            case.table,
            intent_source=self._wanted,
            timing=self._timing,
            imperfections=self._drawn,
        ) as chain:
            chain.must_be_felt = False
            chain.off = self._draw_touches()
            log = Log(self._rig, self._drawn, threads.now())
            log.watch(chain.far.bench)
            self._want_contents()
            await asyncio.sleep(HELD if len(self._rig.amplifiers) > 1 else 0)
            for id, position in enumerate(self._positions):
                chain.at[id] = position
                await chain.hold(0.0)
            if case.resting:
                await chain.hold(case.resting)
            if case.clicks:
                return await self._click_all(chain, log)
            first = await self._settled(chain)
            steady = first
            events = []
            for name in case.events:
                events.append(await self._event(chain, name, steady))
                steady = events[-1].end
            log.note_owners(chain.applied)
            chain.far.bench.advance(steady.until)
            return _measured(log, first, events, self._timing, case)

    def _want_contents(self) -> None:
        case = self._case
        for id, band in enumerate(case.bands_for(self._positions[: case.contents])):
            modulation_hz = case.modulation_hz if id == self._last else None
            self._wanted.targets[id] = {"band": band, "modulation_hz": modulation_hz}

    async def _settled(self, chain: Any) -> _Steady:
        await chain.hold(SETTLING)
        return _Steady(chain.applied[-1], threads.now())

    async def _click_all(self, chain: Any, log: Log) -> Outcome:
        """Let fingers click, one after the other; only played clicks count."""
        await chain.hold(SETTLING)
        reports: list[tuple[int, PlayReport]] = []
        for id in self._case.clicks:
            count = len(chain.applied)
            pulse = Pulse(CLICK_DURATION, threads.now())
            self._wanted.click = Target(
                ContactKey("panel", id),
                CLICK_LEVEL_DB_SL,
                pulse,
                content="click",
                above_db=CLICK_ABOVE_DB,
            )
            chain.controller.cycle.request_update()
            await asyncio.sleep(0)
            await chain.hold(CLICK_PAUSE)
            with_click = [report for report in chain.applied[count:] if _has_click(report, id)]
            reports += [(id, report) for report in with_click[:1]]
        log.note_owners(chain.applied)
        chain.far.bench.advance(threads.now())
        return _measured_clicks(log, reports, len(self._positions), threads.now())

    async def _event(self, chain: Any, name: str, start: _Steady) -> _Event:
        count = len(chain.applied)
        begin = threads.now()
        times = [begin]
        if name == LEAVES:
            for load in LIFTING:
                self._place(chain, {str(self._last): float(load)})
                await asyncio.sleep(STEP)
            begin = threads.now()
            del chain.at[self._last]
        elif name == JOINS:
            chain.at[self._last] = self._landing
        elif name == CHANGES:
            self._wanted.targets[self._last]["band"] = self._other_band(start)
        else:
            for number, position in enumerate(self._way(chain.at)):
                chain.at[self._last] = position
                if number % REPORTED == 0:
                    chain.report()
                else:
                    self._place(chain, {})
                await asyncio.sleep(STEP)
                times.append(threads.now())
        end = await self._settled(chain)
        reports = chain.applied[count:]
        first = reports[0] if reports else chain.applied[-1]
        answers = [each for each in reports if times[0] < each.time < times[-1] - NEXT]
        path = tuple(pairwise(times))
        return _Event(name, max(first.time, begin), start, first, end, path, tuple(answers))

    def _place(self, chain: Any, loads: Mapping[str, float]) -> None:
        """Place the fingers on the plate without a report of the panel."""
        chain.far.bench.place_fingers(chain.touched_at(), now=threads.now(), loads=loads)

    def _other_band(self, steady: _Steady) -> Band:
        """Return a band without the frequency of the content that changes."""
        frequencies = self._case.table.frequencies
        low, high = float(frequencies[0]), float(frequencies[-1])
        frequency = steady.promised[self._last].frequency or low
        if frequency < math.sqrt(low * high):
            return frequency + 30, high
        return low, frequency - 30

    def _way(self, at: Mapping[int, Point]) -> list[Point]:
        """Return the path farthest from other fingers and edges."""
        x, y = at[self._last]
        others = [position for id, position in at.items() if id != self._last]
        lengths = np.arange(1, round(WAY / SPEED / STEP) + 1) * SPEED * STEP
        ways = []
        for dx, dy in DIRECTIONS:
            ways.append([(x + float(s) * dx, y + float(s) * dy) for s in lengths])
        return max(ways, key=lambda way: self._room(way, others))

    def _room(self, way: Sequence[Point], others: Sequence[Point]) -> float:
        """Return the least distance [m] of a path from other fingers, -1 if it leaves the plate."""
        plate, edge = self._rig.plate, FINGERTIP_RADIUS + 0.001
        x, y = way[-1]
        if not (edge <= x <= plate.length - edge and edge <= y <= plate.width - edge):
            return -1.0
        return min(math.dist(position, other) for position in way for other in others)


def _measured(
    log: Log, first: _Steady, events: Sequence[_Event], timing: Timing, case: Case
) -> Outcome:
    """Compare felt and promised contrast in a session."""
    until = events[-1].end.until if events else first.until
    heard = {id: Heard.by(id, log, until) for id in range(case.contents + case.quiet)}
    pairs = _pairs(first, heard)
    promises = [each.sensation.promised_contrast_db for each in first.promised.values()]
    worst_promise = min(each for each in promises if each is not None)
    worst_felt = min((felt for _, felt in pairs), default=0.0)
    result = Outcome((worst_promise, worst_felt), len(first.served) / case.contents, list(pairs))
    for event in events:
        result.fingers += _pairs(event.end, heard)
        if event.name == MOVES:
            _note_move(result, event, heard[case.contents - 1])
        else:
            _note_change(result, event, heard, timing, case)
    return result


def _pairs(steady: _Steady, heard: Mapping[int, Heard]) -> list[Pair]:
    """Return promised and felt contrast of each served finger."""
    pairs = []
    for id in steady.served:
        promised = steady.promised[id].sensation.promised_contrast_db
        felt = _felt_contrast(steady, id, heard)
        if promised is not None and felt is not None:
            pairs.append((promised, felt))
    return pairs


def _felt_contrast(steady: _Steady, id: int, heard: Mapping[int, Heard]) -> float | None:
    """Contrast to foreign contents; of an only content to the leak at the loudest other finger."""
    if len(steady.served) > 1:
        return heard[id].contrast_db(steady.span)
    others = [each.key.id for each in steady.report.contacts if each.key.id != id]
    if not others:
        return None
    leaks = [heard[other].foreign_db_sl(steady.span) for other in others]
    return float((heard[id].own_db_sl(steady.span) - np.max(leaks, axis=0)).min())


def _note_move(result: Outcome, event: _Event, mover: Heard) -> None:
    """Note the contrast at a moving finger, compared with rest and with each answer's promise."""
    at_rest = [mover.contrast_db(steady.span) for steady in (event.start, event.end)]
    result.events[MOVES].append(mover.contrast_db(*event.path) - float(np.mean(at_rest)))
    for report in event.answers:
        promised = _promises(report)[mover.finger].sensation.promised_contrast_db
        if promised is not None:
            until = report.time + NEXT
            spans = [each for each in event.path if report.time <= each[0] < each[1] <= until]
            result.events[ANSWERS].append(mover.contrast_db(*spans) - promised)


def _note_change(
    result: Outcome, event: _Event, heard: Mapping[int, Heard], timing: Timing, case: Case
) -> None:
    """Note the first 100 ms of an event at every finger, compared with the promise."""
    span = (event.time, event.time + FIRST)
    last = case.contents - 1
    start, end = event.start.promised, event.end.promised
    onset = _onset_level(event, timing, case)
    for id in event.end.served:
        promised = end[id].sensation.promised_contrast_db
        if event.name == JOINS and promised is not None:
            short = heard[id].contrast_db(span, strongest=True) - promised
            result.events[JOINING if id == last else BESIDE].append(short)
            if id == last:
                until = heard[id].short_until(promised - 3, event.time)
                result.events[UNTIL].append(until)
        if id != last and id in event.start.served:
            foreign = float(heard[id].foreign_db_sl(span, strongest=True).max())
            levels = [onset, _foreign_level(id, start), _foreign_level(id, end)]
            promised_power = 10 ** (levels[0] / 10) + 10 ** (max(levels[1:]) / 10)
            expected = 10 * math.log10(promised_power + 1e-12)
            result.events[event.name].append(foreign - expected)


def _onset_level(event: _Event, timing: Timing, case: Case) -> float:
    """Level [dB SL] that the onset or ending of the last content leaks, on the nominal plate."""
    last = case.contents - 1
    steady, report = event.end, event.first
    if event.name == LEAVES:
        steady, report = event.start, event.start.report
    level = steady.promised[last].level_db_sl
    onset = -math.inf
    for layer in report.contents.values():
        if owner_of(layer) == last:
            contrast = timing.transient_contrast_db(layer.layer, layer.content.placement)
            if contrast is not None and level is not None:
                levels = case.table.levels_by_set(level - contrast, layer.layer.excitation)
                onset = float(levels.max())
    return onset


def _measured_clicks(
    log: Log, reports: Sequence[tuple[int, PlayReport]], fingers: int, until: float
) -> Outcome:
    """Compare clicks up to a time [s] with their promises."""
    result = Outcome()
    heard = {id: Heard.by(id, log, until) for id in range(fingers)} if reports else {}
    for id, report in reports:
        click = log.replayed(partial(operator.eq, ~id), until)
        during = (report.time, report.time + CLICK_DURATION)
        after = (report.time, report.time + CLICK_DURATION + CLICK_RINGING)
        loudest = heard[id].foreign_db_sl(during)
        for other in range(fingers):
            if other != id:
                leak = Heard(other, click, click).foreign_db_sl(after, strongest=True)
                loudest = np.maximum(loudest, leak)
                foreign = float(heard[other].foreign_db_sl(after, strongest=True).max())
                level = _promised_level(report, other)
                if level is not None:
                    result.others.append((-level, -foreign))
        promised = _promises(report)[id].sensation.promised_contrast_db
        if promised is not None:
            own = Heard(id, click, click).own_db_sl(during)
            result.clicks.append((promised, float((own - loudest).min())))
    return result


def _promised_level(report: PlayReport, id: int) -> float | None:
    """Level of foreign contents [dB SL] that a report promises to a finger."""
    target = _promises(report).get(id)
    if target is not None:
        return target.sensation.foreign_level_db_sl
    (levels,) = [levels for key, levels in report.quiet_levels.items() if key.id == id]
    return max(levels)


def _has_click(report: PlayReport, id: int) -> bool:
    return any(owner_of(layer) == ~id for layer in report.contents.values())


def _promises(report: PlayReport) -> dict[int, FingerSensation]:
    return {target.contact.key.id: target for target in report.targets}


def _foreign_level(id: int, promised: Promised) -> float:
    """Level of foreign contents [dB SL] promised to a finger."""
    level = promised[id].sensation.foreign_level_db_sl
    return -math.inf if level is None else level
