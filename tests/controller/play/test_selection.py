"""Selection of patterns: queries for an intent, when one is selected again, and how long it plays.

Vibrations in virtual time follow envelopes, are renewed while their contacts are confirmed, and end
after a tap.
"""

import asyncio
import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import pytest

from chain import FINGER, OTHER, Chain, Sent, set_running
from controller.effects.kinds import Click
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.loop import ENDED
from controller.play.routing import RAMPS_ONLY, PlaybackCapabilities
from controller.play.selection import Chooser, Selector
from controller.sources.touch import Change, Contact, ContactKey, ContactTracker, Touch, TouchFrame
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import Envelope
from long_form import shortly
from model.answer.answer import Answer, Layer, Limits
from model.answer.stimulus import Finger, Placement, Stimulus
from model.errors import InputError
from model.structure.material import Material
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.transients.base_motion import BaseEnvelope
from model.vibration import Excitation, Tone
from plates import small_table
from registry.limits import HAND_LOAD
from set_table import SetTiming, set_answer
from virtual_lines import in_virtual_time

CAPABILITIES = PlaybackCapabilities(
    "phased", ("switched", "phased"), Limits((45.0, 300.0), {"SW": 1e-4}), RAMPS_ONLY
)


class Table:
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


def selector_of(table: Table | LocalizationTable) -> Selector:
    """A selector by a table."""
    return Selector(Chooser(cast(LocalizationTable, table)))


@pytest.fixture
def table() -> Table:
    """A table that refuses nothing."""
    return Table()


def test_selector_keeps_other_contacts_quiet(table: Table) -> None:
    """The fingers have the target's level, and drive mode and band of the amplifiers."""
    contacts = (at(1, 0.1), at(2, 0.2), at(3, 0.25))
    shaped = replace(CAPABILITIES, envelope_support=replace(RAMPS_ONLY, onset_knots=20))
    selector_of(table).select(contacts, wanting(c3=17.0), shaped)
    selection = selector_of(table).select(contacts, wanting(c3=17.0), CAPABILITIES)
    assert [each["shaped"] for each in table.given] == [True, False]
    assert table.given[1]["drive_mode"] == "phased"
    target, *quiet = table.asked[1]
    assert (target.at, [each.at for each in quiet]) == ((0.25, 0.1), [(0.1, 0.1), (0.2, 0.1)])
    assert target.stimulus == Stimulus(17.0, (45.0, 300.0))
    (predicted,) = selection.predictions
    assert (predicted.contact.key.id, predicted.level_db_sl) == (3, 17.0)


@pytest.mark.parametrize(
    ("band", "asked"),
    [
        ((90.0, 260.0), (90.0, 260.0)),
        ((60.0, 100.0), (60.0, 100.0)),
        ((200.0, 400.0), (200.0, 300.0)),
        ((105.0, 105.0), (100.0, 100.0)),
        ((310.0, 400.0), (45.0, 300.0)),
    ],
)
def test_selector_asks_within_the_band_of_its_target(
    table: Table, band: tuple[float, float], asked: tuple[float, float]
) -> None:
    """Within what the amplifiers play, 45 to 300 Hz; a single frequency is the table's nearest.

    One that shares no frequency with that is ignored.
    """
    table.frequencies = np.array([80.0, 100.0, 120.0, 250.0, 350.0])
    intent = HapticIntent((Target(ContactKey("a", 1), 12.0, band=band),))
    selector_of(table).select((at(1, 0.1),), intent, CAPABILITIES)
    stimulus = table.asked[0][0].stimulus
    assert stimulus is not None
    assert stimulus.band_hz == asked


def test_selector_asks_for_what_the_neighbours_allow(table: Table) -> None:
    """Up to 26 dB SL; where less than 0 are left it says that a finger is in the way."""
    contacts = (at(1, 0.1), at(2, 0.2))
    selector_of(table).select(contacts, wanting(c1=None), CAPABILITIES)
    stimulus = table.asked[0][0].stimulus
    assert stimulus == Stimulus(26.0, (45.0, 300.0), is_limit=True)
    table.most = -0.1
    selection = selector_of(table).select(contacts, wanting(c1=None), CAPABILITIES)
    assert selection.contents == ()
    assert selection.reason is not None
    assert "quiet finger" in selection.reason


def test_selector_saturates_at_full_stroke_on_a_plate() -> None:
    """60 dB SL is more than the ERAs of the paper reach."""
    table, full = small_table(), dict.fromkeys(("SW", "SE", "NE", "NW"), 0.0001)
    capabilities = PlaybackCapabilities(
        "switched", ("switched",), Limits((40.0, 500.0), full), RAMPS_ONLY
    )
    selection = selector_of(table).select((at(1, 0.1),), wanting(c1=60.0), capabilities)
    (content,) = selection.contents
    assert 12 < selection.predictions[0].level_db_sl < 60
    loudest = max(tone.amplitude for tone in content.layer.excitation.values())
    assert loudest == pytest.approx(1e-4)


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


def loaded(one: Contact, load: float) -> Contact:
    """A contact that presses."""
    return replace(one, load=load)


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

COURSES: Mapping[str, Sequence[Chosen]] = {
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
        Chosen((loaded(ONE, 1.6), TWO), wanting(c2=20.0), True, loads=(1.0, 1.6)),
        Chosen((loaded(ONE, 1.6), TWO), wanting(c2=20.0), False),
        Chosen((loaded(ONE, 1.6), loaded(TWO, 2.4)), wanting(c2=20.0), True, loads=(2.4, 1.6)),
        Chosen((ONE, TWO), wanting(c2=20.0), True, loads=(1.0, 1.0)),
    ],
    # It is over before a change would help.
    "a short pulse": [
        Chosen((ONE,), PULSED, True),
        Chosen((loaded(ONE, 2.0),), PULSED, False),
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
        Chosen((loaded(ONE, HAND_LOAD), TWO), wanting(c2=20.0), True, loads=(1.0, HAND_LOAD)),
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


@pytest.mark.parametrize("name", COURSES)
def test_selector_asks_again_when_it_must(table: Table, name: str) -> None:
    """And keeps what it has chosen otherwise; silence has its reason."""
    selector, before = selector_of(table), None
    for step in COURSES[name]:
        table.refuse_below, table.error, count = step.refuse_below, step.error, len(table.asked)
        chosen = selector.select(step.contacts, step.intent, CAPABILITIES)
        assert len(table.asked) - count == step.is_asked, step
        assert step.is_asked is (chosen is not before) or not chosen.targets, step
        assert bool(chosen.contents) is not bool(step.reason), step
        assert step.reason in ("", chosen.reason), step
        if step.loads is not None:
            assert tuple(each.load for each in table.asked[-1]) == step.loads, step
        if step.frequencies is not None:
            stimulus = table.asked[-1][0].stimulus
            assert stimulus is not None
            assert stimulus.band_hz == step.frequencies, step
        before = chosen


def test_a_pulse_is_held_back_where_others_use_the_whole_stroke(table: Table) -> None:
    """Beside 1 µm of 1 µm nothing is left of its stroke: it is said, not played at level zero."""
    pulse = Target(ContactKey("a", 2), 12.0, pulse=Pulse(0.03, requested_at=0.0))
    intent = HapticIntent((Target(ContactKey("a", 1), 12.0), pulse))
    full = replace(CAPABILITIES, limits=Limits((45.0, 300.0), {"SW": 1e-6}), layers=2)
    selection = selector_of(table).select((at(1, 0.1), at(2, 0.2)), intent, full)
    assert [each.targets[0][0].key.id for each in selection.contents] == [1]
    (held,) = selection.not_served
    assert held.held_back == "the contents of other fingers use the whole stroke; lift a finger"


@pytest.mark.parametrize(("since", "left"), [(0.0, 0.6e-6), (0.02, 0.6e-6), (0.5, 1e-6)])
def test_a_click_leaves_what_another_drives_until_that_has_ended(
    table: Table, since: float, left: float
) -> None:
    """Of 1.6 µm, of which each would take 1 µm: at once, while the first plays, and after it."""
    limits = replace(CAPABILITIES, limits=Limits((45.0, 300.0), {"SW": 1.6e-6}), layers=2)
    selector, contacts = selector_of(table), (at(1, 0.1), at(2, 0.2))
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
    assert selection.predictions[1].level_db_sl == pytest.approx(12 + 20 * math.log10(left / 1e-6))


@pytest.mark.parametrize(
    ("until", "due"), [(math.inf, math.inf), (7.0, 7.0), (3.0, 5.001), (math.nan, 5.001)]
)
def test_due_of_an_expired_intent_is_later(until: float, due: float) -> None:
    """So that it does not keep the loop busy."""
    assert HapticIntent((), until=until).due(5.0) == due


class Shapes(SetTiming):
    """A timing whose envelopes are straight lines: up in 21 knots, down in 8."""

    largest = 1.0

    def with_envelopes(
        self, pattern: Layer, placed: Placement, *, onset: bool, ending: bool
    ) -> Layer:
        """The lines, for the ERAs that play; the largest knot of an onset can be set."""
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


ONSET = 0.105  # s; 21 steps
FULL = 0.2  # the level that the table's pattern has


def valid_for(one: Sent) -> float:
    """How long a set lasts without another [s], 0 for ever."""
    return QUANTITIES["valid_for"].from_wire(one.layer.valid_for)


@pytest.fixture
def shapes() -> Shapes:
    """A timing whose envelopes are straight lines."""
    return Shapes()


def sets(chain: Chain) -> list[Sent]:
    """Every set since the silence that follows arming."""
    return chain.far_end.sent()[1:]


def level(chain: Chain, channel: int = 0) -> float:
    """What a channel plays now."""
    return chain.far_end.levels[channel]


def levels_of(envelope: object) -> list[float]:
    """Levels of the knots of an envelope."""
    assert isinstance(envelope, Envelope)
    return [level / 10_000 for level, _ in envelope.knots]


@in_virtual_time
async def test_touch_starts_along_its_onset(shapes: Shapes) -> None:
    """Knots of the driven ERA in strokes; the last one is the level of the command.

    By hand: lines from 0 to level 0.2 at 90 degrees, 105 ms long. No touch waits for an ending.
    """
    async with set_running(knots=32, timing=shapes) as chain:
        begin = asyncio.get_running_loop().time()
        await chain.leave(ONSET / 2, FINGER, OTHER)
        (played,) = sets(chain)
        driven, *silent = played.layer.commands
        assert not any(each.onset or each.ending or each.level for each in silent)
        assert driven.level == 2000
        assert levels_of(driven.onset) == pytest.approx(
            [FULL * number / 21 for number in range(1, 21)],
            abs=0.5e-4,  # the wire has steps of 1e-4
        )
        assert driven.ending is None
        assert isinstance(driven.onset, Envelope)
        assert (driven.onset.step, {phase for _, phase in driven.onset.knots}) == (50, {9000})
        assert level(chain) == pytest.approx(FULL / 2, abs=1e-4)
        (applied,) = chain.applied
        assert applied.layer.onset is not None
        # It plays with its last byte: of 60 words and 12 bytes, of ten bits at 921 600 baud.
        assert applied.time - begin == pytest.approx(132 / 92_160, abs=1e-6)


@in_virtual_time
async def test_ending_follows_and_changes_nothing_that_plays(shapes: Shapes) -> None:
    """Once the onset is over, within 10 ms: the level stays at 0.2 to its step meanwhile.

    By hand: a line down in 40 ms, of eight steps of which the last is silence.
    """
    async with set_running(knots=32, timing=shapes) as chain:
        begin = asyncio.get_running_loop().time()
        chain.put(FINGER, OTHER)
        await chain.leave(ONSET + 0.002, FINGER, OTHER)
        assert len(sets(chain)) == 1
        for _ in range(12):
            assert level(chain) == pytest.approx(FULL, abs=1e-4)
            await asyncio.sleep(0.001)
        _, follows = sets(chain)
        assert ONSET < follows.time - begin < ONSET + 0.012
        driven, *silent = follows.layer.commands
        assert (driven.level, driven.keep_phase, driven.onset) == (2000, True, None)
        assert levels_of(driven.ending) == pytest.approx(
            [FULL * (1 - number / 8) for number in range(1, 8)]
        )
        assert not any(each.ending or each.level for each in silent)


@in_virtual_time
async def test_ending_gives_way_to_a_touch(shapes: Shapes) -> None:
    """On two amplifiers, whose replies take 2 ms: it is staged when the finger slides.

    The set of that is the next one to play, and has its ending afterwards.
    """
    async with set_running("main", "side", knots=32, timing=shapes) as chain:
        chain.far_end.delay(0.002)
        chain.put(FINGER, OTHER)
        await asyncio.sleep(ONSET)
        count = len(chain.far_end.requests("Set"))
        for _ in range(1000):
            await asyncio.sleep(0.0001)
            if len(chain.far_end.requests("Set")) > count:
                break
        chain.put((1, 0.18, 0.1), OTHER)
        await asyncio.sleep(0.1)
        _, *others = (each.layer.commands[0] for each in sets(chain))
        assert [len(levels_of(each.ending)) for each in others if each.ending] == [7]
        assert len(others) == 2
        assert not chain.refused


@in_virtual_time
async def test_lifted_target_fades_along_its_ending(shapes: Shapes) -> None:
    """While another finger stays; reported as silence."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.3, down=[OTHER, FINGER])
        await chain.leave(0.020, OTHER)
        assert level(chain) == pytest.approx(FULL / 2, abs=1e-3)
        await asyncio.sleep(0.0205)
        assert not any(chain.far_end.levels)
        assert chain.silenced[-1].reason == "the target was lifted"
        await chain.leave(0.001)
        assert chain.far_end.names()[-1] == "Silence"


@in_virtual_time
async def test_last_lift_skips_the_ending(shapes: Shapes) -> None:
    """Zero within 20 ms: endings are for fingers that stay."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.3, down=[FINGER])
        await chain.leave(0.020)
        assert not any(chain.far_end.levels)


@in_virtual_time
async def test_lift_before_the_onset_is_over_skips_the_ending(shapes: Shapes) -> None:
    """An ending leads from the full level; lifted half way up the target fades along 20 ms."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.05, down=[OTHER, FINGER])
        chain.put(OTHER)
        highest = 0.0
        for _ in range(21):
            highest = max(highest, level(chain))
            await asyncio.sleep(0.001)
        assert highest <= FULL / 2 + 1e-3
        assert not any(chain.far_end.levels)


@in_virtual_time
async def test_continued_tone_has_no_onset(shapes: Shapes) -> None:
    """A finger that slides feels the same frequency without a gap, with an ending again."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.2, down=[FINGER, OTHER])
        await chain.hold(0.2, down=[(1, 0.18, 0.1), OTHER])
        first, _, moved, follows = (each.layer.commands[0] for each in sets(chain))
        assert (first.keep_phase, moved.keep_phase) == (False, True)
        assert moved.onset is None
        assert len(levels_of(follows.ending)) == 7
        _, reported = chain.applied
        assert reported.layer.onset is None


class Always:
    """An intent source for which every contact is a target."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return an intent with all contacts."""
        return HapticIntent(tuple(Target(each.key, 20.0) for each in contacts))


@in_virtual_time
async def test_ramps_replace_envelopes_when_amplifiers_cannot_play_them(shapes: Shapes) -> None:
    """None is sent; the ramp is reported."""
    async with set_running(timing=shapes) as chain:
        await chain.hold(0.3, down=[FINGER, OTHER])
        assert [each.onset for each in sets(chain)[0].layer.commands] == [None] * 3
        (applied,) = chain.applied
        assert applied.layer.onset is None
        assert (applied.layer.ramp, sets(chain)[0].layer.ramp) == (0.015, 15)


@in_virtual_time
async def test_ramp_replaces_an_onset_that_the_ledger_refuses(shapes: Shapes) -> None:
    """A knot beyond full stroke is not sent; the pattern is played."""
    shapes.largest = 6.0
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.05, down=[FINGER, OTHER])
        (played,) = sets(chain)
        assert (played.layer.commands[0].onset, played.layer.commands[0].level) == (None, 2000)
        (applied,) = chain.applied
        assert applied.layer.onset is None
        assert chain.refused == []


@in_virtual_time
async def test_open_prepares_table_and_envelopes(shapes: Shapes) -> None:
    """Mode and frequencies, when the controller is opened."""
    async with set_running(knots=32, timing=shapes) as chain:
        assert chain.table.prepared == ["phased"]
    assert shapes.prepared == [90.0, 110.0, 150.0, 250.0]


@in_virtual_time
async def test_failing_intent_source_silences_until_it_recovers(
    shapes: Shapes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the ramp, without endings; heartbeats continue, and touches are felt again later."""
    async with set_running(knots=32, timing=shapes, intent_source=Always()) as chain:
        await chain.hold(0.2, down=[FINGER])
        assert chain.far_end.levels[0] > 0
        with monkeypatch.context() as patch:
            patch.setattr(Always, "intent", lambda self, contacts, now: 1 / 0)
            await chain.hold(0.3, down=[FINGER, OTHER])
        assert sets(chain)[-1].token == 0  # a Silence
        assert not any(chain.far_end.levels)
        assert chain.silenced[-1].reason.startswith("ZeroDivisionError")
        assert chain.far_end.state == "OPERATION_ENABLED"
        await chain.hold(0.2, down=[(3, 0.06, 0.16)])
        assert chain.far_end.levels[0] > 0


PROMISED = 0.001  # s; rounding of times


def vibrations(chain: Chain) -> list[tuple[float, Sent]]:
    """When each set that vibrates was sent [s], and the set."""
    return [(each.time, each) for each in chain.far_end.sent() if not each.is_silent]


def frame(*touches: Touch, timeout: float) -> TouchFrame:
    """A frame of a source that is silent while fingers rest."""
    return TouchFrame("panel", asyncio.get_running_loop().time(), touches, timeout)


@in_virtual_time
async def test_vibration_of_a_silent_sender_is_not_renewed() -> None:
    """It lasts as long as the contact does, and a little; any frame of the sender prolongs both."""
    async with set_running() as chain:
        begin = asyncio.get_running_loop().time()
        chain.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(2.5)
        ((sent, only),) = vibrations(chain)
        assert 3.0 <= sent - begin + valid_for(only) <= 3.3
        chain.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(0.1)
        _, (again, renewed) = vibrations(chain)
        assert 5.5 <= again - begin + valid_for(renewed) <= 5.8
        assert again < sent + valid_for(only)
        await asyncio.sleep(5.0)
        assert len(vibrations(chain)) == 2
        assert chain.far_end.sent()[-1].is_silent


@in_virtual_time
async def test_vibration_ends_by_itself_if_a_contact_of_a_dead_panel_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Were it never lifted, heartbeats alone would keep nothing playing."""
    async with set_running(breaks="lift") as chain:
        never = property(lambda tracker: math.inf, lambda tracker, at: None)
        monkeypatch.setattr(ContactTracker, "next_expiry", never, raising=False)
        monkeypatch.setattr(ContactTracker, "expire", lambda tracker, now: Change())
        begin = asyncio.get_running_loop().time()
        await chain.leave(60.0, FINGER)
        assert not chain.far_end.sent()[-1].is_silent
        ends = [time - begin + (valid_for(each) or math.inf) for time, each in vibrations(chain)]
        assert max(ends) < 2.1


@in_virtual_time
async def test_renewal_keeps_to_a_rate_limit_of_one_set_a_second() -> None:
    """There is no gap although each second allows one set."""
    async with set_running(rate=1.0) as chain:
        await chain.hold(10.0, down=[FINGER])
        sent = vibrations(chain)
        for (time, each), (following, _) in pairwise(sent):
            assert time + 1.0 - PROMISED <= following <= time + valid_for(each)
        assert sent[-1][0] + valid_for(sent[-1][1]) >= asyncio.get_running_loop().time()
        assert chain.refused == []


@in_virtual_time
async def test_vibration_of_a_finger_that_moves_whenever_the_loop_turns_is_renewed() -> None:
    """By half a millimetre, which changes nothing else: there is no gap."""
    async with set_running() as chain:
        number, x, y = FINGER
        step, chain.at = chain.controller.cycle.step, {number: (x, y)}

        async def turn() -> None:
            await asyncio.sleep(0.002)
            chain.put((number, x + 0.0005 * (chain.at[number][0] == x), y))
            await step()

        chain.controller.cycle.step = turn  # type: ignore[method-assign]
        await asyncio.sleep(6.0)
        sent = vibrations(chain)
        assert len(sent) > 3
        assert all(later <= time + valid_for(one) for (time, one), (later, _) in pairwise(sent))
        assert level(chain) == FULL


@pytest.mark.parametrize("on_time", shortly([1.5, 2.5, 3.0, 5.5], [1.5, 3.0]))
@in_virtual_time
async def test_renewal_keeps_to_the_on_time_limit(on_time: float) -> None:
    """The vibration ends by itself a little before, and does not begin again while fingers rest."""
    async with set_running(on_time=on_time) as chain:
        await chain.hold(12.0, down=[FINGER])
        sent = vibrations(chain)
        begin, end = sent[0][0], max(time + valid_for(each) for time, each in sent)
        assert 0.8 * on_time < end - begin <= on_time
        # Or it would be shown as if it played on.
        (silenced,) = [each for each in chain.silenced if each.reason == ENDED]
        assert end <= silenced.time <= end + 0.06


AUDIBLE = 1e-3  # of full level


def _clicking() -> EffectPlayer:
    return EffectPlayer(SurfaceLayout(effects={"click": Click()}, elsewhere="click"))


async def _playing_times(chain: Chain, seconds: float) -> list[float]:
    """Times [s] from now on at which a channel plays, by the millisecond."""
    began = asyncio.get_running_loop().time()
    times = []
    while (now := asyncio.get_running_loop().time()) < began + seconds:
        if max(chain.far_end.levels) > AUDIBLE:
            times.append(now - began)
        await asyncio.sleep(0.001)
    return times


@in_virtual_time
async def test_tap_within_one_iteration_is_felt_as_a_click() -> None:
    """Its 40 ms and a ramp are played, and silent is the plate 80 ms after the tap."""
    async with set_running(intent_source=_clicking()) as chain:
        chain.put(FINGER)
        chain.put()
        times = await _playing_times(chain, 0.3)
        assert 0.035 <= times[-1] - times[0] <= 0.060
        assert times[-1] < 0.080


@in_virtual_time
async def test_vibration_is_renewed_while_its_contact_is_confirmed() -> None:
    """It lasts two seconds, and before its end its time begins anew, without any command.

    No other pattern is reported.
    """
    async with set_running() as chain:
        await chain.hold(10.0, down=[FINGER])
        sent = vibrations(chain)
        (first, *later) = [each for _, each in sent]
        assert 9 <= len(later) <= 10
        assert {valid_for(each) for _, each in sent} == {2.0}
        assert not first.layer.renew
        for each in later:
            assert each.layer.renew
            assert each.token not in (first.token, 0)
            assert each.layer.commands == ()
        assert max(b - a for (a, _), (b, _) in pairwise(sent)) < 1.1
        assert len(chain.applied) == 1
        await asyncio.sleep(0.2)
        assert chain.far_end.sent()[-1].is_silent
