"""Limits of amplifiers over several contents: who is lowered, and that the sum is within."""

from dataclasses import replace

import numpy as np
import pytest

from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.layer_contents import Selection
from controller.play.routing import PlaybackCapabilities
from controller.play.selection import Chooser, Selector
from controller.sources.touch import Contact, ContactKey
from several_fingers import LEFT, RIGHT, chosen_for, playable, table

CONTACTS = [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate((LEFT, RIGHT))]
FREE = playable()


def a_selector() -> Selector:
    """One that has chosen nothing yet."""
    return Selector(Chooser(table()))


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
    assert limits.amplitudes is not None
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
    kept, lowered = found.predictions
    assert kept.level_db_sl == pytest.approx(14.0, abs=0.2)
    assert lowered.level_db_sl is not None
    assert lowered.level_db_sl < 13.0
    assert is_used(found, capabilities)
    before = free.predictions[1].promised_contrast_db
    assert before is not None
    assert lowered.promised_contrast_db is not None
    change = lowered.promised_contrast_db - before
    assert change == pytest.approx(lowered.level_db_sl - 14.0, abs=1.0)


def test_who_is_lowered_too_far_is_held_back_by_the_rule() -> None:
    """What the first content leaves of the amplifiers' level is not enough for the second."""
    first, second = Target(CONTACTS[0].key, 14.0, priority=1), Target(CONTACTS[1].key, 14.0)
    content, _ = chosen(FREE, first, second).contents
    most = max(content.layer.excitation[each.name].amplitude / each.stroke for each in table().eras)
    found = chosen(within(most=1.02 * most), first, second)
    kept, held_back = found.predictions
    assert kept.level_db_sl == pytest.approx(14.0, abs=0.3)
    assert held_back.verdict == "held back"
    assert held_back.held_back


def test_contents_that_a_limit_leaves_unfelt_are_held_back() -> None:
    """With 40 dB less than 14 dB SL takes; a level below 0 dB SL from the start is kept."""
    wanted = [Target(each.key, 14.0) for each in CONTACTS]
    most = 0.01 * sums(chosen(FREE, *wanted)).max()
    found = chosen(within(most=most), *wanted)
    assert found.contents == ()
    assert all(
        "the limits of the amplifiers" in (each.held_back or "") for each in found.not_served
    )
    assert len(found.not_served) == 2
    quiet = chosen(FREE, *(replace(each, level_db_sl=-10.0) for each in wanted))
    assert len(quiet.contents) == 2


@pytest.mark.parametrize("what", ["level", "power"])
def test_of_equal_priority_the_louder_content_is_lowered(what: str) -> None:
    """Max-min: the softer one keeps its level as long as the louder one is above it."""
    targets = Target(CONTACTS[0].key, 14.0), Target(CONTACTS[1].key, 8.0)
    capabilities = limited(chosen(FREE, *targets), what)
    found = chosen(capabilities, *targets)
    louder, softer = (each.level_db_sl for each in found.predictions)
    assert softer == pytest.approx(8.0, abs=0.2)
    assert louder is not None
    assert 8.0 < louder < 13.5
    assert is_used(found, capabilities)


def test_a_click_is_within_the_power_that_what_lasts_leaves() -> None:
    """Both at once take no more than the limit; with hardly any left it is held back."""
    click = Target(CONTACTS[1].key, 20.0, pulse=Pulse(0.04, requested_at=0.0))
    intent = HapticIntent((Target(CONTACTS[0].key, 20.0), click))
    selector = a_selector()
    free = selector.select(CONTACTS, intent, FREE)
    lasting = np.linalg.norm(sums(replace(free, contents=free.contents[:1])))
    for share, count in ((1.3, 2), (1.001, 1)):
        capabilities = within(power=(share * lasting) ** 2)
        found = a_selector().select(CONTACTS, intent, capabilities)
        assert len(found.contents) == count
        assert (
            np.linalg.norm(sums(found)) <= share * lasting * (1 + 1e-6) < np.linalg.norm(sums(free))
        )
    (held_back,) = found.not_served
    assert "lift a finger" in str(held_back.held_back)


def test_what_a_click_leaves_nothing_for_says_so_and_is_felt_after_it() -> None:
    """The limits are no cause: without the click they allow it."""
    click = Target(CONTACTS[1].key, 20.0, pulse=Pulse(0.04, requested_at=0.0))
    lasting = Target(CONTACTS[0].key, 20.0)
    alone = a_selector().select(CONTACTS, HapticIntent((click,)), FREE)
    hardly = within(power=(1.001 * np.linalg.norm(sums(alone))) ** 2)
    selector = a_selector()
    selector.select(CONTACTS, HapticIntent((click,)), hardly, now=0.0)
    both = HapticIntent((lasting, click))
    (held_back,) = selector.select(CONTACTS, both, hardly, now=0.01).not_served
    assert held_back.contact == CONTACTS[0]
    assert "contents of other fingers" in str(held_back.held_back)
    after = HapticIntent((lasting,))
    found = selector.select(CONTACTS, after, hardly, now=selector.due)
    assert (found.not_served, len(found.contents)) == ((), 1)


@pytest.mark.parametrize("what", ["level", "power"])
def test_a_lone_steady_content_is_within_a_limit(what: str) -> None:
    """It is lowered to the limit, 0.8 of its amplitude, instead of refused by the amplifiers."""
    target = Target(CONTACTS[0].key, 14.0)
    intent = HapticIntent((target,))
    free = a_selector().select(CONTACTS, intent, FREE)
    most = 0.8 * sums(free).max()
    capabilities = within(power=0.8**2 * float((sums(free) ** 2).sum()))
    if what == "level":
        capabilities = within(most=most)
    found = a_selector().select(CONTACTS, intent, capabilities)
    assert sums(found) == pytest.approx(0.8 * sums(free), rel=1e-6)
    (before,), (after,) = free.predictions, found.predictions
    assert before.level_db_sl is not None
    assert after.level_db_sl == pytest.approx(before.level_db_sl + 20 * np.log10(0.8))
    assert after.promised_contrast_db == pytest.approx(before.promised_contrast_db)
