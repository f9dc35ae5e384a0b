"""Contents of one finger and of several at once, in virtual time over the wire.

Courses of one content, and fingers on layouts whose contents are heard at the fingertips; which
contents are lowered so that their sum is within the limits of the amplifiers; what is not served.
"""

import asyncio
import math
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from cases import read_yaml, shortly
from controller.content.pattern import Pattern, Transient
from controller.daemon.plate_view import PlateView
from controller.effects.file_effect import File
from controller.effects.layout import SurfaceLayout, layout_of
from controller.play.chooser import Chooser
from controller.play.intent import CLICK, FingerTarget, HapticIntent, Pulse, Target
from controller.play.layers import CROSSFADE, LayerAllocation, Slot, SlotPhase
from controller.play.selected_contents import Content, ContentKey, Selection
from controller.play.selection import Selector
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.play.slots import Slots
from controller.sources.touch import Contact, ContactKey
from kit.chain import FINGER, set_running
from kit.clock import in_virtual_time
from kit.courses import Acted, courses, fits, follow
from kit.fingers import (
    ABOVE,
    LAYOUT,
    LEFT,
    RIGHT,
    Hands,
    chosen_for,
    fingers_on,
    places_of,
    playable,
    table,
)
from kit.plates import smooth_rig
from model.answer.answer import Layer
from model.answer.answer_report import Timing
from model.answer.envelope import Course
from model.answer.stimulus import Placement
from model.config.document import data_text, parse_document
from model.vibration import Tone
from registry import threads

FILE = read_yaml(Path(__file__).with_name("fingers.yaml"))
LAYOUTS = {
    name: layout_of(parse_document(name, data_text(each)), None)
    for name, each in FILE["layouts"].items()
}


CONTACTS = [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate((LEFT, RIGHT))]


@asynccontextmanager
async def hands(
    *amplifiers: str,
    fingers: Mapping[int, Any] = MappingProxyType({}),
    layout: str = "plain",
    **options: Any,
) -> AsyncIterator[Hands]:
    """Fingers on a layout of the file, with a first mark; options: as of `fingers_on`."""
    given = {"at": places_of(fingers), "amplifiers": amplifiers or ("main",), **options}
    async with fingers_on(table(), LAYOUTS[layout], of=Hands, **given) as found:
        with pytest.MonkeyPatch.context() as found.patch:
            found.layouts = LAYOUTS
            found.marks()
            yield found


@pytest.mark.parametrize(
    "name",
    shortly(
        FILE["courses"],
        FILE["courses"].keys()
        - {
            "latency counts from the change that an answer is for",
            "slide to another band keeps the beat",
        },
    ),
)
def test_fingers_keep_to_their_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(FILE["courses"][name], hands)


def test_a_shared_content_that_changes_beside_a_click_of_its_finger_keeps_its_layer() -> None:
    """The click has begun first: what is decided next restarts neither of the two."""
    shared = tuple(FingerTarget(each, Target(each.key, 14.0)) for each in CONTACTS)
    click = Target(CONTACTS[0].key, 14.0, pulse=Pulse(0.04, requested_at=0.0))
    pattern = Layer({"SW": Tone(100.0, 1e-6)})
    lasting = Content(ContentKey(CONTACTS[0].key, 0), shared, Placement((LEFT,)), pattern)
    clicked = (FingerTarget(CONTACTS[0], click),)
    clicking = Content(ContentKey(CONTACTS[0].key, 0), clicked, Placement((LEFT,)), pattern)
    playing = Slots(smooth_rig(), playable(4), Timing(table()), expiry_of=lambda key: 0.0)
    slots = {number: Slot(one, pattern) for number, one in ((1, clicking), (0, lasting))}
    playing.layers.take(slots, {0})
    assert playing.layers.allocate([lasting, clicking]) == {0: lasting, 1: clicking}
    assert not playing.plan([lasting, clicking], 0.0).started


def test_slots_change_only_when_a_plan_is_adopted() -> None:
    """Planning a start and a silence leaves all layers as they are; silence is planned once."""
    key = CONTACTS[0].key
    targets = (FingerTarget(CONTACTS[0], Target(key, 14.0)),)
    layer = Layer({"SW": Tone(100.0, 1e-6)})
    content = Content(ContentKey(key, 0), targets, Placement((LEFT,)), layer)
    slots = Slots(smooth_rig(), playable(4), Timing(table()), expiry_of=lambda key: 10.0)
    start = slots.plan([content], 0.0)
    assert (slots.by_layer, slots.layers.may_play) == ({}, frozenset())
    slots.adopt(start, 0.0)
    assert slots.by_layer[0].phase is SlotPhase.STARTING
    silence = slots.silence(0.01)
    assert slots.by_layer[0].content == content
    slots.adopt(silence, 0.1)
    assert (slots.by_layer, slots.layers.may_play) == ({}, {0})  # until it is confirmed
    assert slots.silence(0.01).is_empty


def test_a_replacement_that_was_dropped_still_fades_when_it_is_tried_again() -> None:
    """The former content plays on in its layer, which is its finger's again; its fall is retried.

    A ledger that refuses the fall until 1.1 s has it sent then, so the two do not sound together.
    """
    key = CONTACTS[0].key
    targets = (FingerTarget(CONTACTS[0], Target(key, 14.0)),)
    former_layer = Layer({"SW": Tone(100.0, 1e-6)})
    former = Content(ContentKey(key, 0), targets, Placement((LEFT,)), former_layer)
    later = replace(former, layer=Layer({"SW": Tone(150.0, 1e-6)}), is_led=True)
    layers = LayerAllocation(4)
    playing = {0: Slot(former, former.layer)}
    layers.take(playing, {0})
    assert layers.allocate([later]) == {1: later}
    falling = playing[0].falling(1.0)
    layers.take({0: falling, 1: Slot(later, later.layer)}, {1})
    layers.reset(playing)
    assert layers.allocate([later]) == {2: later}
    assert layers.fade_time(2, later) == CROSSFADE
    falling.put_off(1.1, is_update=True)
    assert falling.update_due == 1.1


FREE = playable()


def chosen(capabilities: PlaybackCapabilities, *targets: Target) -> Selection:
    """What is chosen for both fingers."""
    served = list(zip(CONTACTS, targets, strict=True))
    return chosen_for(served, capabilities)


def sums(found: Selection) -> np.ndarray:
    """Sum of the levels of all contents at each ERA (eras,)."""
    return np.array(
        [
            sum(each.layer.excitation[era.name].amplitude for each in found.contents) / era.stroke
            for era in table().eras
        ]
    )


def within(*, most: float = 1.0, power: float = np.inf) -> PlaybackCapabilities:
    """Amplifiers that play so much of each stroke, and of the power."""
    amplitudes = {era.name: most * era.stroke for era in table().eras}
    return replace(FREE, limits=replace(FREE.limits, amplitudes=amplitudes, power=power))


def limited(found: Selection, what: str) -> PlaybackCapabilities:
    """Amplifiers with 80 % of the level, or of the power's root, that contents take.

    Those of power play up to half of the level, too.
    """
    if what == "power":
        power = float((sums(found) ** 2).sum()) * 0.8**2  # of levels of full stroke
        return within(most=0.5, power=power)
    return within(most=0.8 * sums(found).max())


def is_used(found: Selection, capabilities: PlaybackCapabilities) -> bool:
    """Whether contents are within a limit, and take nearly all of it."""
    limits = capabilities.limits
    (share,) = {limits.amplitudes[each.name] / each.stroke for each in table().eras}
    of_limit = max(sums(found).max() / share, np.linalg.norm(sums(found)) / np.sqrt(limits.power))
    return bool(0.95 < of_limit < 1.0 + 1e-6)


@pytest.mark.parametrize("what", ["level", "power"])
@pytest.mark.parametrize("modulation", [None, 20.0])
def test_a_higher_priority_keeps_its_level_within_a_limit(
    what: str, modulation: float | None
) -> None:
    """The other is lowered alone, modulated or not, and promised with what is left."""
    first = Target(CONTACTS[0].key, 14.0, priority=1)
    second = Target(CONTACTS[1].key, 14.0, modulation_hz=modulation)
    free = chosen(FREE, first, second)
    capabilities = limited(free, what)
    found = chosen(capabilities, first, second)
    kept, lowered = found.finger_sensations
    assert kept.level_db_sl == pytest.approx(14.0, abs=0.2)
    assert lowered.level_db_sl < 13.0
    assert is_used(found, capabilities)
    before = free.finger_sensations[1].sensation.promised_contrast_db
    change = lowered.sensation.promised_contrast_db - before
    assert change == pytest.approx(lowered.level_db_sl - 14.0, abs=1.0)


def test_who_is_lowered_too_far_is_held_back_by_the_rule() -> None:
    """What the first content leaves of the amplifiers' level is not enough for the second."""
    first, second = Target(CONTACTS[0].key, 14.0, priority=1), Target(CONTACTS[1].key, 14.0)
    content, _ = chosen(FREE, first, second).contents
    most = max(content.layer.excitation[each.name].amplitude / each.stroke for each in table().eras)
    found = chosen(within(most=1.02 * most), first, second)
    kept, held_back = found.finger_sensations
    assert kept.level_db_sl == pytest.approx(14.0, abs=0.3)
    assert held_back.sensation.verdict == "held back"
    assert held_back.held_back


def test_contents_that_a_limit_leaves_unfelt_are_held_back() -> None:
    """With 40 dB less than 14 dB SL takes; a level below 0 dB SL from the start is kept."""
    wanted = [Target(each.key, 14.0) for each in CONTACTS]
    most = 0.01 * sums(chosen(FREE, *wanted)).max()
    found = chosen(within(most=most), *wanted)
    assert found.contents == ()
    assert all("the limits of the amplifiers" in (each.held_back or "") for each in found.unserved)
    assert len(found.unserved) == 2
    quiet = chosen(FREE, *(replace(each, level_db_sl=-10.0) for each in wanted))
    assert len(quiet.contents) == 2


@pytest.mark.parametrize("what", ["level", "power"])
def test_of_equal_priority_the_louder_content_is_lowered(what: str) -> None:
    """Max-min: the softer one keeps its level as long as the louder one is above it."""
    targets = Target(CONTACTS[0].key, 14.0), Target(CONTACTS[1].key, 8.0)
    capabilities = limited(chosen(FREE, *targets), what)
    found = chosen(capabilities, *targets)
    louder, softer = (each.level_db_sl for each in found.finger_sensations)
    assert softer == pytest.approx(8.0, abs=0.2)
    assert 8.0 < louder < 13.5
    assert is_used(found, capabilities)


def test_a_click_is_within_the_power_that_what_lasts_leaves() -> None:
    """Both at once take no more than the limit; with hardly any left it is held back."""
    click = Target(CONTACTS[1].key, 20.0, pulse=Pulse(0.04, requested_at=0.0))
    intent = HapticIntent((Target(CONTACTS[0].key, 20.0), click))
    free = Selector(Chooser(table())).select(CONTACTS, intent, FREE)
    lasting = np.linalg.norm(sums(replace(free, contents=free.contents[:1])))
    for share, count in ((1.3, 2), (1.001, 1)):
        capabilities = within(power=(share * lasting) ** 2)
        found = Selector(Chooser(table())).select(CONTACTS, intent, capabilities)
        assert len(found.contents) == count
        assert (
            np.linalg.norm(sums(found)) <= share * lasting * (1 + 1e-6) < np.linalg.norm(sums(free))
        )
    (held_back,) = found.unserved
    assert "lift a finger" in str(held_back.held_back)


def test_what_a_click_leaves_nothing_for_says_so_and_is_felt_after_it() -> None:
    """The limits are no cause: without the click they allow it."""
    click = Target(CONTACTS[1].key, 20.0, pulse=Pulse(0.04, requested_at=0.0))
    lasting = Target(CONTACTS[0].key, 20.0)
    alone = Selector(Chooser(table())).select(CONTACTS, HapticIntent((click,)), FREE)
    hardly = within(power=(1.001 * np.linalg.norm(sums(alone))) ** 2)
    selector = Selector(Chooser(table()))
    selector.select(CONTACTS, HapticIntent((click,)), hardly, now=0.0)
    both = HapticIntent((lasting, click))
    (held_back,) = selector.select(CONTACTS, both, hardly, now=0.01).unserved
    assert held_back.contact == CONTACTS[0]
    assert "vibrations of other fingers" in str(held_back.held_back)
    after = HapticIntent((lasting,))
    found = selector.select(CONTACTS, after, hardly, now=selector.due)
    assert (found.unserved, len(found.contents)) == ((), 1)


@pytest.mark.parametrize("what", ["level", "power"])
def test_a_lone_steady_content_is_within_a_limit(what: str) -> None:
    """It is lowered to the limit, 0.8 of its amplitude, instead of refused by the amplifiers."""
    intent = HapticIntent((Target(CONTACTS[0].key, 14.0),))
    free = Selector(Chooser(table())).select(CONTACTS, intent, FREE)
    most = 0.8 * sums(free).max()
    capabilities = within(power=0.8**2 * float((sums(free) ** 2).sum()))
    if what == "level":
        capabilities = within(most=most)
    found = Selector(Chooser(table())).select(CONTACTS, intent, capabilities)
    assert sums(found) == pytest.approx(0.8 * sums(free), rel=1e-6)
    (before,), (after,) = free.finger_sensations, found.finger_sensations
    assert after.level_db_sl == pytest.approx(before.level_db_sl + 20 * np.log10(0.8))
    contrast = before.sensation.promised_contrast_db
    assert after.sensation.promised_contrast_db == pytest.approx(contrast)


FULL = 0.2  # the level that the table's pattern has
ROUNDING = 1.5e-4  # of a knot and of a status, in full levels
WAY = 0.002  # s; by which sets come sooner or later, and looks are a millisecond apart


@dataclass
class FeelsCourse:
    """The first finger feels a course from when it comes on, once or until it lifts."""

    course: Course
    loops: bool = False
    tap: Pulse | None = None
    pulses: dict[float, Pulse] = field(default_factory=dict)

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return it until its pulse ends."""
        if not contacts:
            return HapticIntent((), "no contact on the plate")
        first = contacts[0]
        lasts = math.inf if self.loops else self.course.duration
        pulse = self.pulses.setdefault(first.since, Pulse(lasts, first.since, is_raised=False))
        if now >= pulse.end:
            return HapticIntent((), "the course has ended")
        target = Target(first.key, 20.0, pulse=pulse, course=self.course)
        if self.tap is None or now >= self.tap.end:
            return HapticIntent((target,), until=pulse.end)
        return HapticIntent((target, Target(first.key, 14.0, pulse=self.tap)), until=self.tap.end)

    def has_effect_at(self, contact: Contact) -> bool:
        """Return True: every contact has one."""
        return True

    @property
    def started_at(self) -> float:
        """When [s] the only course has started on the amplifiers."""
        (pulse,) = self.pulses.values()
        assert pulse.started_at is not None
        return pulse.started_at


# Up in 0.1 s, down to a quarter in 0.4, up again in 0.3, and to silence in 0.4 s.
WAVE = Course((0.0, 0.1, 0.5, 0.8, 1.2), (0.0, 1.0, 0.25, 1.0, 0.0))


@dataclass
class Looked(Acted):
    """A chain whose first finger feels a course; seen: times [s] and levels of a channel."""

    feels: FeelsCourse = field(init=False)
    seen: list[tuple[float, float]] = field(default_factory=list)

    async def looks_on(self, seconds: float, *fingers: str) -> None:
        """Look every millisecond; fingers that are named are reported every ten."""
        for number in range(round(seconds * 1000)):
            if fingers and number % 10 == 0:
                self.touch(*fingers)
            self.seen.append((threads.now(), self.far_end.levels[0]))
            await asyncio.sleep(0.001)

    async def looks(self, seconds: float, *fingers: str) -> None:
        """Do the same, and forget what was seen before."""
        self.seen.clear()
        await self.looks_on(seconds, *fingers)

    def follows(
        self,
        *,
        within: float = ROUNDING,
        early: float = WAY,
        late: float = WAY,
        first: int = 0,
        gain: float = 1.0,
    ) -> None:
        """Require that levels are within all that is due from so early [s] on until so late.

        first: of the looks; gain: of levels.
        """
        times, levels = np.array(self.seen[first:]).T
        since = times - self.feels.started_at
        if self.feels.loops:
            since = np.mod(since, self.feels.course.duration)
        course, shifts = self.feels.course, np.arange(-early, late + 1e-9, 0.0005)
        due = [
            FULL * np.interp(since - each, course.times, course.shares, left=0.0, right=0.0)
            for each in shifts
        ]
        off = np.maximum(np.min(due, axis=0) - gain * levels, gain * levels - np.max(due, axis=0))
        assert off.max() < within, off.max()

    def plays(self, start: float, end: float, level: str | float) -> None:
        """Require the level between two times [s] since the course has started."""
        began = self.feels.started_at
        assert fits([level for time, level in self.seen if start <= time - began <= end], level)

    def taps(self) -> None:
        """Let the finger feel a tap of 40 ms beside the course."""
        self.feels.tap = Pulse(0.04, threads.now())
        self.controller.cycle.request_update()

    def beside_others(self, **tones: Sequence[float]) -> None:
        """Have the table answer by these tones where another finger rests."""
        self.table.shared = {era: Tone(*tone) for era, tone in tones.items()}


@asynccontextmanager
async def feeling(
    *, course: Mapping[str, Sequence[float]], loops: bool = False, **options: Any
) -> AsyncIterator[Looked]:
    """A chain, armed, whose first finger feels a course; options: as of `set_running`."""
    feels = FeelsCourse(Course(tuple(course["times"]), tuple(course["shares"])), loops)
    given = {"knots": 32, "intent_source": feels, **options}
    async with set_running(of=Looked, **given) as chain:
        chain.feels = feels
        yield chain


COURSES = courses(Path(__file__).with_name("contents.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_content_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], feeling)


@in_virtual_time
async def test_all_actuators_have_one_course_times_their_weights() -> None:
    """On two amplifiers: the one has half the level of the other at every moment."""
    felt = FeelsCourse(WAVE)
    async with set_running("main", "side", knots=32, intent_source=felt) as chain:
        chain.table.excitation = {"SW": Tone(110.0, 20e-6), "NE": Tone(110.0, 10e-6, 1.0)}
        chain.put(FINGER)
        for number in range(1300):
            if number % 10 == 0:
                chain.put(FINGER)
            levels = chain.levels()
            assert levels["side"][1] == pytest.approx(levels["main"][0] / 2, abs=ROUNDING)
            await asyncio.sleep(0.001)


@in_virtual_time
async def test_a_click_of_a_file_is_felt_beside_what_lasts_of_it() -> None:
    """In a layer of its own, 0.3 s after the start of the other, within 10 ms.

    What lasts is silent then: by hand, 30 ms before and after the 40 of the click.
    """
    pattern = Pattern(0.8, ((0.0, 1.0), (0.8, 1.0)), ((0.0, 0.5),), (Transient(0.3, 1.0, 0.5),))
    file = File.of(pattern, name="it", level_db_sl=14.0).for_table(table().frequencies)
    layout = SurfaceLayout(effects={"it": file}, elsewhere="it")
    async with fingers_on(table(), layout, at={1: LEFT}, held=1.2) as fingers:
        began = fingers.applied[0].time
        (short,) = {
            one.content.target.pulse
            for report in fingers.applied
            for one in report.contents.values()
            if one.content.key.voice == CLICK
        }
        assert short.started_at - began == pytest.approx(0.3, abs=0.01)
        (lasting,) = {
            layer.layer for _, _, layers in fingers.committed for layer in layers if layer.after
        }
        times, levels = list[float](), list[int]()
        for time, _, layers in fingers.committed:
            for layer in layers:
                onset = layer.commands[0].onset if layer.commands else None
                if layer.layer == lasting and onset is not None:
                    since = times[-1] if layer.after else time
                    steps = 1e-4 * onset.step * np.arange(1, len(onset.knots) + 2)
                    times += (since + steps).tolist()
                    levels += [each for each, _ in onset.knots] + [layer.commands[0].level]
        due = {0.20: 1.0, 0.26: 1.0, 0.29: 1 / 3, 0.31: 0.0, 0.33: 0.0, 0.35: 1 / 3, 0.4: 1.0}
        played = np.interp([*due], np.array(times) - times[0] + 0.01, levels) / max(levels)
        assert played == pytest.approx([*due.values()], abs=0.01)


@in_virtual_time
async def test_status_says_what_each_finger_feels() -> None:
    """Keys of the API: by finger its content and verdict; by layer what the ERAs play."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=0.5) as fingers:
        applied = fingers.applied[-1]
        view = PlateView(lambda key: "buzz", applied.contacts, applied)
        event = view.pattern_event()
        assert len(event.layers) == 3
        for contact, (number, one) in zip(event.contacts, applied.contents.items(), strict=True):
            assert (contact.role, contact.held_back) == ("target", None)
            promised = contact.promised_contrast_db
            assert contact.verdict == ("own" if promised >= 12 else "mixed")
            assert contact.level_db_sl == pytest.approx(14.0, abs=0.5)
            assert contact.foreign_level_db_sl == pytest.approx(14.0 - promised, abs=2.0)
            assert contact.rig_foreign_level_db_sl == contact.foreign_level_db_sl  # of one set
            assert contact.frequency_hz == one.content.frequency
            tones = event.layers[str(number)].values()
            assert {tone.frequency_hz for tone in tones} == {contact.frequency_hz}
        assert len({contact.frequency_hz for contact in event.contacts}) == 3


@in_virtual_time
async def test_what_is_shared_stays_weak_while_its_weakest_finger_feels_a_click() -> None:
    """Of five that share a vibration one has 20 dB less: so has the vibration, amid its click."""
    contacts = [Contact(ContactKey("s", n), 0.05 + 0.02 * n, 0.05, 0.0) for n in range(5)]
    lasting = [Target(each.key, 14.0, content="buzz") for each in contacts]
    clicking = [*lasting, replace(lasting[0], pulse=Pulse(0.04, 1.0), content="click")]
    selector, found = Selector(Chooser(table())), list[list[float]]()
    for targets in (lasting, lasting, clicking):
        gains = {(each.key, each.is_short): 0.0 for each in targets}
        gains |= {key: -20.0 for key in gains if key[0] == contacts[0].key}
        chosen = selector.select(contacts, HapticIntent(tuple(targets)), playable(), now=1.0)
        found.append([each.gain_db for each in chosen.weakened(gains).contents])
        await asyncio.sleep(0.1)
    assert found[1:] == [[-20.0], [-20.0, -20.0]]


def test_a_content_whose_own_contrast_is_not_why_it_is_held_back_says_so() -> None:
    """Both in one narrow band: the first would have had 3 dB beside it, it 16 itself."""
    places = (0.06, 0.06), (0.2, 0.1)
    contacts = [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate(places)]
    targets = [(each, Target(each.key, 20.0, band=(99.0, 101.0))) for each in contacts]
    (held_back,) = chosen_for(targets, playable(4)).unserved
    assert (held_back.sensation.promised_contrast_db or 0.0) > 12
    assert "another finger" in (held_back.held_back or "")


def test_a_kept_frequency_keeps_its_phase_at_the_finger() -> None:
    """As it moves by 1 cm and another joins, at its new place; by the fields of the table."""
    targets = [(each, Target(each.key, 14.0)) for each in CONTACTS]
    before = {each.key: each for each in chosen_for(targets, playable(4)).contents}
    moved = replace(CONTACTS[0], x=CONTACTS[0].x + 0.01)
    third = Contact(ContactKey("a", 2), *ABOVE, since=0.0)
    joined = [(moved, targets[0][1]), targets[1], (third, Target(third.key, 14.0))]
    second = chosen_for(joined, playable(4), before=before)
    places = [(each.x, each.y) for each, _ in joined]
    fields = table().unit_fields(np.array(places), contacts=places)
    kept = 0
    for content in second.contents:
        then = before.get(content.key)
        if then is not None and then.frequency == content.frequency:
            at = places.index((content.contact.x, content.contact.y))
            (row,) = np.flatnonzero(table().frequencies == content.frequency)
            now, old = [
                sum(
                    each.layer.excitation[era.name].phasor / era.stroke * fields[row, number, at]
                    for number, era in enumerate(table().eras)
                    if era.name in each.layer.excitation
                )
                for each in (content, then)
            ]
            assert np.angle(now / old) == pytest.approx(0.0, abs=1e-3)
            kept += 1
    assert kept
