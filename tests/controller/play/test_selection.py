"""A selector asks a table for an intent, and again when it must; what each finger then feels."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from controller.effects.layout import SurfaceLayout, default_effects
from controller.play.chooser import Chooser
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.selected_contents import Selection, beside_others, judged, sums_db
from controller.play.selection import Selector
from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from kit.clock import in_virtual_time
from kit.fingers import table as paper_table
from kit.set_table import set_answer
from model.answer.answer import Answer, Limits, Sensation
from model.answer.stimulus import Finger, Stimulus
from model.errors import InputError
from model.structure.material import Material
from model.structure.plate import Plate
from model.vibration import Excitation, Tone
from tests.controller.play.fingers_on_layouts import LAYOUT, LEFT, RIGHT, fingers_on

CAPABILITIES = PlaybackCapabilities(
    "phased", ("switched", "phased"), Limits((45.0, 300.0), {"SW": 1e-4}), RAMPS_ONLY
)
REFUSED = "nothing is felt there"


class RecordingTable:
    """A table that records its questions, and refuses targets left of `refuse_below`."""

    plate = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))
    frequencies = np.array([100.0])
    full_levels: Mapping[str, float] = MappingProxyType({"SW": 1e-4})

    def __init__(self) -> None:
        self.questions: list[list[Finger]] = []
        """The fingers of each question."""
        self.refuse_below = 0.0
        """Targets left of this x [m] are refused."""
        self.error: Exception | None = None
        """What each answer raises."""

    def excursion_of(self, drives: Sequence[Any]) -> float:
        """An ERA has no magnet."""
        return 0.0

    def prepare(self, mode: str) -> None:
        """Do nothing."""

    def levels_by_set(self, level_db_sl: float, excitation: Excitation) -> list[float]:
        """Return the level by the only set of thresholds."""
        return [level_db_sl]

    def answer(self, fingers: Sequence[Finger], **options: Any) -> Answer:
        """Return the requested level at 100 Hz and as many as there have been questions."""
        self.questions.append([*fingers])
        if self.error is not None:
            raise self.error
        if fingers[0].at[0] < self.refuse_below:
            raise InputError(REFUSED)
        (stimulus,) = [finger.stimulus for finger in fingers if finger.stimulus is not None]
        tone = Tone(100.0 + len(self.questions), 1e-6)
        return set_answer(
            fingers,
            {"SW": tone},
            level_db_sl=stimulus.level_db_sl,
            drive_mode=options["drive_mode"],
            limits=options["limits"],
        )


class SelectorDialogue:
    """A selector, its recording table, and its choices."""

    def __init__(self) -> None:
        self.table = RecordingTable()
        self.selector = Selector(Chooser(self.table))  # type: ignore[arg-type]
        self.choices: list[Selection] = []

    def select(self, intent: HapticIntent, *contacts: Contact) -> Selection:
        """Select contents for contacts."""
        choice = self.selector.select(contacts, intent, CAPABILITIES)
        self.choices.append(choice)
        return choice

    def must_ask(self, intent: HapticIntent, *contacts: Contact) -> list[Finger]:
        """Require that the selector asks the table for this; return the question."""
        count = len(self.table.questions)
        self.select(intent, *contacts)
        assert len(self.table.questions) == count + 1
        return self.table.questions[-1]

    def must_keep(self, intent: HapticIntent, *contacts: Contact) -> None:
        """Require that the selector keeps its last choice without a question."""
        count = len(self.table.questions)
        former = self.choices[-1]
        choice = self.select(intent, *contacts)
        assert len(self.table.questions) == count
        assert choice is former


def contact_at(id: int, x: float, y: float = 0.1, load: float = 1.0) -> Contact:
    """A contact on the plate [m]."""
    return Contact(ContactKey("a", id), x, y, since=0.0, load=load)


def target(id: int, level_db_sl: float = 20.0, pulse: Pulse | None = None) -> Target:
    """A target at the contact of an id."""
    return Target(ContactKey("a", id), level_db_sl, pulse=pulse)


def wanting(*targets: Target) -> HapticIntent:
    """An intent with these targets."""
    return HapticIntent(targets, "nothing is wanted")


FIRST = contact_at(1, 0.1)
SECOND = contact_at(2, 0.2)
FELT_BY_FIRST = wanting(target(1))
FELT_BY_SECOND = wanting(target(2))


def test_selector_asks_again_for_another_level_at_the_active_frequency_first() -> None:
    """Another target is asked for in the whole band."""
    dialogue = SelectorDialogue()
    weaker = wanting(target(1, 14.0))

    (finger, _) = dialogue.must_ask(FELT_BY_FIRST, FIRST, SECOND)
    assert finger.stimulus is not None
    assert finger.stimulus.band_hz == (45.0, 300.0)
    dialogue.must_keep(FELT_BY_FIRST, FIRST, SECOND)
    (finger, _) = dialogue.must_ask(weaker, FIRST, SECOND)
    assert finger.stimulus is not None
    assert finger.stimulus.band_hz == (101.0, 101.0)
    dialogue.must_keep(weaker, FIRST, SECOND)
    dialogue.must_ask(wanting(target(2, 14.0)), FIRST, SECOND)


def test_selector_keeps_its_choice_when_a_quiet_contact_lifts() -> None:
    """A change would be felt at the target."""
    dialogue = SelectorDialogue()
    dialogue.must_ask(FELT_BY_SECOND, FIRST, SECOND)
    dialogue.must_keep(FELT_BY_SECOND, SECOND)


def test_selector_asks_again_after_a_refusal_when_contacts_change() -> None:
    """Without the quiet finger it might be possible; the reason for silence is the table's."""
    dialogue = SelectorDialogue()
    dialogue.table.refuse_below = 0.2
    refused = contact_at(2, 0.1)
    quiet = contact_at(1, 0.25)

    dialogue.must_ask(FELT_BY_SECOND, quiet, refused)
    assert dialogue.choices[-1].reason == REFUSED
    dialogue.must_keep(FELT_BY_SECOND, quiet, refused)
    dialogue.must_ask(FELT_BY_SECOND, refused)
    assert dialogue.choices[-1].reason == REFUSED
    dialogue.must_ask(FELT_BY_SECOND, contact_at(2, 0.21))
    assert len(dialogue.choices[-1].contents) == 1


def with_stroke(stroke: float) -> PlaybackCapabilities:
    """Amplifiers with two layers and a stroke of the only ERA [m]."""
    return replace(CAPABILITIES, limits=Limits((45.0, 300.0), {"SW": stroke}), layers=2)


@pytest.mark.parametrize(("since", "amplitude"), [(0.0, 0.6e-6), (0.02, 0.6e-6), (0.5, 1e-6)])
def test_click_takes_the_stroke_that_another_click_leaves_until_its_end(
    since: float, amplitude: float
) -> None:
    """Of 1.6 µm each would take 1 µm: simultaneously, during the first, and after its end."""
    selector = SelectorDialogue().selector
    capabilities = with_stroke(1.6e-6)
    first = target(1, 12.0, Pulse(0.03, requested_at=0.0))
    second = target(2, 12.0, Pulse(0.03, requested_at=since))
    if since:
        selector.select((FIRST,), HapticIntent((first,)), capabilities, now=0.0)

    intent = HapticIntent((first, second))
    selection = selector.select((FIRST, SECOND), intent, capabilities, now=since)

    amplitudes = [content.layer.excitation["SW"].amplitude for content in selection.contents]
    assert amplitudes == pytest.approx([1e-6, amplitude])
    level = 12 + 20 * math.log10(amplitude / 1e-6)
    assert selection.finger_sensations[1].level_db_sl == pytest.approx(level)


@pytest.mark.parametrize(
    ("until", "due"), [(math.inf, math.inf), (7.0, 7.0), (3.0, 5.001), (math.nan, 5.001)]
)
def test_expired_intent_is_due_later(until: float, due: float) -> None:
    """Otherwise it would keep the loop busy."""
    assert HapticIntent((), until=until).due(5.0) == due


def sensation(
    *, verdict: str = "own", contrast: float | None = None, crosstalk: tuple[float, ...] = ()
) -> Sensation:
    """A sensation of 20 dB SL."""
    return Sensation(
        Finger((0.1, 0.1), Stimulus(20.0)),
        verdict,
        layer=0,
        promised_level_db_sl=20.0,
        promised_contrast_db=contrast,
        foreign_levels_db_sl=crosstalk,
    )


@pytest.mark.parametrize(
    ("contrast", "foreign", "expected", "total", "verdict"),
    [
        (14.0, 5.0, 20 - 10 * math.log10(10**0.6 + 10**0.6), 8.539, "mixed"),
        (None, None, 14.0, 6.0, "own"),
        (11.0, None, 11.0, 6.0, "mixed"),
    ],
)
def test_powers_of_other_contents_add(
    contrast: float | None, foreign: float | None, expected: float, total: float, verdict: str
) -> None:
    """6 dB SL are added to 6 dB SL from which a contrast of 14 dB results, to 5, and to none."""
    crosstalk = () if foreign is None else (foreign,)
    former_verdict = "mixed" if contrast == 11 else "own"
    alone = sensation(verdict=former_verdict, contrast=contrast, crosstalk=crosstalk)
    foreign_levels = sums_db([[6.0], [-math.inf if foreign is None else foreign]])

    together = judged(beside_others(alone, [6.0], foreign_levels), is_apart=True)

    assert together.promised_contrast_db == pytest.approx(expected, abs=1e-3)
    assert together.foreign_level_db_sl == pytest.approx(total, abs=1e-3)
    assert together.verdict == verdict


def power(level_db: float | None) -> float:
    """The power of a level [dB], of 0 dB without one."""
    return float(10 ** ((level_db or 0.0) / 10))


@in_virtual_time
async def test_click_changes_the_report_for_its_neighbor_only_meanwhile() -> None:
    """Any crosstalk of 40 ms is weaker than it on this plate; the contrast follows by powers."""
    effects = {**default_effects(), **LAYOUT.effects}
    layout = SurfaceLayout(LAYOUT.regions, effects, elsewhere=None)
    async with fingers_on(paper_table(), layout, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        first_report = len(fingers.applied) - 1
        fingers.play("click")
        await fingers.hold(0.3)

    neighbors = [
        {target.contact.key.id: target for target in report.targets}[2]
        for report in fingers.applied[first_report:]
    ]
    former, meanwhile, later = neighbors
    assert later == former
    assert (meanwhile.level_db_sl, meanwhile.frequency) == (former.level_db_sl, former.frequency)

    level = power(former.level_db_sl)
    crosstalk = power(former.sensation.foreign_level_db_sl)
    total = power(meanwhile.sensation.foreign_level_db_sl)
    assert total > 2 * crosstalk
    noise = level / power(former.sensation.promised_contrast_db) + total - crosstalk
    contrast = meanwhile.sensation.promised_contrast_db
    assert contrast == pytest.approx(10 * math.log10(level / noise), abs=1e-6)
    assert meanwhile.sensation.verdict == ("own" if contrast >= 12 else "mixed")
