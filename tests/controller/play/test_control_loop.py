"""The control loop in virtual time, with amplifiers that record their requests.

It opens, arms, stops, closes and loses several amplifiers; clicks play beside what lasts; as many
fingers as there may be are served; and an answer that comes too late is reported and never played.
"""

import asyncio
import cmath
import logging
import math
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from chain import FINGER, Chain, Sent, set_chain, set_running
from controller.effects.kinds import Click
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.operation.plate_controller import Controller
from controller.play.intent import (
    HapticIntent,
    Prediction,
    Pulse,
    Selection,
    Target,
    sums_db,
)
from controller.play.loop import ENDED, PlayReport
from controller.play.selection import Chooser, Selector
from controller.sources.touch import Contact, ContactKey, Touch, TouchFrame
from courses import Acted, Planted, courses, follow
from drivers.host.group import GroupState
from drivers.opening import Lines
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Envelope
from model.answer.answer import Layer
from model.answer.answer_report import Timing
from model.answer.stimulus import Placement
from model.errors import InputError
from model.rig.rig import Channel
from model.transients.base_motion import BaseEnvelope
from plates import small_problem, small_table
from registry import threads
from set_table import BuzzNewestContact, SetTiming
from several_fingers import (
    LAYOUT,
    LEFT,
    RIGHT,
    Fingers,
    fingers_on,
    playable,
    table,
)
from sim.far_ends.wire_assignment import SimulatedWire
from virtual_lines import in_virtual_time


class Shapes(SetTiming):
    """A timing whose envelopes are straight lines: up in 21 knots, down in 8.

    largest: of the knots of an onset, beside the full level.
    """

    def __init__(self, largest: float = 1.0) -> None:
        super().__init__()
        self.largest = largest

    def with_envelopes(
        self, pattern: Layer, placed: Placement, *, onset: bool, ending: bool
    ) -> Layer:
        """The lines, for the ERAs that play."""
        up = [number / 21 * self.largest for number in range(1, 21)] + [1.0]
        down = [1 - number / 8 for number in range(1, 9)]
        return replace(
            pattern,
            onset=_along(pattern, 0.0, up) if onset else pattern.onset,
            ending=_along(pattern, 1.0, down) if ending else pattern.ending,
        )


def _along(pattern: Layer, start: float, shares: Sequence[float]) -> dict[str, BaseEnvelope]:
    tones = {
        name: (tone.frequency, cmath.rect(tone.amplitude, tone.phase))
        for name, tone in pattern.excitation.items()
    }
    return {
        name: BaseEnvelope(frequency, start * full, tuple(share * full for share in shares))
        for name, (frequency, full) in tones.items()
    }


class Always:
    """An intent source for which every contact is a target, unless it fails."""

    fails = False

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return an intent with all contacts."""
        if self.fails:
            raise Planted("no intent")
        return HapticIntent(tuple(Target(each.key, 20.0) for each in contacts))


@dataclass
class Played(Acted):
    """A chain of which all sets are looked at: those since arming, and those that vibrate.

    timing, source: of its control loop; seen: times [s] at which a channel was audible, since the
    looks began, and levels; sessions: of the amplifiers, once they were noted.
    """

    timing: SetTiming = field(default_factory=SetTiming)
    source: Any = None
    seen: list[tuple[float, float]] = field(default_factory=list)
    sessions: set[int] = field(default_factory=set)
    marked_at: float = 0.0

    def marks(self) -> None:
        """Let times count from now on."""
        self.marked_at = threads.now()

    @property
    def sets(self) -> list[Sent]:
        """Every set since the silence that follows arming."""
        return self.far_end.sent()[1:]

    @property
    def vibrations(self) -> list[Sent]:
        """Those that vibrate."""
        return [each for each in self.sets if not each.is_silent]

    @property
    def level(self) -> float:
        """What the first channel plays."""
        return self.far_end.levels[0]

    @property
    def last_request(self) -> str:
        """Name of the last request."""
        return self.far_end.names()[-1]

    @property
    def knots_of_onsets(self) -> list[int]:
        """Of each set, for the first channel."""
        return [_knots(each.layer.commands[0].onset) for each in self.vibrations]

    @property
    def knots_of_endings(self) -> list[int]:
        """Of each set, for the first channel."""
        return [_knots(each.layer.commands[0].ending) for each in self.vibrations]

    @property
    def first_onset(self) -> dict[str, Any]:
        """Of the first channel, in the steps of the wire."""
        return _lines(self.vibrations[0].layer.commands[0].onset)

    @property
    def last_ending(self) -> dict[str, Any]:
        """Of the first channel, in the steps of the wire."""
        return _lines(self.vibrations[-1].layer.commands[0].ending)

    @property
    def levels_of_sets(self) -> list[list[int]]:
        """Of each channel in each set [1e-4]."""
        return [[each.level for each in one.layer.commands] for one in self.vibrations]

    @property
    def continues(self) -> list[bool]:
        """Whether each set continues the phase of the first channel."""
        return [each.layer.commands[0].keep_phase for each in self.vibrations]

    @property
    def sent_after(self) -> list[float]:
        """How long after the mark each set was committed [s]."""
        return [each.time - self.marked_at for each in self.vibrations]

    @property
    def reported_after(self) -> list[float]:
        """How long after the mark each report was made [s]."""
        return [each.time - self.marked_at for each in self.applied]

    @property
    def levels_seen(self) -> list[float]:
        """Levels since the looks began."""
        return [level for _, level in self.seen]

    @property
    def ramps(self) -> list[int]:
        """Of each set [ms]."""
        return [each.layer.ramp for each in self.vibrations]

    @property
    def reported_onsets(self) -> list[bool]:
        """Whether each report has an onset."""
        return [bool(each.layer.onset) for each in self.applied]

    @property
    def lasts_until(self) -> list[float]:
        """When each set ends by itself, after the mark [s]."""
        return [each.time + _valid_for(each) - self.marked_at for each in self.vibrations]

    @property
    def pauses(self) -> list[float]:
        """Times between sets that vibrate [s]."""
        return [later.time - each.time for each, later in pairwise(self.vibrations)]

    @property
    def has_gaps(self) -> bool:
        """Whether a set has ended by itself before the next."""
        found = self.vibrations
        return any(later.time > each.time + _valid_for(each) for each, later in pairwise(found))

    @property
    def valid_for(self) -> list[float]:
        """How long each set lasts without another [s]."""
        return [_valid_for(each) for each in self.vibrations]

    @property
    def is_renewal(self) -> list[bool]:
        """Whether each set renews what plays, without any command."""
        return [one.layer.renew and not one.layer.commands for one in self.vibrations]

    @property
    def played_for(self) -> float:
        """From the first set until the last ends by itself [s]."""
        return max(self.lasts_until) + self.marked_at - self.vibrations[0].time

    @property
    def said_after(self) -> float:
        """How long after that end it is reported [s]."""
        (ended,) = [each.time for each in self.silenced if each.reason == ENDED]
        return ended - self.marked_at - max(self.lasts_until)

    @property
    def loads_asked(self) -> list[list[float]]:
        """Loads of the fingers of each question."""
        return [[each.load for each in fingers] for fingers in self.table.asked]

    @property
    def feeling_asked(self) -> list[list[bool]]:
        """Of the fingers of each question, which shall feel something."""
        return [[each.stimulus is not None for each in fingers] for fingers in self.table.asked]

    @property
    def requests_of_sets(self) -> list[str]:
        """Sets, commits and silences since they were forgotten, the same of all amplifiers."""
        kinds = "Set", "Commit", "Silence"
        found = [[name for name in end.names() if name in kinds] for end in self.far_ends]
        assert all(each == found[0] for each in found), found
        return found[0]

    async def looks(self, seconds: float) -> None:
        """Look at the first channel every millisecond."""
        began = threads.now()
        for _ in range(round(1000 * seconds)):
            self.seen.append((threads.now() - began, self.level))
            await asyncio.sleep(0.001)

    @property
    def audible(self) -> list[float]:
        """When it was, since the looks began [s]."""
        return [time for time, level in self.seen if level > AUDIBLE]

    @property
    def audible_until(self) -> float:
        """When it was audible last."""
        return self.audible[-1]

    @property
    def audible_for(self) -> float:
        """From when it was first."""
        return self.audible[-1] - self.audible[0]

    @property
    def highest(self) -> float:
        """The highest level seen."""
        return max(level for _, level in self.seen)

    def source_fails(self, is_failing: bool) -> None:
        """Let what says who shall feel something fail, or work again."""
        self.source.fails = is_failing

    @property
    def pings_amid(self) -> int:
        """How many heartbeats came between a commit that was aborted and its silence."""
        return sum(
            end.times("Commit")[0] <= time <= end.times("Silence")[0]
            for end in self.far_ends
            for time in end.times("Ping")
        )

    def touch_for(self, timeout: float, *fingers: str) -> None:
        """Put fingers down by a source that says how long they stay without a frame."""
        self.timeout = timeout
        self.touch(*fingers)

    def presses(self, *loads: float) -> None:
        """Have a finger down, and beside it one of each load."""
        touches = Touch(1, 0.5, 0.5), *(Touch(2, 0.9, 0.9, load=load) for load in loads)
        self.deliver(TouchFrame("panel", threads.now(), touches))

    async def waits_for(self, kind: str) -> None:
        """Wait until one more request of a kind has come."""
        count = len(self.far_end.requests(kind))
        while len(self.far_end.requests(kind)) == count:  # noqa: ASYNC110
            await asyncio.sleep(0.0001)

    def shares_a_line(self, name: str, other: str) -> None:
        """Let an amplifier be on the line of another, with another address."""
        self.controller.urls[name] = f"{self.controller.urls[other]}&address=2"

    def observers_fail(self) -> None:
        """Let all that hear of contacts and reports fail."""
        loop = self.controller.cycle.observers
        for callbacks in (loop.contacts_changed, loop.reported):
            callbacks.insert(0, Mock(side_effect=RuntimeError("no disk space for this row")))

    def touches_as_arming_ends(self) -> None:
        """Let a finger come as the amplifiers have just been armed."""
        arm = self.controller.group.arm

        async def armed_late() -> None:
            await arm()
            self.touch("finger")

        self.controller.group.arm = armed_late

    @property
    def is_silence(self) -> list[bool]:
        """Whether each set is of silence, from arming on."""
        return [each.is_silent for each in self.far_end.sent()]

    def is_disarmed_by_another(self, of: int) -> None:
        """Let another program disarm an amplifier; the sessions so far are noted."""
        self.sessions = {each.amplifier.session for each in self.far_ends}
        self.far_ends[of].obey("Disarm", {"ramp": 0}, threads.now())

    @property
    def keeps_a_session(self) -> bool:
        """Whether an amplifier is in one of these."""
        return not self.sessions.isdisjoint({each.amplifier.session for each in self.far_ends})


def _knots(envelope: object) -> int:
    return len(envelope.knots) if isinstance(envelope, Envelope) else 0


def _lines(envelope: object) -> dict[str, Any]:
    assert isinstance(envelope, Envelope)
    levels, phases = zip(*envelope.knots, strict=True)
    return {"step": envelope.step, "phases": {*phases}, "levels": [*levels]}


def _valid_for(one: Sent) -> float:
    return QUANTITIES["valid_for"].from_wire(one.layer.valid_for)


@asynccontextmanager
async def played(
    *amplifiers: str,
    shapes: Mapping[str, float] | None = None,
    intents: str = "newest",
    **options: Any,
) -> AsyncIterator[Played]:
    """A chain, armed; shapes: of a timing with envelopes; intents: of `SOURCES`."""
    timing = SetTiming() if shapes is None else Shapes(**shapes)
    given = {"knots": 0 if shapes is None else 32, "timing": timing, **options}
    source = SOURCES[intents]()
    async with set_running(*amplifiers, of=Played, intent_source=source, **given) as chain:
        chain.timing, chain.source = timing, source
        yield chain


SOURCES: Mapping[str, Callable[[], Any]] = {
    "newest": BuzzNewestContact,
    "all": Always,
    "clicks": lambda: EffectPlayer(SurfaceLayout(effects={"click": Click()}, elsewhere="click")),
}
AUDIBLE = 1e-3  # of full level


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_control_loop_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], played)


@in_virtual_time
async def test_lift_as_a_set_is_confirmed_precedes_a_due_heartbeat() -> None:
    """It comes when the set is reported as playing, by replies as late as the heartbeat is due."""
    before: list[int] = []  # requests to each amplifier before the lift

    def lift(report: PlayReport) -> None:
        if report.contents:
            before.extend(len(end.asked) for end in chain.far_ends)
            chain.put()

    async with set_running("a", "b", observe=lambda loop: loop.reported.append(lift)) as chain:
        await asyncio.sleep(0.046)
        for end in chain.far_ends:
            end.delay(0.002)
        await chain.leave(0.05, FINGER)
        for end, count in zip(chain.far_ends, before, strict=True):
            assert end.names(count)[:2] == ["Silence", "Ping"]


PLAYED = SurfaceLayout(LAYOUT.regions, {**default_effects(), **LAYOUT.effects}, elsewhere=None)
"""Contents of 14 dB SL, and a click without a level of its own."""


async def clicked(fingers: Fingers, name: str = "click") -> tuple[PlayReport, PlayReport, int]:
    """Play a click at finger 1: what was reported before it, of it, and how often in all."""
    count, before = len(fingers.applied), fingers.applied[-1]
    fingers.play(name)
    await fingers.hold(0.3)
    return before, fingers.applied[count], len(fingers.applied) - count


def by_finger(report: PlayReport) -> dict[int, Prediction]:
    """What each finger is predicted to feel."""
    return {each.contact.key.id: each for each in report.targets}


@in_virtual_time
async def test_a_click_restates_what_its_neighbour_feels_and_only_meanwhile() -> None:
    """Foreign level: none of 40 ms is above it on this plate; contrast: by powers, by hand."""
    async with fingers_on(table(), PLAYED, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        before, during, count = await clicked(fingers)
        old, new, again = (by_finger(each)[2] for each in (before, during, fingers.applied[-1]))
        assert count == 2
        assert again == old
        figures = old.level_db_sl, old.promised_contrast_db, old.foreign_level_db_sl
        level, contrast, foreign = (10 ** ((each or 0.0) / 10) for each in figures)
        total = 10 ** ((new.foreign_level_db_sl or 0.0) / 10)
        assert total > 2 * foreign
        expected = level / (level / contrast + total - foreign)
        assert new.promised_contrast_db == pytest.approx(10 * math.log10(expected), abs=1e-6)
        assert new.verdict == ("own" if new.promised_contrast_db >= 12 else "mixed")
        assert (new.level_db_sl, new.frequency) == (old.level_db_sl, old.frequency)


@pytest.mark.parametrize(
    ("contrast", "foreign", "expected", "total", "verdict"),
    [
        (14.0, 5.0, 20 - 10 * math.log10(10**0.6 + 10**0.6), 8.539, "mixed"),
        (None, None, 14.0, 6.0, "own"),
        (11.0, None, 11.0, 6.0, "mixed"),
    ],
)
def test_powers_of_contents_add(
    contrast: float | None, foreign: float | None, expected: float, total: float, verdict: str
) -> None:
    """6 dB SL beside 20: on 6 dB SL that its contrast of 14 dB is to, on 5 dB SL, on nothing."""
    contact = Contact(ContactKey("a", 1), 0.1, 0.1, 0.0)
    was = "mixed" if contrast == 11 else "own"
    felt = Prediction(
        contact, 20.0, None, was, promised_contrast_db=contrast, foreign_level_db_sl=foreign
    ).beside([6.0], sums_db([[6.0], [-math.inf if foreign is None else foreign]]))
    assert felt.promised_contrast_db == pytest.approx(expected, abs=1e-3)
    assert felt.foreign_level_db_sl == pytest.approx(total, abs=1e-3)
    assert felt.verdict == verdict


@in_virtual_time
async def test_a_click_without_a_free_layer_is_refused_and_the_buzz_plays_on() -> None:
    """Of two layers none is left, and its finger's row says why; what lasts is as before."""
    contacts = [Contact(ContactKey("a", n), *at, 0.0) for n, at in enumerate((LEFT, RIGHT))]
    lasting = [Target(each.key, 14.0, content="buzz") for each in contacts]
    click = Target(contacts[0].key, 20.0, Pulse(0.04, 1.0), content="click", priority=9)
    selector, found = Selector(Chooser(table())), list[Selection]()
    for targets in (lasting, lasting, [*lasting, click]):
        intent = HapticIntent(tuple(targets))
        found.append(selector.select(contacts, intent, playable(2), now=1.0))
        await asyncio.sleep(0.1)
    assert found[2].contents == found[1].contents
    old, new = (each.predictions[0] for each in found[1:])
    assert replace(new, held_back=None) == old
    assert "no layer is free" in (new.held_back or "")


ENABLED, STOPPED = "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"


def states(chain: Chain) -> set[str]:
    """The states of all amplifiers."""
    return {end.state for end in chain.far_ends}


@pytest.mark.parametrize("kind", ["Set", "Commit", "Ping"])
@in_virtual_time
async def test_unexpected_exception_stops_all(kind: str) -> None:
    """A bug anywhere, between stage and commit too, leaves nothing vibrating."""
    async with set_running("a", "b") as chain:
        wire = chain.controller.amplifiers["b"].line.wire
        request = wire.request

        def fail(address: int, name: str, values: Values, **more: bool) -> bytes:
            if name == kind:
                raise ZeroDivisionError("a bug")
            return request(address, name, values, **more)

        wire.request = fail  # type: ignore[method-assign]
        await chain.hold(0.1, down=[FINGER])
        running, chain.running = chain.running, None
        with pytest.raises(ZeroDivisionError):
            await running  # type: ignore[misc]
        assert states(chain) == {STOPPED}
        assert chain.controller.group.state is GroupState.STOPPED


@pytest.mark.parametrize(
    ("count", "is_stopped", "logged"), [(2, False, []), (1000, True, ["ERROR"])]
)
@in_virtual_time
async def test_close_waits_for_zero_then_stops(
    caplog: pytest.LogCaptureFixture, count: int, is_stopped: bool, logged: list[str]
) -> None:
    """Delayed levels are read again; an amplifier that keeps one is stopped, which is logged."""
    left = count

    def lag(name: str, values: Values) -> Values | None:
        nonlocal left
        if name == "Disarm":
            chain.far_end.obey(name, values, asyncio.get_running_loop().time())
        if left <= 0 or "Disarm" not in chain.far_end.names() or name == "Stop":
            return None
        left -= 1
        return {**chain.far_end.status(), "levels": [3000, 0, 0]}

    caplog.set_level(logging.INFO)
    async with set_running(breaks="silent") as chain:
        chain.far_end.answer = lag
    assert bool(chain.far_end.requests("Stop")) is is_stopped
    assert not chain.far_end.is_open
    assert [record.levelname for record in caplog.records] == logged


@in_virtual_time
async def test_controller_refuses_amplifiers_that_do_not_fit_the_rig() -> None:
    """Other names, or fewer channels; nothing stays open."""
    async with set_chain() as chain:
        rig, urls = chain.far.bench.rig, chain.far.urls
        wiring = {**rig.wiring, "NE": Channel("main", 3)}
        for changed, given, problem in (
            (rig, {"other": "sim://"}, r"main.*other"),
            (replace(rig, wiring=wiring), urls, r"ERA NE .*0 to 2 on amplifier main, got 3; .*rig"),
        ):
            with pytest.raises(InputError, match=problem):
                await Controller(
                    changed,
                    chain.table,
                    lines=Lines,
                    intent_source=BuzzNewestContact(),
                    timing=SetTiming(),
                    urls=given,
                ).open()
            assert not chain.far_end.is_open


@in_virtual_time
async def test_open_refuses_a_table_without_playable_frequencies() -> None:
    """With the bands of amplifier and table; nothing stays open."""
    table, wire = small_table(), SimulatedWire("serial")
    given: dict[str, Any] = {"capabilities": {"frequency_min": 8000}, "timing": Timing(table)}
    async with Chain.on(wire, small_problem().rig, table, **given) as chain:
        with pytest.raises(InputError, match=r"60 to 250 Hz.*400-500"):
            await chain.controller.open()
        assert chain.controller.group.state is GroupState.CLOSED
        assert not chain.far_end.is_open
