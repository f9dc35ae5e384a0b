"""Questions to the table for an intent, and when a pattern is selected again."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import pytest

from controller.play.capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.play.chooser import Chooser
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.selection import Selector
from controller.play.table_query import strongest
from controller.sources.contacts import Contact, ContactKey
from model.answer.pattern import Pattern
from model.answer.question import Question
from model.errors import InputError
from model.finger.perception import DEFAULT_THRESHOLD
from model.structure.plate import Material, Plate
from model.table.table import LocalizationTable
from model.vibration.excitation import Tone
from set_table import SetLevels
from small_table import small_table

CAPABILITIES = PlaybackCapabilities(
    "phased", ("switched", "phased"), (45.0, 300.0), {"SW": 1e-4}, RAMPS_ONLY
)


class Table:
    """A table that records its questions, and refuses targets left of `refuse_below`."""

    plate = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))
    frequencies = np.array([100.0])
    strokes: Mapping[str, float] = MappingProxyType({"SW": 1e-4})

    def __init__(self) -> None:
        self.asked: list[Question] = []
        self.refuse_below = 0.0
        self.most = math.inf
        self.threshold = DEFAULT_THRESHOLD
        self.error: Exception | None = None
        self.quiet_level: float | None = None

    def prepare(self, mode: str) -> None:
        """Do nothing."""

    def query(self, question: Question, over_effect: object = None) -> Pattern:
        """A pattern that names its question."""
        self.asked.append(question)
        if self.error is not None:
            raise self.error
        if question.targets[0][0] < self.refuse_below:
            raise InputError("nothing is felt there")
        if question.level_db_sl > self.most:
            raise InputError("too loud")
        tone = Tone(100.0 + len(self.asked), 1e-6)
        return Pattern({"SW": tone}, 0.02, question.level_db_sl, None, self.quiet_level)


def wanting(**levels: float | None) -> HapticIntent:
    """An intent for contacts c1, c2 and so on, at their levels, be they on the plate or not."""
    targets = (Target(ContactKey("a", int(name[1:])), each) for name, each in levels.items())
    return HapticIntent(tuple(targets), "nothing is wanted")


def at(id: int, x: float, y: float = 0.1) -> Contact:
    """A contact."""
    return Contact(ContactKey("a", id), x, y, since=0.0)


def selector_of(table: Table | LocalizationTable) -> Selector:
    """A selector by a table."""
    return Selector(Chooser(table, SetLevels()))  # type: ignore[arg-type]


@pytest.fixture
def table() -> Table:
    """A table that refuses nothing."""
    return Table()


def test_selector_keeps_other_contacts_quiet(table: Table) -> None:
    """The question has the target's level, and drive modes and band of the amplifiers."""
    contacts = (at(1, 0.1), at(2, 0.2), at(3, 0.25))
    shaped = replace(CAPABILITIES, envelope_support=replace(RAMPS_ONLY, onset_knots=20))
    selector_of(table).select(contacts, wanting(c3=17.0), shaped)
    assert table.asked.pop().envelopes
    selection = selector_of(table).select(contacts, wanting(c3=17.0), CAPABILITIES)
    (question,) = table.asked
    assert (question.targets, question.quiet) == (((0.25, 0.1),), ((0.1, 0.1), (0.2, 0.1)))
    assert (question.level_db_sl, question.drive_mode) == (17.0, "phased")
    assert (question.playable, question.frequencies) == (("switched", "phased"), (45.0, 300.0))
    assert not question.envelopes
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
    assert table.asked[0].frequencies == asked


def test_selector_scales_to_what_the_neighbours_allow(table: Table) -> None:
    """Queried at 12 dB SL; with 14 dB less at the quiet finger, -10 dB there leave 4 here."""
    table.quiet_level = -2.0
    selection = selector_of(table).select((at(1, 0.1), at(2, 0.2)), wanting(c1=None), CAPABILITIES)
    assert table.asked[0].level_db_sl == 12.0
    (content,) = selection.contents
    assert selection.predictions[0].level_db_sl == pytest.approx(4.0)
    assert content.pattern.quiet_level_db_sl == pytest.approx(-10.0)
    assert content.pattern.excitation["SW"].amplitude == pytest.approx(1e-6 * 10 ** (-8 / 20))


@pytest.mark.parametrize(
    ("quiet", "largest", "level"),
    [
        (-40.0, 1.0, 26.0),
        (None, 1.0, 26.0),
        (-40.0, 2e-6, 12 + 20 * math.log10(2)),
    ],
)
def test_strongest_is_bounded_by_level_and_stroke(
    quiet: float | None, largest: float, level: float
) -> None:
    """Twice a strong vibration, or the full stroke; without neighbours too."""
    pattern = Pattern({"SW": Tone(100.0, 1e-6)}, 0.02, 12.0, None, quiet)
    found = strongest(pattern, {"SW": largest})
    assert found.level_db_sl == pytest.approx(level)
    gain = 10 ** ((level - 12.0) / 20)
    assert found.excitation["SW"].amplitude == pytest.approx(1e-6 * gain)


def test_strongest_refuses_less_than_10_db_of_contrast() -> None:
    """Nothing would be felt at the target alone."""
    pattern = Pattern({"SW": Tone(100.0, 1e-6)}, 0.02, 12.0, None, 3.0)
    with pytest.raises(InputError):
        strongest(pattern, {"SW": 1.0})


def allow_weaker(level: float) -> HapticIntent:
    """One level at contact 1, or less where the plate cannot reach it."""
    return HapticIntent((Target(ContactKey("a", 1), level, allow_weaker=True),))


def test_selector_saturates_a_level_or_less(table: Table) -> None:
    """As strong as neighbours and stroke allow, and never above the level.

    12 dB SL at 1 um, a stroke of 2 um: 6 dB more; at the quiet finger there are -17 dB, 7 dB less
    than allowed.
    """
    table.most, table.quiet_level = 15.0, -17.0
    capabilities = replace(CAPABILITIES, max_amplitudes={"SW": 2e-6})
    contacts = (at(1, 0.1), at(2, 0.2))
    for wanted, level in ((14.0, 14.0), (30.0, 12 + 20 * math.log10(2)), (17.0, 17.0)):
        selection = selector_of(table).select(contacts, allow_weaker(wanted), capabilities)
        (content,) = selection.contents
        assert selection.predictions[0].level_db_sl == pytest.approx(level)
        assert content.question is table.asked[-1]
    table.most = 11.0
    selection = selector_of(table).select(contacts, allow_weaker(30.0), capabilities)
    assert (selection.contents, selection.reason) == ((), "too loud")


def test_selector_saturates_at_full_stroke_on_a_plate() -> None:
    """60 dB SL is more than the ERAs of the paper reach."""
    table, full = small_table(), dict.fromkeys(("SW", "SE", "NE", "NW"), 0.0001)
    capabilities = PlaybackCapabilities("switched", ("switched",), (40.0, 500.0), full, RAMPS_ONLY)
    selection = selector_of(table).select((at(1, 0.1),), allow_weaker(60.0), capabilities)
    (content,) = selection.contents
    assert 12 < selection.predictions[0].level_db_sl < 60
    loudest = max(tone.amplitude for tone in content.pattern.excitation.values())
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
BAND, ALONE = (45.0, 300.0), (100.0, 100.0)
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
        Chosen((ONE, TWO), wanting(c2=20.0), True, loads=()),
        Chosen((loaded(ONE, 1.6), TWO), wanting(c2=20.0), True, loads=(1.0, 1.6)),
        Chosen((loaded(ONE, 1.6), TWO), wanting(c2=20.0), False),
        Chosen((loaded(ONE, 1.6), loaded(TWO, 2.4)), wanting(c2=20.0), True, loads=(2.4, 1.6)),
        Chosen((ONE, TWO), wanting(c2=20.0), True, loads=()),
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
        for wanted, found in ((step.loads, "loads"), (step.frequencies, "frequencies")):
            assert wanted in (None, *(getattr(one.question, found) for one in chosen.contents)), (
                step
            )
        before = chosen


def test_a_pulse_is_held_back_where_others_use_the_whole_stroke(table: Table) -> None:
    """Beside 1 µm of 1 µm nothing is left of its stroke: it is said, not played at level zero."""
    pulse = Target(ContactKey("a", 2), 12.0, pulse=Pulse(0.03, requested_at=0.0))
    intent = HapticIntent((Target(ContactKey("a", 1), 12.0), pulse))
    full = replace(CAPABILITIES, max_amplitudes={"SW": 1e-6}, layers=2)
    selection = selector_of(table).select((at(1, 0.1), at(2, 0.2)), intent, full)
    assert [each.targets[0][0].key.id for each in selection.contents] == [1]
    (held,) = selection.not_served
    assert held.held_back == "the contents of other fingers use the whole stroke; lift a finger"


@pytest.mark.parametrize(("since", "left"), [(0.0, 0.6e-6), (0.02, 0.6e-6), (0.5, 1e-6)])
def test_a_click_leaves_what_another_drives_until_that_has_ended(
    table: Table, since: float, left: float
) -> None:
    """Of 1.6 µm, of which each would take 1 µm: at once, while the first plays, and after it."""
    limits = replace(CAPABILITIES, max_amplitudes={"SW": 1.6e-6}, layers=2)
    selector, contacts = selector_of(table), (at(1, 0.1), at(2, 0.2))
    first, second = (
        Target(ContactKey("a", id), 12.0, pulse=Pulse(0.03, requested_at=requested_at))
        for id, requested_at in ((1, 0.0), (2, since))
    )
    if since:
        selector.select(contacts[:1], HapticIntent((first,)), limits, now=0.0)
    both = HapticIntent((first, second))
    selection = selector.select(contacts, both, limits, now=since)
    amplitudes = [each.pattern.excitation["SW"].amplitude for each in selection.contents]
    assert amplitudes == pytest.approx([1e-6, left])
    assert selection.predictions[1].level_db_sl == pytest.approx(12 + 20 * math.log10(left / 1e-6))


@pytest.mark.parametrize(
    ("until", "due"), [(None, math.inf), (7.0, 7.0), (3.0, 5.001), (math.nan, 5.001)]
)
def test_due_of_an_expired_intent_is_later(until: float | None, due: float) -> None:
    """So that it does not keep the loop busy."""
    assert HapticIntent((), until=until).due(5.0) == due
