"""Several fingers, each with a content of its own, on the plate in virtual time."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller.daemon.messages import PlateView
from controller.effects.kinds import Buzz, Click
from controller.effects.layout import SurfaceLayout
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.loop import ENDED, PlayReport
from controller.play.selection import Chooser, Selector
from controller.play.slots import Sets, Slot, Slots
from controller.sources.touch import Contact, ContactKey
from drivers.errors import CommandRefused
from drivers.protocol.sets import LayerSet
from model.answer import answer
from model.arrays import Complex64Array
from model.errors import InputError
from set_table import SetTiming
from several_fingers import (
    ABOVE,
    LAYOUT,
    LEFT,
    RIGHT,
    answers_take,
    chosen_for,
    fingers_on,
    playable,
    table,
)
from virtual_lines import in_virtual_time


def answering_after(seconds: float, monkeypatch: pytest.MonkeyPatch) -> asyncio.AbstractEventLoop:
    """Let every answer of the thread take a time [s]; returns the running loop."""
    answers_take(monkeypatch, seconds)
    return asyncio.get_running_loop()


def begun(committed: Sequence[tuple[float, int, tuple[LayerSet, ...]]]) -> list[Sequence[LayerSet]]:
    """The sets that change what plays: neither renewals nor endings."""
    sets = list[Sequence[LayerSet]]()
    for _, _, layers in committed:
        endings = [command.ending for one in layers for command in one.commands]
        if not (layers[0].renew or any(endings)):
            sets.append(layers)
    return sets


@in_virtual_time
async def test_two_fingers_each_feel_their_own_within_1_db_of_the_promise() -> None:
    """Measured at the fingertips over the wire, against the answer for the nominal plate."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=1.0) as fingers:
        (applied,) = fingers.applied
        first, second = (one.content for one in applied.contents.values())
        assert abs(first.frequency - second.frequency) >= 30
        assert [each.verdict for each in applied.targets] == ["own", "own"]
        predicted = {
            one.content.targets[0][0].key.id: one.content.predictions[0].contrast_db
            for one in applied.contents.values()
        }
        assert fingers.contrasts() == pytest.approx(predicted, abs=1.0)


@in_virtual_time
async def test_a_third_finger_joins_and_all_are_weighted_anew_in_one_commit() -> None:
    """Each keeps its layer and its frequency; what is led to a better answer follows."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=0.5) as fingers:
        before = {number: one.content for number, one in fingers.applied[-1].contents.items()}
        count = len(fingers.committed)
        fingers.at[3] = ABOVE
        await fingers.hold(0.09)
        (sent,) = begun(fingers.committed[count:])
        assert sorted(one.layer for one in sent) == [0, 1, 2]
        after = {number: one.content for number, one in fingers.applied[-1].contents.items()}
        for number, content in before.items():
            assert after[number].targets[0][0].key == content.targets[0][0].key
        assert [each.held_back for each in fingers.applied[-1].targets] == [None] * 3
        for number, content in before.items():
            assert after[number].frequency == content.frequency
        for one in sent:
            keeps = {command.keep_phase for command in one.commands}
            assert keeps == {one.layer in before}


@in_virtual_time
async def test_one_finger_leaves_and_the_layer_of_the_other_is_not_touched() -> None:
    """One set, of its layer alone; what the other feels has the same amplitude before and after."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        (other,) = (n for n, one in fingers.applied[-1].contents.items() if _id(one) == 2)
        count = len(fingers.committed)
        del fingers.at[1]
        await fingers.hold(0.5)
        (sent,) = begun(fingers.committed[count:])
        (one,) = sent
        assert one.layer != other
        assert not any(command.level for command in one.commands)
        assert [each.contact.key.id for each in fingers.applied[-1].targets] == [2]
        await fingers.hold(3.0)  # renewed alone
        renewed = [each for _, _, layers in fingers.committed for each in layers if each.renew]
        assert renewed
        assert {each.layer for each in renewed} == {other}
        assert fingers.contrasts() == {}  # only its own content is left
        fingers.at.clear()
        count = len(fingers.committed)
        await fingers.hold(0.1)
        assert fingers.committed[count][2] == ()  # a Silence of all layers, at once


@in_virtual_time
async def test_a_slide_keeps_its_frequencies_until_the_finger_rests() -> None:
    """On a way along which others promise 2 dB more: these are led to once it rests, in steps."""
    async with fingers_on(table(), LAYOUT, at={1: (0.034, 0.089), 2: RIGHT}, held=2.0) as fingers:
        before, count = _frequencies(fingers.applied[-1]), len(fingers.applied)

        def slide(since: float) -> None:
            fingers.at[1] = (0.034 + 0.144 * since, 0.089 - 0.109 * since)

        await fingers.hold(0.4, slide)
        sliding = fingers.applied[count:]
        assert len(sliding) >= 5
        assert {_frequencies(each) for each in sliding} == {before}
        slid = asyncio.get_running_loop().time()
        await fingers.hold(1.5)
        first, *_, rested = fingers.applied[count + len(sliding) :]
        assert 0.05 <= first.time - slid <= 0.2
        assert {*_frequencies(rested)} != {*before}
        assert _worst(rested) >= _worst(sliding[-1]) + 2


@in_virtual_time
async def test_a_lifted_finger_falls_silent_while_an_amplifier_is_degraded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its layer alone, within 20 ms, though the other moves, which begins anew in its layer."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        layers = {_id(one): number for number, one in fingers.applied[-1].contents.items()}
        group, count = fingers.controller.group, len(fingers.committed)
        with monkeypatch.context() as patched:
            patched.setattr(type(group.members), "degraded", ("main",))
            fingers.at[2] = (RIGHT[0] + 0.01, RIGHT[1])
            await fingers.hold(0.03)  # what plays is unknown by now
            del fingers.at[1]
            lifted = asyncio.get_running_loop().time()
            await fingers.hold(0.1)
            ((ended, _, sent),) = fingers.committed[count:]
            assert [(one.layer, one.renew) for one in sent] == [(layers[1], False)]
            assert not any(command.level for one in sent for command in one.commands)
            assert ended - lifted <= 0.020
        await fingers.hold(0.1)
        _, _, sent = fingers.committed[count + 1]
        assert [one.layer for one in sent] == [layers[2]]


@in_virtual_time
async def test_what_lasts_has_what_a_loud_click_leaves_and_all_of_it_after_that() -> None:
    """A finger's vibration is raised amid the 40 ms of another's click: both need 1.2 strokes.

    It is never silent, nor refused by the amplifiers.
    """
    regions = (LAYOUT.regions[0], replace(LAYOUT.regions[1], on_press="click"))
    effects = {**LAYOUT.effects, "click": Click(level=44.0), "loud": Buzz(level=44.0)}
    layout = SurfaceLayout(regions, effects, elsewhere=None)
    async with fingers_on(table(), layout, at={1: LEFT}, held=0.6) as fingers:
        begin = asyncio.get_running_loop().time()
        fingers.at[2] = RIGHT
        await fingers.hold(0.012)
        fingers.play("loud")
        await fingers.hold(0.2)
        raised = [each for each in fingers.applied if each.time > begin + 0.012]
        felt = [each for applied in raised for each in applied.targets if each.contact.key.id == 1]
        assert {each.held_back for each in felt} == {None}
        assert felt[0].level_db_sl < felt[-1].level_db_sl - 0.5
        assert not fingers.silenced
        assert raised[-1].time - begin <= 0.15
        await fingers.hold(0.3)
        assert fingers.levels_db_sl()[1] >= 43


@in_virtual_time
async def test_a_finger_that_rests_feels_again_what_an_amplifier_refused_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All is silent meanwhile, for a second; the latency is that of the touch."""
    async with fingers_on(table(), LAYOUT, at={}, held=0.1) as fingers:
        fingers.must_be_felt, group = False, fingers.controller.group
        apply, refused = group.apply, list[float]()

        async def refuse_once(*given: Any, **more: Any) -> Any:
            if not refused:
                refused.append(asyncio.get_running_loop().time())
                raise CommandRefused("not now")
            return await apply(*given, **more)

        monkeypatch.setattr(group, "apply", refuse_once)
        fingers.at[1] = LEFT
        await fingers.hold(0.9)
        assert (len(fingers.refused), fingers.applied) == (1, [])
        await fingers.hold(0.5)
        (applied,) = fingers.applied
        assert applied.is_touch
        assert applied.latency == pytest.approx(1.0, abs=0.1)


@in_virtual_time
async def test_the_end_of_one_layer_by_itself_is_said_while_the_other_plays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One is not renewed, and ends after 2 s; the others go on, and nothing was sent for that.

    Nor does it count as felt once one of the others lifts.
    """
    renewal = Slots.renewal
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.8) as fingers:
        layers = {_id(one): n for n, one in fingers.applied[-1].contents.items()}

        def not_one(all_slots: Slots, now: float) -> Sets:
            due = renewal(all_slots, now).layers
            return Sets({n: each for n, each in due.items() if n != layers[1]})

        monkeypatch.setattr(Slots, "renewal", not_one)
        count = len(fingers.applied)
        await fingers.hold(2.5)
        (applied,) = fingers.applied[count:]
        assert {*applied.contents} == {layers[2], layers[3]}
        assert applied.latency is None
        felt = {each.contact.key.id: each.held_back for each in applied.targets}
        assert felt == {1: ENDED, 2: None, 3: None}
        del fingers.at[3]
        await fingers.hold(0.2)
        assert [*fingers.applied[-1].contents] == [layers[2]]
        felt = {each.contact.key.id: each.held_back for each in fingers.applied[-1].targets}
        assert felt == {1: ENDED, 2: None}


@in_virtual_time
async def test_others_feel_no_change_after_a_click_of_one_finger() -> None:
    """Nor of its own: each set since the click is of a layer that was free."""
    layout = SurfaceLayout(
        LAYOUT.regions, {**LAYOUT.effects, "tick": Click(level=14.0)}, elsewhere=None
    )
    async with fingers_on(table(), layout, at={1: LEFT, 2: RIGHT}, held=0.5) as fingers:
        contents = {_id(one): one.content for one in fingers.applied[-1].contents.values()}
        count = len(fingers.committed)
        fingers.play("tick")
        await fingers.hold(0.4)
        changed = begun(fingers.committed[count:])
        assert [[one.layer for one in each] for each in changed] == [[2]] * 2
        after = {_id(one): one.content for one in fingers.applied[-1].contents.values()}
        assert after == contents


@in_virtual_time
async def test_a_click_goes_before_what_lasts_of_other_fingers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An answer to what lasts takes 70 ms and runs already; the click is sent as it has come.

    Its latency counts from its touch, though it has waited.
    """
    loop = answering_after(0.07, monkeypatch)
    layout = SurfaceLayout(
        LAYOUT.regions, {**LAYOUT.effects, "any": Click(level=14.0)}, elsewhere=None
    )
    async with fingers_on(table(), layout, at={1: LEFT, 2: RIGHT}, held=0.5) as fingers:
        count, begin = len(fingers.committed), loop.time()
        fingers.at[1] = (LEFT[0] + 0.02, LEFT[1])
        await fingers.hold(0.02)
        fingers.at[3], touched = ABOVE, loop.time()
        await fingers.hold(0.3)
        at = min(at for at, _, layers in fingers.committed[count:] if layers[0].layer == 2)
        assert 0.07 <= at - begin <= 0.075
        clicked = next(each for each in fingers.applied if len(each.contents) == 3)
        assert clicked.latency == pytest.approx(at - touched, abs=0.003)


@in_virtual_time
async def test_latency_counts_from_the_change_that_an_answer_is_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A slide of 0.9 s, answers of 0.2 s, too late for a touch: one that runs, then its own."""
    answering_after(0.2, monkeypatch)
    async with fingers_on(
        table(), LAYOUT, breaks="touch", at={1: (0.03, 0.06), 2: RIGHT}, held=0.5
    ) as fingers:
        count = len(fingers.applied)

        def slide(since: float) -> None:
            fingers.at[1] = (0.03 + 0.07 * since, 0.06)

        await fingers.hold(0.9, slide)
        latencies = [each.latency or 0.0 for each in fingers.applied[count:]]
        assert len(latencies) >= 2
        assert min(latencies) >= 0.2
        assert max(latencies) <= 0.45


@in_virtual_time
async def test_an_answer_for_a_finger_that_has_lifted_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A finger comes and lifts while the answer for two is computed: the other's set stays."""
    answering_after(0.2, monkeypatch)
    async with fingers_on(table(), LAYOUT, at={1: LEFT}, held=0.3) as fingers:
        count = len(fingers.committed)
        fingers.at[2] = RIGHT
        await fingers.hold(0.05)
        del fingers.at[2]
        await fingers.hold(0.5)
        assert len(fingers.committed) == count
        assert len(fingers.applied) == 1


@pytest.mark.parametrize("is_busy", [False, True])
@in_virtual_time
async def test_a_finger_that_comes_back_elsewhere_feels_nothing_chosen_for_its_old_place(
    is_busy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the same id; also while an answer is computed that was asked for before it lifted."""
    answering_after(0.07, monkeypatch)
    late = "touch" if is_busy else None
    async with fingers_on(
        table(), LAYOUT, breaks=late, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=0.6
    ) as fingers:
        if is_busy:
            fingers.at[3] = (ABOVE[0] + 0.01, ABOVE[1])
            await fingers.hold(0.02)
        del fingers.at[2]
        await fingers.hold(0.02)
        count, fingers.at[2] = len(fingers.applied), (0.27, 0.10)
        await fingers.hold(0.3)
        places = {
            (contact.x, contact.y)
            for applied in fingers.applied[count:]
            for one in applied.contents.values()
            for contact, _ in one.content.targets
            if contact.key.id == 2
        }
        assert places == {fingers.at[2]}


@in_virtual_time
async def test_arming_again_forgets_no_layer_that_plays() -> None:
    """A finger that lifts just then falls silent, as the other plays on."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        layers = {_id(one): number for number, one in fingers.applied[-1].contents.items()}
        count = len(fingers.committed)
        await fingers.controller.arm()
        del fingers.at[2]
        await fingers.hold(0.1)
        sets = {one.layer: one for _, _, sent in fingers.committed[count:] for one in sent}
        assert not any(command.level for command in sets[layers[2]].commands)
        assert any(command.level for command in sets[layers[1]].commands)


@in_virtual_time
async def test_a_click_that_cannot_be_played_is_said_though_no_layer_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A resting finger slides 4 mm into the region of a click, which the table refuses."""
    regions = (LAYOUT.regions[0], replace(LAYOUT.regions[1], on_press="click"))
    layout = SurfaceLayout(regions, {**LAYOUT.effects, "click": Click(level=14.0)}, elsewhere=None)
    async with fingers_on(table(), layout, at={1: LEFT, 2: (0.158, 0.049)}, held=0.5) as fingers:
        count = len(fingers.committed)

        def refuse(*_: Any, **__: Any) -> None:
            raise InputError("nothing is felt there")

        monkeypatch.setattr("controller.play.selection.answered", refuse)
        fingers.at[2] = (0.162, 0.049)
        await fingers.hold(0.02)
        assert len(fingers.committed) == count
        felt = {each.contact.key.id: each.held_back for each in fingers.applied[-1].targets}
        assert felt == {1: None, 2: "nothing is felt there"}


@in_virtual_time
async def test_a_click_is_played_though_the_answer_takes_longer_than_it_lasts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """40 ms, for all of them, though the answer for it and two fingers beside it takes 60."""
    loop = answering_after(0.06, monkeypatch)
    layout = SurfaceLayout(
        LAYOUT.regions, {**LAYOUT.effects, "any": Click(level=14.0)}, elsewhere=None
    )
    async with fingers_on(table(), layout, at={1: LEFT, 2: RIGHT}, held=0.5) as fingers:
        count, begin = len(fingers.committed), loop.time()
        fingers.at[3] = ABOVE
        await fingers.hold(0.3)
        (start, is_driven), (end, is_still_driven), *_ = (  # then what others are led to
            (at, any(command.level for command in one.commands))
            for at, _, layers in fingers.committed[count:]
            for one in layers
            if one.layer == 2
        )
        assert (is_driven, is_still_driven) == (True, False)
        assert 0.06 <= start - begin <= 0.08
        assert 0.04 <= end - start <= 0.05


@in_virtual_time
async def test_an_answer_is_shaped_by_the_timing_it_began_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Others are put in place meanwhile, whose timing has no envelopes: what was begun has one."""
    answering_after(0.03, monkeypatch)
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=0.01) as fingers:
        fingers.controller.replace_answers(table(), SetTiming())  # type: ignore[arg-type]
        await fingers.hold(0.3)
        (applied,) = fingers.applied
        assert all(one.layer.onset for one in applied.contents.values())


@in_virtual_time
async def test_an_answer_of_a_former_layout_is_not_played(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A finger joins; the effects change while the answer is computed: only the new ones play."""
    answering_after(0.07, monkeypatch)
    async with fingers_on(table(), LAYOUT, breaks="touch", at={1: LEFT}, held=0.5) as fingers:
        fingers.at[2] = RIGHT
        await fingers.hold(0.03)
        count = len(fingers.applied)
        bands = [replace(region, band=(200.0, 320.0)) for region in LAYOUT.regions]
        fingers.player.replace(replace(LAYOUT, regions=tuple(bands)))
        fingers.controller.cycle.request_update()
        await fingers.hold(0.3)
        (applied,) = fingers.applied[count:]
        assert len(applied.contents) == 2
        assert all((one.content.frequency or 0) >= 200 for one in applied.contents.values())


@in_virtual_time
async def test_an_effect_that_is_played_again_before_its_answer_is_felt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A program repeats it every 30 ms, and answers take 50: each is to the play before."""
    answering_after(0.05, monkeypatch)
    layout = replace(LAYOUT, effects={**LAYOUT.effects, "long": Buzz(level=14.0, duration=0.5)})
    async with fingers_on(table(), layout, at={1: LEFT, 2: RIGHT}, held=0.3) as fingers:
        count = len(fingers.applied)
        for _ in range(10):
            fingers.play("long")
            await fingers.hold(0.03)
        names = {
            one.content.targets[0][1].content
            for each in fingers.applied[count:]
            for one in each.contents.values()
        }
        assert "long" in names


@in_virtual_time
async def test_what_is_not_served_says_why() -> None:
    """Of six fingers the four newest have the four layers; the plate cannot serve all of these."""
    async with fingers_on(table(), LAYOUT, layers=4) as fingers:
        x = (0.03, 0.08, 0.13, 0.18, 0.23, 0.28)
        fingers.at = {id: (at, 0.05 + 0.12 * (id % 2)) for id, at in enumerate(x, start=1)}
        await fingers.hold(0.5)
        felt = {each.contact.key.id: each for each in fingers.applied[-1].targets}
        assert felt.keys() == fingers.at.keys()
        for each in felt.values():
            assert each.verdict in ("own", "mixed", "shared", "held back")
            assert (each.held_back is None) == (each.verdict in ("own", "mixed"))
            assert "(" not in (each.held_back or "")  # no object of the program
        assert {felt[id].verdict for id in (1, 2)} == {"held back"}  # the earliest
        assert felt[1].held_back == (
            "no layer is free: the amplifiers play 4 contents at once; lift a finger"
        )
        others = [felt[id] for id in (3, 4, 5, 6) if felt[id].verdict == "held back"]
        assert others
        assert all("6 dB of contrast" in (each.held_back or "") for each in others)


@in_virtual_time
async def test_an_answer_that_fails_silences_all_and_says_why(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Asked once, not in every turn of the loop; fingers that move are asked for again."""
    calls = 0

    def fail(*_: Any, **__: Any) -> None:
        nonlocal calls
        calls += 1
        raise ZeroDivisionError("by no finger")

    async with fingers_on(table(), LAYOUT, breaks="touch", at={1: LEFT}, held=0.3) as fingers:
        with monkeypatch.context() as patched:
            patched.setattr("controller.play.selection.answered", fail)
            fingers.at[2] = RIGHT
            await fingers.hold(0.5)
        assert calls == 1
        (one,) = fingers.committed[-1][2]
        assert (one.commands, one.renew) == ((), False)  # ends along its ending
        assert fingers.contrasts() == {}
        assert fingers.silenced[-1].reason == "ZeroDivisionError: by no finger"
        fingers.at[2] = (RIGHT[0] + 0.01, RIGHT[1])
        await fingers.hold(0.3)
        assert [each.held_back for each in fingers.applied[-1].targets] == [None, None]


@in_virtual_time
async def test_status_says_what_each_finger_feels() -> None:
    """Keys of the API: by finger its content and verdict; by layer what the ERAs play."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=0.5) as fingers:
        applied = fingers.applied[-1]
        view = PlateView(lambda key: "buzz", applied.contacts, applied)
        event = view.pattern_event()
        assert event is not None
        assert len(event.layers) == 3
        for contact, (number, one) in zip(event.contacts, applied.contents.items(), strict=True):
            assert (contact.role, contact.held_back) == ("target", None)
            promised = contact.promised_contrast_db
            assert promised is not None
            assert contact.verdict == ("own" if promised >= 12 else "mixed")
            assert contact.level_db_sl == pytest.approx(14.0, abs=0.5)
            assert contact.foreign_level_db_sl == pytest.approx(14.0 - promised, abs=2.0)
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
    contacts = [
        Contact(ContactKey("a", n), *at, since=0.0)
        for n, at in enumerate(((0.06, 0.06), (0.2, 0.1)))
    ]
    targets = [(each, Target(each.key, 20.0, band=(99.0, 101.0))) for each in contacts]
    found = chosen_for(targets, playable(4))
    (held_back,) = found.not_served
    assert held_back.promised_contrast_db is not None
    assert held_back.promised_contrast_db > 12
    assert held_back.held_back is not None
    assert "another finger" in held_back.held_back


def test_a_kept_frequency_keeps_its_phase_at_the_finger() -> None:
    """As it moves by 1 cm and another joins, at its new place; by the fields of the table."""
    contacts = [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate((LEFT, RIGHT))]
    targets = [(each, Target(each.key, 14.0)) for each in contacts]
    first = chosen_for(targets, playable(4))
    before = {each.key: each for each in first.contents}
    moved = replace(contacts[0], x=contacts[0].x + 0.01)
    third = Contact(ContactKey("a", 2), *ABOVE, since=0.0)
    joined = [(moved, targets[0][1]), targets[1], (third, Target(third.key, 14.0))]
    second = chosen_for(joined, playable(4), before=before)
    places = [(each.x, each.y) for each, _ in joined]
    fields = table().unit_fields(np.array(places), contacts=places)
    kept = 0
    for content in second.contents:
        then = before.get(content.key)
        if then is not None and then.frequency == content.frequency:
            at = places.index((content.targets[0][0].x, content.targets[0][0].y))
            now, old = (_felt(each.layer, fields[:, :, at]) for each in (content, then))
            assert np.angle(now / old) == pytest.approx(0.0, abs=1e-3)
            kept += 1
    assert kept


def _felt(pattern: answer.Layer, fields: Complex64Array) -> complex:
    """Acceleration at a finger of a pattern of one frequency, by each ERA's field (f, eras)."""
    (frequency,) = {tone.frequency for tone in pattern.excitation.values()}
    row = int(np.flatnonzero(table().frequencies == frequency)[0])
    eras = {era.name: (number, era.stroke) for number, era in enumerate(table().eras)}
    return complex(
        sum(
            tone.amplitude / eras[name][1] * np.exp(1j * tone.phase) * fields[row, eras[name][0]]
            for name, tone in pattern.excitation.items()
        )
    )


def _frequencies(applied: PlayReport) -> tuple[float | None, ...]:
    return tuple(one.content.frequency for one in applied.contents.values())


def _worst(applied: PlayReport) -> float:
    return min(each.promised_contrast_db or 0.0 for each in applied.targets)


def _id(one: Slot) -> int:
    return one.content.targets[0][0].key.id
