"""Clicks at fingers that feel what lasts: a layer beside it, and figures of that moment."""

import asyncio
import math
from collections import Counter
from dataclasses import replace

import pytest

from controller.effects.kinds import Buzz, Click
from controller.effects.layout import SurfaceLayout, default_effects
from controller.play.intent import CLICK, HapticIntent, Pulse, Target
from controller.play.layer_contents import LayerContent, Prediction, Selection, sums_db
from controller.play.planner import PlayReport
from controller.play.selection import Chooser, Selector
from controller.sources.touch import Contact, ContactKey
from several_fingers import LAYOUT, LEFT, RIGHT, Fingers, fingers_on, playable, table
from virtual_lines import in_virtual_time

PLAYED = SurfaceLayout(LAYOUT.regions, {**default_effects(), **LAYOUT.effects}, elsewhere=None)
"""Contents of 14 dB SL, and a click without a level of its own."""


async def clicked(fingers: Fingers, name: str = "click") -> tuple[PlayReport, PlayReport, int]:
    """Play a click at finger 1: what was reported before it, of it, and how often in all."""
    count, before = len(fingers.applied), fingers.applied[-1]
    fingers.play(name)
    await fingers.hold(0.3)
    return before, fingers.applied[count], len(fingers.applied) - count


def by_finger(report: PlayReport) -> dict[int, Prediction]:
    """What each finger is predicted to feel."""
    return {each.contact.key.id: each for each in report.targets}


def short(report: PlayReport) -> list[LayerContent]:
    """The clicks that play."""
    return [one for one in report.contents.values() if one.content.key[1] == CLICK]


@in_virtual_time
async def test_a_click_beside_its_own_buzz_is_6_db_above_it_and_30_hz_from_all() -> None:
    """As modelled, in 2 sets of its own layer; what lasts of both fingers is not touched."""
    async with fingers_on(table(), PLAYED, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        sent = len(fingers.committed)
        before, during, _ = await clicked(fingers)
        (click,) = short(during)
        (number,) = [n for n, one in during.contents.items() if one is click]
        layers = [[one.layer for one in each] for _, _, each in fingers.committed[sent:]]
        assert layers == [[number]] * 2
        felt, buzz = by_finger(during)[1], by_finger(before)[1]
        assert felt.content == "click"
        assert buzz.nominal_db_sl is not None
        least = max(20.0, buzz.nominal_db_sl + 6)  # what the layout's default is, or more
        assert felt.nominal_db_sl == pytest.approx(least, abs=0.1)
        for one in before.contents.values():
            assert abs((one.content.frequency or 0) - (click.content.frequency or 0)) >= 30


@in_virtual_time
async def test_a_click_restates_what_its_neighbour_feels_and_only_meanwhile() -> None:
    """Foreign level: none of 40 ms is above it on this plate; contrast: by powers, by hand."""
    async with fingers_on(table(), PLAYED, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        before, during, count = await clicked(fingers)
        old, new, again = (by_finger(each)[2] for each in (before, during, fingers.applied[-1]))
        assert count == 2
        assert again == old
        figures = old.level_db_sl, old.promised_contrast_db, old.foreign_level_db_sl
        level, contrast, foreign = (10 ** ((each or 0.0) / 10) for each in figures)
        total = 10 ** ((new.foreign_level_db_sl or 0.0) / 10)
        assert total > 2 * foreign
        expected = level / (level / contrast + total - foreign)
        assert new.promised_contrast_db == pytest.approx(10 * math.log10(expected), abs=1e-6)
        assert new.verdict == ("own" if new.promised_contrast_db >= 12 else "mixed")
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
    contact = Contact(ContactKey("a", 1), 0.1, 0.1, 0.0)
    was = "mixed" if contrast == 11 else "own"
    felt = Prediction(
        contact, 20.0, None, was, promised_contrast_db=contrast, foreign_level_db_sl=foreign
    ).beside([6.0], sums_db([[6.0], [-math.inf if foreign is None else foreign]]))
    assert felt.promised_contrast_db == pytest.approx(expected, abs=1e-3)
    assert felt.foreign_level_db_sl == pytest.approx(total, abs=1e-3)
    assert felt.verdict == verdict


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
    old, new = (each.predictions[0] for each in found[1:])
    assert replace(new, held_back=None) == old
    assert "no layer is free" in (new.held_back or "")


@in_virtual_time
async def test_a_click_has_what_the_buzz_of_its_finger_leaves_of_the_stroke() -> None:
    """It asks for more: one ERA is at full stroke then, none above; what lasts stays."""
    effects = {**PLAYED.effects, "low": Buzz(level=36.0), "loud": Click(level=60.0)}
    async with fingers_on(table(), replace(PLAYED, effects=effects), at={1: LEFT}, held=0.6) as on:
        before, during, _ = await clicked(on, "loud")
        levels = Counter[str]()
        for one in during.contents.values():
            levels.update({era: tone.level for era, tone in one.drive.items()})
        assert 0.97 < max(levels.values()) <= 1.0
        lasting = [one.content for one in before.contents.values()]
        assert [one.content for one in during.contents.values()][:1] == lasting
        assert not on.refused


@in_virtual_time
async def test_what_ends_beside_a_click_ends_along_100_ms() -> None:
    """A finger slides out of its region amid the onset: its click starts as its buzz ends."""
    first = replace(LAYOUT.regions[0], on_release="click")
    layout = replace(PLAYED, regions=(first, *PLAYED.regions[1:]))
    async with fingers_on(table(), layout, at={1: (0.148, 0.08)}, held=0.03) as fingers:
        sent = len(fingers.committed)
        fingers.at[1] = (0.1515, 0.08)
        await fingers.hold(0.02)
        ((_, _, layers),) = fingers.committed[sent:]
        ramps = {any(command.level for command in one.commands): one.ramp for one in layers}
        assert ramps == {True: 10, False: 100}
