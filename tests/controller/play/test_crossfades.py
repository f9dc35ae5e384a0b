"""The way from what plays to a better answer, once all fingers rest, on the plate in virtual time.

Two fingers that land 0.35 s apart on the paper's plate are promised 8.9 dB, since the frequency of
the first is kept, and 19.5 where they land together; on the way both frequencies change.
"""

import asyncio
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from chain import Position
from controller.effects.kinds import Click
from controller.play.intent import Target
from controller.play.joint_answers import Crossfades
from controller.play.layers import CROSSFADE
from controller.play.planner import PlayReport
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import Limits
from model.config.fields import Rectangle
from model.study.contrast_maps import random_contacts
from several_fingers import LAYOUT, Fingers, chosen_for, fingers_on, playable, table
from virtual_lines import in_virtual_time

FIRST, SECOND = (0.2133, 0.0366), (0.1206, 0.1132)


def worst(applied: PlayReport) -> float:
    """Promise of the worst finger."""
    return min(each.promised_contrast_db or 0.0 for each in applied.targets)


def frequencies(applied: PlayReport) -> dict[int, float]:
    """By finger."""
    return {each.contact.key.id: each.frequency or 0.0 for each in applied.targets}


async def apart(fingers: Fingers, *, then: float) -> int:
    """Let two fingers land 0.35 s apart, and rest; returns how many sets were committed by then."""
    fingers.at = {1: FIRST}
    await fingers.hold(0.35)
    fingers.at[2] = SECOND
    await fingers.hold(0.09)
    count = len(fingers.committed)
    await fingers.hold(then - 0.09)
    return count


WHOLE = replace(
    LAYOUT,
    regions=(replace(LAYOUT.regions[0], shape=Rectangle(0.0, 0.0, 0.3, 0.22), on_press="any"),),
)
"""Every finger feels the same effect, of 14 dB SL, at any frequency."""


def contacts_at(*places: Position) -> list[Contact]:
    """Contacts that rest."""
    return [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate(places)]


@in_virtual_time
async def test_fingers_that_land_apart_come_to_the_promise_of_those_that_land_together() -> None:
    """Within 1 dB, a content at a time; all that sounds at once is 30 Hz apart, and it is felt."""
    targets = tuple((each, Target(each.key, 14.0)) for each in contacts_at(FIRST, SECOND))
    together = chosen_for(targets, playable())
    async with fingers_on(table(), WHOLE) as fingers:
        await apart(fingers, then=1.5)
        landed, *steps = fingers.applied[1:]
        promised = min(each.promised_contrast_db or 0.0 for each in together.predictions)
        assert worst(landed) < promised - 6
        assert worst(steps[-1]) >= promised - 1
        for before, after in pairwise([landed, *steps]):
            (led,) = {*frequencies(after).values()} - {*frequencies(before).values()}
            assert all(abs(led - each) >= 30 for each in frequencies(before).values())
            if before is not landed:
                assert after.time - before.time >= 0.38  # no two fade at once
        assert min(fingers.contrasts().values()) >= worst(steps[-1])


@in_virtual_time
async def test_one_content_rises_in_a_layer_of_its_own_and_the_other_falls_later() -> None:
    """Along 300 ms both, the other 81 ms later, to below any threshold; then it has ended."""
    async with fingers_on(table(), WHOLE) as fingers:
        count = await apart(fingers, then=0.6)
        fades = [each for each in fingers.committed[count:] if each[2][0].ramp == 300]
        (rising, _, (new,)), (falling, _, (old,)), *_ = fades
        assert (new.layer, old.layer) == (2, 0)
        assert falling - rising == pytest.approx(0.081, abs=0.005)
        assert {command.level for command in old.commands} == {1}  # 1e-4 of the stroke
        assert all(command.keep_phase for command in old.commands)
        await fingers.hold(0.3)
        assert fingers.far_end.status()["tokens"][old.layer] == 0
        assert old.layer not in fingers.applied[-1].contents


@pytest.mark.parametrize(("amid", "within"), [(0.15, 0.042), (0.25, 0.022)])
@in_virtual_time
async def test_a_finger_that_lifts_amid_a_crossfade_is_silent_at_once(
    amid: float, within: float
) -> None:
    """Along the ending of 40 ms of what plays in full yet, and a ramp of 20 of what falls."""
    async with fingers_on(table(), WHOLE) as fingers:
        await apart(fingers, then=amid)
        assert frequencies(fingers.applied[-1]) == {1: 140.0, 2: 190.0}
        del fingers.at[1]
        lifted, count = asyncio.get_running_loop().time(), len(fingers.committed)
        await fingers.hold(0.012)
        _, _, layers = fingers.committed[count]
        assert sorted(one.layer for one in layers) == [0, 2]
        assert not any(command.level for one in layers for command in one.commands)
        voices = [each for every in fingers.far_end.amplifier.outputs for each in every]
        assert all(each.silent_from <= lifted + within for each in voices if each.layer != 1)


@in_virtual_time
async def test_a_touch_amid_a_crossfade_is_answered_at_once() -> None:
    """The next set has all three; the tone that fell ends with it, and nothing is led meanwhile."""
    async with fingers_on(table(), WHOLE) as fingers:
        await apart(fingers, then=0.25)
        count, touched = len(fingers.committed), asyncio.get_running_loop().time()
        fingers.at[3] = (0.05, 0.19)
        await fingers.hold(0.06)
        at, _, layers = fingers.committed[count]
        assert at - touched <= 0.02
        driven = {one.layer for one in layers if any(command.level for command in one.commands)}
        assert {1, 2} < driven
        assert {one.layer for one in layers} - driven == {0} - driven
        assert len(fingers.applied[-1].contents) == 3


@in_virtual_time
async def test_a_click_amid_a_crossfade_keeps_from_all_that_sounds() -> None:
    """Answered at once, 30 Hz from the tone that falls, too, and that goes on in its layer.

    Of its band that leaves 100 and 110 Hz, without what falls 220 to 240 as well.
    """
    layout = replace(WHOLE, effects={**WHOLE.effects, "click": Click(band=(100.0, 240.0))})
    async with fingers_on(table(), layout) as fingers:
        await apart(fingers, then=0.25)
        before, count = fingers.applied[-1], len(fingers.committed)
        assert frequencies(before) == {1: 140.0, 2: 190.0}  # after 230
        began = asyncio.get_running_loop().time()
        fingers.play("click", 2)
        await fingers.hold(0.03)
        at, _, layers = fingers.committed[count]
        (click,) = [one for one in fingers.applied[-1].contents.values() if one.content.key[1] < 0]
        assert at - began <= 0.02
        assert [one.layer for one in layers] == [3]
        assert click.content.frequency in (100, 110)


@in_virtual_time
async def test_where_no_layer_is_free_nothing_is_led_over() -> None:
    """Of two layers both play, and stay as they are."""
    async with fingers_on(table(), WHOLE) as fingers:
        fingers.controller.cycle.planner.layers._count = 2
        count = await apart(fingers, then=1.5)
        sent = [one for _, _, layers in fingers.committed[count:] for one in layers]
        assert all(one.renew or one.ramp < 300 for one in sent)
        assert frequencies(fingers.applied[-1]) == {1: 230.0, 2: 190.0}
        assert fingers.contrasts().keys() == {1, 2}


@in_virtual_time
async def test_a_finger_that_moves_again_within_a_second_is_not_led_again() -> None:
    """The last step, and the first of the next way, are a second apart or more."""
    async with fingers_on(table(), WHOLE) as fingers:
        await apart(fingers, then=1.1)
        steps = [each.time for each in fingers.applied[2:]]
        assert len(steps) == 2
        fingers.at[2] = (0.20, 0.15)
        await fingers.hold(1.5)
        led = [each.time for each in fingers.applied if each.settled_after == CROSSFADE]
        assert all(time - steps[-1] >= 1.0 for time in led[2:])


@in_virtual_time
async def test_after_a_leave_weights_are_led_within_their_layers() -> None:
    """Of three fingers one leaves: the others keep frequency, phase and layer, along 300 ms."""
    places = {1: (0.206, 0.015), 2: (0.151, 0.098), 3: (0.07, 0.077)}
    async with fingers_on(table(), WHOLE, at=places, held=1.5) as fingers:
        before = fingers.applied[-1]
        del fingers.at[3]
        await fingers.hold(0.09)
        left, count = fingers.applied[-1], len(fingers.committed)
        await fingers.hold(1.1)
        sent = [one for _, _, layers in fingers.committed[count:] for one in layers]
        led = [one for one in sent if one.ramp == 300 and not any(c.ending for c in one.commands)]
        after = fingers.applied[-1]
        assert {one.layer for one in led} <= {*after.contents}
        assert all(command.keep_phase for one in led for command in one.commands)
        assert frequencies(after) == frequencies(left)
        assert {*frequencies(after).items()} < {*frequencies(before).items()}
        assert worst(after) >= worst(left) + 0.5


def test_every_step_keeps_30_hz_between_all_that_sounds() -> None:
    """Twelve sets of three fingers anywhere, of whom the third has come last, or has left."""
    rng, found = np.random.default_rng(5), 0
    for number in range(12):
        places = random_contacts(rng, 3, table().plate, margin=0.013)
        targets = [(each, Target(each.key, 14.0)) for each in contacts_at(*places)]
        before = chosen_for(targets[:2], playable()) if number % 2 else None
        playing = {each.key: each for each in before.contents} if before else {}
        landed = chosen_for(targets, playable(), before=playing)
        resting = tuple(targets) if number % 2 else tuple(targets[:2])
        keys = {contact.key for contact, _ in resting}
        felt = {each.key: each for each in landed.contents if each.key[0] in keys}
        if {key for key, _ in felt} != keys:
            continue
        beside = {each.contact.key: each.frequency or 0.0 for each in landed.predictions}
        beside = {key: beside[key] for key in keys}
        for step in Crossfades(table(), resting, (), playable(), felt).steps():
            after = {each.contact.key: each.frequency or 0.0 for each in step.predictions}
            changed = [key for key in keys if after[key] != beside[key]]
            assert len(changed) <= 1
            for key in changed:
                assert all(abs(after[key] - each) >= 30 for each in beside.values())
                found += 1
            beside = after
    assert found >= 3


def test_what_does_not_fit_beside_what_plays_is_not_led_to() -> None:
    """Of stroke for 1.2 times what plays: both together need more.

    What it was promised for a way, 2 dB less, is said anew as of fingers that rest.
    """
    targets = tuple((each, Target(each.key, 14.0)) for each in contacts_at(FIRST, SECOND))
    first = chosen_for(targets[:1], playable())
    landed = chosen_for(targets, playable(), before={each.key: each for each in first.contents})
    felt, drives = {each.key: each for each in landed.contents}, dict[str, float]()
    for each in landed.contents:
        for name, tone in each.layer.excitation.items():
            drives[name] = drives.get(name, 0.0) + tone.amplitude
    limited = replace(
        playable(), limits=Limits((40.0, 320.0), {n: 1.2 * each for n, each in drives.items()})
    )
    assert Crossfades(table(), targets, (), playable(), felt).steps()
    assert not Crossfades(table(), targets, (), limited, felt).steps()
    moving = {
        key: [
            replace(one, promised_contrast_db=one.promised_contrast_db - 2.0)
            for one in each.predictions
            if one.promised_contrast_db is not None
        ]
        for key, each in felt.items()
    }
    felt = {key: replace(each, predictions=tuple(moving[key])) for key, each in felt.items()}
    (rested,) = Crossfades(table(), targets, (), limited, felt).steps()
    assert rested.contents == landed.contents
    for one, other in zip(rested.predictions, landed.predictions, strict=True):
        assert one.promised_contrast_db == pytest.approx(other.promised_contrast_db, abs=0.1)
