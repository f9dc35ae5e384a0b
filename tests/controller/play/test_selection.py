"""Selection of patterns: queries for an intent, when one is selected again, and how long it plays.

Vibrations in virtual time follow envelopes, are renewed while their contacts are confirmed, and end
after a tap.
"""

import asyncio
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import pytest

from chain import FINGER, Chain, Sent, set_running
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.routing import RAMPS_ONLY, PlaybackCapabilities
from controller.play.selection import Chooser, Selector
from controller.sources.touch import Change, Contact, ContactKey, ContactTracker
from drivers.protocol.definition import QUANTITIES
from model.answer.answer import Answer, Limits
from model.answer.stimulus import Finger, Stimulus
from model.errors import InputError
from model.structure.material import Material
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.vibration import Excitation, Tone
from plates import small_table
from registry.limits import HAND_LOAD
from set_table import set_answer
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


FULL = 0.2  # the level that the table's pattern has


def valid_for(one: Sent) -> float:
    """How long a set lasts without another [s], 0 for ever."""
    return QUANTITIES["valid_for"].from_wire(one.layer.valid_for)


def sets(chain: Chain) -> list[Sent]:
    """Every set since the silence that follows arming."""
    return chain.far_end.sent()[1:]


def level(chain: Chain, channel: int = 0) -> float:
    """What a channel plays now."""
    return chain.far_end.levels[channel]


def vibrations(chain: Chain) -> list[tuple[float, Sent]]:
    """When each set that vibrates was sent [s], and the set."""
    return [(each.time, each) for each in chain.far_end.sent() if not each.is_silent]


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
