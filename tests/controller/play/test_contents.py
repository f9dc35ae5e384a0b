"""Contents of several fingers: their layers, the limits of the amplifiers, and those not served."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from controller.play.chooser import Chooser
from controller.play.intent import FingerTarget, HapticIntent, Pulse, Target
from controller.play.layers import CROSSFADE, LayerAllocation, Slot, SlotPhase
from controller.play.selected_contents import Content, ContentKey, Selection
from controller.play.selection import Selector
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.play.slots import Slots
from controller.sources.touch import Contact, ContactKey
from kit.clock import in_virtual_time
from kit.fingers import playable
from kit.fingers import table as paper_table
from kit.plates import smooth_rig
from model.answer.answer import Layer
from model.answer.answer_report import Timing
from model.answer.stimulus import Placement
from model.arrays import FloatArray
from model.vibration import Tone
from tests.controller.play.fingers_on_layouts import ABOVE, LEFT, RIGHT, choose_for


def contacts_at(*positions: tuple[float, float]) -> list[Contact]:
    """Contacts at rest."""
    return [
        Contact(ContactKey("a", number), x, y, since=0.0) for number, (x, y) in enumerate(positions)
    ]


CONTACTS = contacts_at(LEFT, RIGHT)
FIRST, SECOND = CONTACTS[0].key, CONTACTS[1].key
CLICK = Target(SECOND, 20.0, pulse=Pulse(0.04, requested_at=0.0))
FREE = playable()
"""Amplifiers that do not limit these contents."""


def content_of(*contacts: Contact, frequency: float = 100.0, pulse: Pulse | None = None) -> Content:
    """A content whose fingers feel 14 dB SL of one tone."""
    targets = tuple(
        FingerTarget(contact, Target(contact.key, 14.0, pulse=pulse)) for contact in contacts
    )
    layer = Layer({"SW": Tone(frequency, 1e-6)})
    return Content(ContentKey(contacts[0].key, 0), targets, Placement((LEFT,)), layer)


def slots_of(layers: int, expiry: float) -> Slots:
    """Slots of amplifiers with so many layers, whose contents expire at a time [s]."""

    def expiry_of(key: ContactKey) -> float:
        return expiry

    return Slots(smooth_rig(), playable(layers), Timing(paper_table()), expiry_of=expiry_of)


def test_shared_content_that_changes_during_a_click_of_its_finger_keeps_its_layer() -> None:
    """The click has begun first: the next decision restarts neither of the two."""
    lasting = content_of(*CONTACTS)
    click = content_of(CONTACTS[0], pulse=Pulse(0.04, requested_at=0.0))
    slots = slots_of(4, expiry=0.0)
    active = {1: Slot(click, click.layer), 0: Slot(lasting, lasting.layer)}
    slots.layers.take(active, {0})

    assert slots.layers.allocate([lasting, click]) == {0: lasting, 1: click}
    assert not slots.plan([lasting, click], 0.0).started


def test_slots_change_only_when_a_plan_is_adopted() -> None:
    """Planning a start and a silence leaves all layers as they are; silence is planned once."""
    content = content_of(CONTACTS[0])
    slots = slots_of(4, expiry=10.0)

    start = slots.plan([content], 0.0)
    assert (slots.by_layer, slots.layers.may_play) == ({}, frozenset())
    slots.adopt(start, 0.0)
    assert slots.by_layer[0].phase is SlotPhase.STARTING

    silence = slots.silence(0.01)
    assert slots.by_layer[0].content == content
    slots.adopt(silence, 0.1)
    assert (slots.by_layer, slots.layers.may_play) == ({}, {0})  # until it is confirmed
    assert slots.silence(0.01).is_empty


def test_replacement_that_was_dropped_still_fades_when_it_is_tried_again() -> None:
    """The former content continues in its layer, which is its finger's again.

    If the ledger refuses its fall until 1.1 s, the fall is sent then, so the two do not sound
    together.
    """
    former = content_of(CONTACTS[0])
    successor = replace(content_of(CONTACTS[0], frequency=150.0), is_led=True)
    layers = LayerAllocation(4)
    active = {0: Slot(former, former.layer)}
    layers.take(active, {0})
    assert layers.allocate([successor]) == {1: successor}
    falling = active[0].falling(1.0)
    layers.take({0: falling, 1: Slot(successor, successor.layer)}, {1})

    layers.reset(active)
    assert layers.allocate([successor]) == {2: successor}
    assert layers.fade_time(2, successor) == CROSSFADE
    falling.put_off(1.1, is_update=True)
    assert falling.update_due == 1.1


def choose(capabilities: PlaybackCapabilities, *targets: Target) -> Selection:
    """The selection for both fingers."""
    return choose_for(list(zip(CONTACTS, targets, strict=True)), capabilities)


def select(capabilities: PlaybackCapabilities, *targets: Target) -> Selection:
    """The selection of a new selector for both fingers."""
    selector = Selector(Chooser(paper_table()))
    return selector.select(CONTACTS, HapticIntent(targets), capabilities)


def total_levels(selection: Selection) -> FloatArray:
    """Sum of the levels of all contents at each ERA (eras,)."""
    totals = []
    for era in paper_table().eras:
        strokes = [content.layer.excitation[era.name].amplitude for content in selection.contents]
        totals.append(sum(strokes) / era.stroke)
    return np.array(totals)


def total_power(selection: Selection) -> float:
    """The power of all contents, in powers of a channel at full stroke."""
    return float(np.sum(total_levels(selection) ** 2))


def within(*, level: float = 1.0, power: float = np.inf) -> PlaybackCapabilities:
    """Amplifiers that play a share of each stroke, and so much power."""
    amplitudes = {era.name: level * era.stroke for era in paper_table().eras}
    return replace(FREE, limits=replace(FREE.limits, amplitudes=amplitudes, power=power))


def limit_to_80_percent(selection: Selection, limit: str) -> PlaybackCapabilities:
    """Amplifiers with 80 % of the level of contents, or with the power of 80 %."""
    if limit == "power":
        return within(level=0.5, power=total_power(selection) * 0.8**2)
    return within(level=0.8 * total_levels(selection).max())


def used_share(selection: Selection, capabilities: PlaybackCapabilities) -> float:
    """The share of the tightest limit that contents take, as an amplitude."""
    limits = capabilities.limits
    era = paper_table().eras[0]
    level = limits.amplitudes[era.name] / era.stroke
    share_of_level = total_levels(selection).max() / level
    share_of_power = np.sqrt(total_power(selection) / limits.power)
    return float(max(share_of_level, share_of_power))


ALMOST_ALL = pytest.approx(0.975, abs=0.025 + 1e-6)


@pytest.mark.parametrize("limit", ["level", "power"])
@pytest.mark.parametrize("modulation", [None, 20.0])
def test_higher_priority_keeps_its_level_within_a_limit(
    limit: str, modulation: float | None
) -> None:
    """The other content is lowered alone, modulated or not, and its promise with it."""
    targets = (
        Target(FIRST, 14.0, priority=1),
        Target(SECOND, 14.0, modulation_hz=modulation),
    )
    free = choose(FREE, *targets)
    capabilities = limit_to_80_percent(free, limit)

    limited = choose(capabilities, *targets)

    preferred, lowered = limited.finger_sensations
    assert preferred.level_db_sl == pytest.approx(14.0, abs=0.2)
    assert lowered.level_db_sl < 13.0
    assert used_share(limited, capabilities) == ALMOST_ALL
    free_promise = free.finger_sensations[1].sensation.promised_contrast_db
    change = lowered.sensation.promised_contrast_db - free_promise
    assert change == pytest.approx(lowered.level_db_sl - 14.0, abs=1.0)


def test_content_that_is_lowered_too_far_is_held_back() -> None:
    """What the first content leaves of the amplifiers' level is not enough for the second."""
    targets = Target(FIRST, 14.0, priority=1), Target(SECOND, 14.0)
    free = choose(FREE, *targets)
    level = total_levels(replace(free, contents=free.contents[:1])).max()

    limited = choose(within(level=1.02 * level), *targets)

    preferred, held_back = limited.finger_sensations
    assert preferred.level_db_sl == pytest.approx(14.0, abs=0.3)
    assert held_back.sensation.verdict == "held back"
    assert held_back.held_back


@pytest.mark.parametrize("limit", ["level", "power"])
def test_louder_content_of_equal_priority_is_lowered(limit: str) -> None:
    """Max-min: the softer content keeps its level as long as the louder one is above it."""
    targets = Target(FIRST, 14.0), Target(SECOND, 8.0)
    capabilities = limit_to_80_percent(choose(FREE, *targets), limit)

    limited = choose(capabilities, *targets)

    louder, softer = [sensation.level_db_sl for sensation in limited.finger_sensations]
    assert softer == pytest.approx(8.0, abs=0.2)
    assert 8.0 < louder < 13.5
    assert used_share(limited, capabilities) == ALMOST_ALL


@pytest.mark.parametrize(("share", "count"), [(1.3, 2), (1.001, 1)])
def test_click_stays_within_the_power_that_a_continuous_content_leaves(
    share: float, count: int
) -> None:
    """Together they take no more than the limit; with hardly any left the click is held back."""
    lasting = Target(FIRST, 20.0)
    free = select(FREE, lasting, CLICK)
    lasting_power = total_power(replace(free, contents=free.contents[:1]))
    power = share**2 * lasting_power
    assert total_power(free) > power

    limited = select(within(power=power), lasting, CLICK)

    assert len(limited.contents) == count
    assert total_power(limited) <= power * (1 + 1e-6)
    reasons = [unserved.held_back for unserved in limited.unserved]
    assert len(reasons) == 2 - count
    if reasons:
        assert "lift a finger" in (reasons[0] or "")


def test_content_for_which_a_click_leaves_nothing_has_a_reason_and_plays_after_it() -> None:
    """The limits are no cause: without the click they allow it."""
    lasting = Target(FIRST, 20.0)
    capabilities = within(power=1.002 * total_power(select(FREE, CLICK)))
    selector = Selector(Chooser(paper_table()))

    selector.select(CONTACTS, HapticIntent((CLICK,)), capabilities, now=0.0)
    together = selector.select(CONTACTS, HapticIntent((lasting, CLICK)), capabilities, now=0.01)
    (unserved,) = together.unserved
    assert unserved.contact == CONTACTS[0]
    assert "vibrations of other fingers" in (unserved.held_back or "")

    later = selector.select(CONTACTS, HapticIntent((lasting,)), capabilities, now=selector.due)
    assert later.unserved == ()
    assert len(later.contents) == 1


@in_virtual_time
async def test_shared_content_stays_weak_while_its_weakest_finger_feels_a_click() -> None:
    """One of five fingers has 20 dB less: so has the shared vibration, also amid its click."""
    contacts = contacts_at(*((0.05 + 0.02 * number, 0.05) for number in range(5)))
    lasting = [Target(contact.key, 14.0, content="buzz") for contact in contacts]
    click = replace(lasting[0], pulse=Pulse(0.04, 1.0), content="click")
    selector = Selector(Chooser(paper_table()))

    gains_of_contents = []
    for targets in (lasting, lasting, [*lasting, click]):
        gains = {(target.key, target.is_short): 0.0 for target in targets}
        gains[contacts[0].key, False] = -20.0
        gains[contacts[0].key, True] = -20.0
        intent = HapticIntent(tuple(targets))
        selection = selector.select(contacts, intent, playable(), now=1.0).weakened(gains)
        gains_of_contents.append([content.gain_db for content in selection.contents])
        await asyncio.sleep(0.1)  # lets the thread choose
    assert gains_of_contents[1:] == [[-20.0], [-20.0, -20.0]]


def test_content_that_another_fingers_contrast_holds_back_has_that_reason() -> None:
    """In one narrow band the first would have 3 dB of contrast with it; it has 16 itself."""
    contacts = contacts_at((0.06, 0.06), (0.2, 0.1))
    targets = [(contact, Target(contact.key, 20.0, band=(99.0, 101.0))) for contact in contacts]
    (unserved,) = choose_for(targets, playable(4)).unserved
    assert (unserved.sensation.promised_contrast_db or 0.0) > 12
    assert "another finger" in (unserved.held_back or "")


def phase_at(content: Content, fields: Sequence[complex]) -> float:
    """The phase of a content at a finger, by the field of each ERA at full stroke there."""
    tones = content.layer.excitation
    drives = [
        tones[era.name].phasor / era.stroke if era.name in tones else 0.0
        for era in paper_table().eras
    ]
    return float(np.angle(np.dot(drives, fields)))


def test_kept_frequency_keeps_its_phase_at_the_finger() -> None:
    """The finger moves by 1 cm and another joins: by the fields of the table at its new place."""
    targets = [(contact, Target(contact.key, 14.0)) for contact in CONTACTS]
    former = {content.key: content for content in choose_for(targets, playable(4)).contents}
    moved = replace(CONTACTS[0], x=CONTACTS[0].x + 0.01)
    third = Contact(ContactKey("a", 2), *ABOVE, since=0.0)
    joined = [(moved, targets[0][1]), targets[1], (third, Target(third.key, 14.0))]

    selection = choose_for(joined, playable(4), playing=former)

    positions = [(contact.x, contact.y) for contact, _ in joined]
    fields = paper_table().unit_fields(np.array(positions), contacts=positions)
    kept_count = 0
    for content in selection.contents:
        predecessor = former.get(content.key)
        if predecessor is None or predecessor.frequency != content.frequency:
            continue
        position = (content.contact.x, content.contact.y)
        (row,) = np.flatnonzero(paper_table().frequencies == content.frequency)
        at_finger = fields[row, :, positions.index(position)]
        phases = [phase_at(voice, at_finger) for voice in (content, predecessor)]
        assert phases[0] == pytest.approx(phases[1], abs=1e-3)
        kept_count += 1
    assert kept_count >= 1
