"""The control loop in virtual time, with amplifiers that record their requests, and its selector.

It opens, arms, stops, closes and loses several amplifiers; clicks play beside what lasts; as many
fingers as there may be are served; and an answer that comes too late is reported and never played.
A selector asks a table for an intent, and again when it must.
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
from types import MappingProxyType
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from controller.effects.effect import Region
from controller.effects.kinds import Click
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.operation.plate_controller import Controller
from controller.play.chooser import Chooser
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.reports import PlayReport
from controller.play.selected_contents import Selection, beside_others, judged, sums_db, weakened
from controller.play.selection import Selector
from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Change, Contact, ContactKey, Touch, TouchFrame
from drivers.host.group_states import GroupState
from drivers.host.ledger import Ledger
from drivers.opening import Lines
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command
from kit.chain import FINGER, OTHER, Chain, Sent, set_chain, set_running
from kit.clock import in_virtual_time
from kit.courses import Acted, Planted, courses, follow
from kit.fingers import LAYOUT, LEFT, RIGHT, fingers_on, playable, table
from kit.plates import small_problem, small_table
from kit.set_table import SetTiming, set_answer
from model.answer.answer import Answer, Layer, Limits, Sensation
from model.answer.answer_report import Timing
from model.answer.stimulus import Finger, Placement, Stimulus
from model.config.fields import Circle
from model.errors import InputError
from model.rig.rig import Channel
from model.structure.material import Material
from model.structure.plate import Plate
from model.transients.base_motion import BaseEnvelope
from model.vibration import Excitation, Tone
from registry import threads
from registry.limits import HAND_LOAD
from sim.far_ends.wire_assignment import SimulatedWire


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

    def has_effect_at(self, contact: Contact) -> bool:
        """Return True: every contact has one."""
        return True


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
    def vibrations(self) -> list[Sent]:
        """Every set that vibrates."""
        return [each for each in self.far_end.sent() if not each.is_silent]

    @property
    def commands(self) -> list[Command]:
        """What each of them says of the first channel."""
        return [each.layer.commands[0] for each in self.vibrations]

    def knots(self, envelope: str) -> list[int]:
        """How many an envelope of the first channel has in each of them, onset or ending."""
        return [len(getattr(getattr(each, envelope), "knots", ())) for each in self.commands]

    @property
    def expiries(self) -> list[float]:
        """When each of them ends by itself [s]."""
        valid_for = QUANTITIES["valid_for"]
        return [each.time + valid_for.from_wire(each.layer.valid_for) for each in self.vibrations]

    @property
    def pauses(self) -> list[float]:
        """Times between them [s]."""
        return [later.time - each.time for each, later in pairwise(self.vibrations)]

    @property
    def has_gaps(self) -> bool:
        """Whether one of them has ended by itself before the next."""
        nexts = self.vibrations[1:]
        return any(each.time > end for each, end in zip(nexts, self.expiries, strict=False))

    async def looks(self, seconds: float) -> None:
        """Look at the first channel every millisecond."""
        began = threads.now()
        for _ in range(round(1000 * seconds)):
            self.seen.append((threads.now() - began, self.far_end.levels[0]))
            await asyncio.sleep(0.001)

    @property
    def audible(self) -> list[float]:
        """When it was, since the looks began [s]."""
        return [time for time, level in self.seen if level > AUDIBLE]

    @property
    def pings_amid(self) -> int:
        """How many heartbeats came between a commit that was aborted and its silence."""
        return sum(
            end.times("Commit")[0] <= time <= end.times("Silence")[0]
            for end in self.far_ends
            for time in end.times("Ping")
        )

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

    def is_disarmed_by_another(self, of: int) -> None:
        """Let another program disarm an amplifier; the sessions so far are noted."""
        self.sessions = {each.amplifier.session for each in self.far_ends}
        self.far_ends[of].obey("Disarm", {"ramp": 0}, threads.now())


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


REST = Region("rest", Circle(*OTHER[1:], 0.02))
"""Where the other finger is, which feels nothing there."""
SOURCES: Mapping[str, Callable[[], Any]] = {
    "newest": lambda: EffectPlayer(SurfaceLayout()),
    "but the other": lambda: EffectPlayer(
        SurfaceLayout((Region("rest", Circle(*OTHER[1:], 0.02)),))
    ),
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


@in_virtual_time
async def test_ledger_is_queried_once_for_the_set_of_a_touch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The worst case of a set is computed when it is planned, and not again when it is sent."""
    admit = Ledger.admit
    admissions: list[Sequence[AmplifierLayer]] = []

    def record(ledger: Ledger, layers: Sequence[AmplifierLayer], *args: Any, **options: Any) -> Any:
        admissions.append(layers)
        return admit(ledger, layers, *args, **options)

    monkeypatch.setattr(Ledger, "admit", record)
    async with fingers_on(table(), LAYOUT) as fingers:
        fingers.at = {1: LEFT}
        await fingers.hold(0.02)
        assert len(fingers.committed) == len(admissions) == 1


@in_virtual_time
async def test_a_click_restates_what_its_neighbor_feels_and_only_meanwhile() -> None:
    """Foreign level: none of 40 ms is above it on this plate; contrast: by powers, by hand."""
    async with fingers_on(table(), PLAYED, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        before = len(fingers.applied)
        fingers.play("click")
        await fingers.hold(0.3)
        old, new, again = [
            {each.contact.key.id: each for each in report.targets}[2]
            for report in fingers.applied[before - 1 :]
        ]
        assert again == old
        then, now = old.sensation, new.sensation
        figures = old.level_db_sl, then.promised_contrast_db, then.foreign_level_db_sl
        level, contrast, foreign = (10 ** ((each or 0.0) / 10) for each in figures)
        total = 10 ** ((now.foreign_level_db_sl or 0.0) / 10)
        assert total > 2 * foreign
        expected = level / (level / contrast + total - foreign)
        assert now.promised_contrast_db == pytest.approx(10 * math.log10(expected), abs=1e-6)
        assert now.verdict == ("own" if now.promised_contrast_db >= 12 else "mixed")
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
    alone = Sensation(
        Finger((0.1, 0.1), Stimulus(20.0)),
        "mixed" if contrast == 11 else "own",
        layer=0,
        promised_level_db_sl=20.0,
        promised_contrast_db=contrast,
        foreign_levels_db_sl=() if foreign is None else (foreign,),
    )
    foreign_levels = sums_db([[6.0], [-math.inf if foreign is None else foreign]])
    felt = judged(beside_others(alone, [6.0], foreign_levels), is_apart=True)
    assert felt.promised_contrast_db == pytest.approx(expected, abs=1e-3)
    assert felt.foreign_level_db_sl == pytest.approx(total, abs=1e-3)
    assert felt.verdict == verdict


def test_level_of_others_is_the_greatest_and_that_by_the_rigs_set() -> None:
    """Of 5 dB SL by the rig's set and 33 by another; 6 dB weaker, both are 6 dB less."""
    alone = Sensation(Finger((0.1, 0.1), Stimulus(20.0)), "own", layer=0, promised_level_db_sl=20.0)
    felt = beside_others(alone, [5.0, 33.0], [5.0, 33.0], [0.0, 28.0])
    assert (felt.rig_foreign_level_db_sl, felt.foreign_level_db_sl) == (5.0, 33.0)
    weaker = weakened(felt, -6.0, -6.0)
    assert (weaker.rig_foreign_level_db_sl, weaker.foreign_level_db_sl) == (-1.0, 27.0)


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
    old, new = (each.finger_sensations[0] for each in found[1:])
    assert replace(new, held_back=None) == old
    assert "no layer is free" in (new.held_back or "")


@pytest.mark.parametrize("kind", ["Set", "Commit", "Ping"])
@in_virtual_time
async def test_unexpected_exception_stops_all(kind: str) -> None:
    """A bug anywhere, between stage and commit too, leaves nothing vibrating."""
    async with set_running("a", "b", of=Acted) as chain:
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
        assert chain.amplifiers == "QUICK_STOP_ACTIVE"
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
    async with set_running() as chain:
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
                    intent_source=EffectPlayer(SurfaceLayout()),
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


CAPABILITIES = PlaybackCapabilities(
    "phased", ("switched", "phased"), Limits((45.0, 300.0), {"SW": 1e-4}), RAMPS_ONLY
)


class RecordingTable:
    """A table that records its questions, and refuses targets left of `refuse_below`."""

    plate = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))
    frequencies = np.array([100.0])
    full_levels: Mapping[str, float] = MappingProxyType({"SW": 1e-4})

    def __init__(self) -> None:
        self.asked: list[list[Finger]] = []
        self.given: list[dict[str, Any]] = []
        self.refuse_below = 0.0
        self.most: float | None = None
        self.error: Exception | None = None

    def excursion_of(self, drives: Sequence[Any]) -> float:
        """An ERA has no magnet."""
        return 0.0

    def prepare(self, mode: str) -> None:
        """Do nothing."""

    def levels_by_set(self, level_db_sl: float, excitation: Excitation) -> list[float]:
        """The same by its only set of thresholds."""
        return [level_db_sl]

    def answer(self, fingers: Sequence[Finger], **others: Any) -> Answer:
        """One of a frequency that names how often it was asked, at the level asked for."""
        self.asked.append([*fingers])
        self.given.append(others)
        (stimulus,) = [each.stimulus for each in fingers if each.stimulus is not None]
        if self.error is not None:
            raise self.error
        if fingers[0].at[0] < self.refuse_below:
            raise InputError("nothing is felt there")
        drive = {"SW": Tone(100.0 + len(self.asked), 1e-6)}
        level, mode = stimulus.level_db_sl, others["drive_mode"]
        level = level if self.most is None else self.most
        limits = others["limits"]
        return set_answer(fingers, drive, level_db_sl=level, drive_mode=mode, limits=limits)


def wanting(**levels: float | None) -> HapticIntent:
    """An intent for contacts c1, c2 and so on, at their levels, be they on the plate or not."""
    targets = (Target(ContactKey("a", int(name[1:])), each) for name, each in levels.items())
    return HapticIntent(tuple(targets), "nothing is wanted")


def at(id: int, x: float, y: float = 0.1) -> Contact:
    """A contact."""
    return Contact(ContactKey("a", id), x, y, since=0.0)


@pytest.fixture
def recorder() -> Any:
    """A table that refuses nothing."""
    return RecordingTable()


@dataclass(frozen=True)
class Chosen:
    """What a selector chooses for contacts and an intent.

    is_asked: whether it asks the table for it, else it keeps what it chose before, or asks nothing;
    reason: for silence; loads, frequencies: of the question. The table refuses targets left of
    refuse_below [m], or fails with an error.
    """

    contacts: Sequence[Contact]
    intent: HapticIntent
    is_asked: bool
    reason: str = ""
    loads: tuple[float, ...] | None = None
    frequencies: tuple[float, float] | None = None
    refuse_below: float = 0.0
    error: Exception | None = None


def moving(mover: int) -> list[Chosen]:
    """One of two contacts moves; its distance counts from where the pattern was selected."""
    at_distance = [
        (at(1, 0.1, 0.1 + (distance if mover == 0 else 0.0)),
         at(2, 0.2, 0.1 - (distance if mover == 1 else 0.0)))
        for distance in (0.0, 0.004, 0.0079, 0.0081, 0.0)
    ]  # fmt: skip
    asked = (True, False, False, True, True)
    return [Chosen(c, wanting(c2=20.0), a) for c, a in zip(at_distance, asked, strict=True)]


ONE, TWO, NONE = at(1, 0.1), at(2, 0.2), "nothing is wanted"
PULSE = Pulse(0.04, requested_at=0.0, is_raised=False)
PULSED = HapticIntent((Target(ContactKey("a", 1), 20.0, pulse=PULSE),))
REFUSED = "nothing is felt there"
BAND, ALONE = (45.0, 300.0), (101.0, 101.0)
FAILED = "ZeroDivisionError: by no ERA"

QUESTIONS: Mapping[str, Sequence[Chosen]] = {
    # No target, or none on the plate; the reason is that of the intent.
    "no target": [
        *(Chosen(contacts, wanting(), False, NONE) for contacts in ((), (ONE,), (at(1, 0.29),))),
        *(Chosen(contacts, wanting(c9=20.0), False, NONE) for contacts in ((), (ONE,))),
    ],
    "the quiet contact moves": moving(0),
    "the target moves": moving(1),
    # Loads are asked for in the order of the question, and not at all where all are 1.
    "another load": [
        Chosen((ONE, TWO), wanting(c2=20.0), True, loads=(1.0, 1.0)),
        Chosen((replace(ONE, load=1.6), TWO), wanting(c2=20.0), True, loads=(1.0, 1.6)),
        Chosen((replace(ONE, load=1.6), TWO), wanting(c2=20.0), False),
        Chosen(
            (replace(ONE, load=1.6), replace(TWO, load=2.4)),
            wanting(c2=20.0),
            True,
            loads=(2.4, 1.6),
        ),
        Chosen((ONE, TWO), wanting(c2=20.0), True, loads=(1.0, 1.0)),
    ],
    # It is over before a change would help.
    "a short pulse": [
        Chosen((ONE,), PULSED, True),
        Chosen((replace(ONE, load=2.0),), PULSED, False),
    ],
    # Another level, another target; the level first at the frequency that plays.
    "another intent": [
        Chosen((ONE, TWO), wanting(c1=20.0), True, frequencies=BAND),
        Chosen((ONE, TWO), wanting(c1=20.0), False),
        Chosen((ONE, TWO), wanting(c1=14.0), True, frequencies=ALONE),
        Chosen((ONE, TWO), wanting(c1=14.0), False),
        Chosen((ONE, TWO), wanting(c2=14.0), True),
        Chosen((ONE, TWO), wanting(c2=14.0), False),
    ],
    # A change would be felt at the target.
    "a quiet contact lifts": [
        Chosen((ONE, TWO), wanting(c2=20.0), True),
        Chosen((TWO,), wanting(c2=20.0), False),
    ],
    # So is its load, without which the plate answers otherwise.
    "a hand lifts": [
        Chosen((replace(ONE, load=HAND_LOAD), TWO), wanting(c2=20.0), True, loads=(1.0, HAND_LOAD)),
        Chosen((TWO,), wanting(c2=20.0), True, loads=(1.0,)),
    ],
    # The reason is that of the table; contacts that change cause another query: without the quiet
    # one it might have been possible.
    "the table refuses": [
        Chosen((at(1, 0.25), at(2, 0.1)), wanting(c2=20.0), True, REFUSED, refuse_below=0.2),
        Chosen((at(1, 0.25), at(2, 0.1)), wanting(c2=20.0), False, REFUSED, refuse_below=0.2),
        Chosen((at(2, 0.1),), wanting(c2=20.0), True, REFUSED, refuse_below=0.2),
        Chosen((at(2, 0.21),), wanting(c2=20.0), True, refuse_below=0.2),
    ],
    # Its exception is the reason for silence until the contacts change.
    "the table fails": [
        Chosen((ONE,), wanting(c1=20.0), True, FAILED, error=ZeroDivisionError("by no ERA")),
        Chosen((ONE,), wanting(c1=20.0), False, FAILED, error=ZeroDivisionError("by no ERA")),
        Chosen((at(1, 0.2),), wanting(c1=20.0), True),
    ],
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_selector_asks_again_when_it_must(recorder: Any, name: str) -> None:
    """And keeps what it has chosen otherwise; silence has its reason."""
    selector, before = Selector(Chooser(recorder)), None
    for step in QUESTIONS[name]:
        recorder.refuse_below, recorder.error, count = (
            step.refuse_below,
            step.error,
            len(recorder.asked),
        )
        chosen = selector.select(step.contacts, step.intent, CAPABILITIES)
        assert len(recorder.asked) - count == step.is_asked, step
        assert step.is_asked is (chosen is not before) or not chosen.targets, step
        assert bool(chosen.contents) is not bool(step.reason), step
        assert step.reason in ("", chosen.reason), step
        if step.loads is not None:
            assert tuple(each.load for each in recorder.asked[-1]) == step.loads, step
        if step.frequencies is not None:
            stimulus = recorder.asked[-1][0].stimulus
            assert stimulus.band_hz == step.frequencies, step
        before = chosen


def test_a_pulse_is_held_back_where_others_use_the_whole_stroke(recorder: Any) -> None:
    """Beside 1 µm of 1 µm nothing is left of its stroke: it is said, not played at level zero."""
    pulse = Target(ContactKey("a", 2), 12.0, pulse=Pulse(0.03, requested_at=0.0))
    intent = HapticIntent((Target(ContactKey("a", 1), 12.0), pulse))
    full = replace(CAPABILITIES, limits=Limits((45.0, 300.0), {"SW": 1e-6}), layers=2)
    selection = Selector(Chooser(recorder)).select((at(1, 0.1), at(2, 0.2)), intent, full)
    assert [each.contact.key.id for each in selection.contents] == [1]
    (held,) = selection.unserved
    assert held.held_back == "the vibrations of other fingers use the whole stroke; lift a finger"


@pytest.mark.parametrize(("since", "left"), [(0.0, 0.6e-6), (0.02, 0.6e-6), (0.5, 1e-6)])
def test_a_click_leaves_what_another_drives_until_that_has_ended(
    recorder: Any, since: float, left: float
) -> None:
    """Of 1.6 µm, of which each would take 1 µm: at once, while the first plays, and after it."""
    limits = replace(CAPABILITIES, limits=Limits((45.0, 300.0), {"SW": 1.6e-6}), layers=2)
    selector, contacts = Selector(Chooser(recorder)), (at(1, 0.1), at(2, 0.2))
    first, second = (
        Target(ContactKey("a", id), 12.0, pulse=Pulse(0.03, requested_at=requested_at))
        for id, requested_at in ((1, 0.0), (2, since))
    )
    if since:
        selector.select(contacts[:1], HapticIntent((first,)), limits, now=0.0)
    both = HapticIntent((first, second))
    selection = selector.select(contacts, both, limits, now=since)
    amplitudes = [each.layer.excitation["SW"].amplitude for each in selection.contents]
    assert amplitudes == pytest.approx([1e-6, left])
    assert selection.finger_sensations[1].level_db_sl == pytest.approx(
        12 + 20 * math.log10(left / 1e-6)
    )


@pytest.mark.parametrize(
    ("until", "due"), [(math.inf, math.inf), (7.0, 7.0), (3.0, 5.001), (math.nan, 5.001)]
)
def test_due_of_an_expired_intent_is_later(until: float, due: float) -> None:
    """So that it does not keep the loop busy."""
    assert HapticIntent((), until=until).due(5.0) == due


@in_virtual_time
async def test_vibration_ends_by_itself_if_a_contact_of_a_dead_panel_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Were it never lifted, heartbeats alone would keep nothing playing."""
    async with set_running(breaks="lift", of=Played) as chain:
        never = property(lambda tracker: math.inf, lambda tracker, at: None)
        monkeypatch.setattr(ContactTracker, "next_expiry", never, raising=False)
        monkeypatch.setattr(ContactTracker, "expire", lambda tracker, now: Change())
        chain.marks()
        await chain.leave(60.0, FINGER)
        assert not chain.far_end.sent()[-1].is_silent
        assert 0.0 < max(chain.expiries) - chain.marked_at < 2.1


@in_virtual_time
async def test_vibration_of_a_finger_that_moves_whenever_the_loop_turns_is_renewed() -> None:
    """By half a millimeter, which changes nothing else: there is no gap."""
    async with set_running(of=Played) as chain:
        number, x, y = FINGER
        step, chain.at = chain.controller.cycle.step, {number: (x, y)}

        async def turn() -> None:
            await asyncio.sleep(0.002)
            chain.put((number, x + 0.0005 * (chain.at[number][0] == x), y))
            await step()

        chain.controller.cycle.step = turn  # type: ignore[method-assign]
        await asyncio.sleep(6.0)
        assert len(chain.vibrations) > 3
        assert not chain.has_gaps
        assert chain.far_end.levels[0] == 0.2  # of the table's pattern
