"""Regions of a layout at the same time: what fingers in two and three of them are promised."""

import asyncio
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from controller.effects.effect import Effect, Region
from controller.effects.kinds import Buzz, Click
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.intent import HapticIntent
from controller.play.layer_contents import Prediction
from controller.play.selection import Chooser, Selector
from controller.sources.touch import Contact, ContactKey
from era_haptics.lab.checks import layout_picture
from era_haptics.lab.checks.layout_picture import Together, check_together, close_pairs, matrix_of
from model.config.fields import Rectangle
from set_table import phased, wants
from several_fingers import playable, table

SIZE = 0.03
WEST, EAST, NEXT, NORTH = (0.03, 0.06), (0.2448, 0.06), (0.075, 0.06), (0.1374, 0.18)
"""South-west corners [m] of regions on a plate of 0.3048 m by 0.2286 m; west and east mirrored."""


def region(name: str, corner: tuple[float, float]) -> Region:
    """A square region with a buzz of its name."""
    return Region(name, Rectangle(*corner, SIZE, SIZE), on_press=name)


def layout(*regions: Region) -> SurfaceLayout:
    """A layout of regions."""
    effects = {each.name: Buzz(level=14.0) for each in regions}
    return SurfaceLayout(regions, effects, elsewhere=None)


def fingers_at(places: Sequence[tuple[float, float]]) -> list[Contact]:
    """Fingers down at once."""
    return [Contact(ContactKey("test", n), *at, since=0.0) for n, at in enumerate(places)]


def promised_by_the_loop(contacts: Sequence[Contact], intent: HapticIntent) -> list[float]:
    """Contrast that the control loop promises each finger, of amplifiers with eight layers."""

    async def predicted() -> tuple[Prediction, ...]:
        arrived = asyncio.Event()
        selector = Selector(Chooser(table()), arrived=arrived.set)
        selector.select(contacts, intent, playable())
        if selector.is_choosing:
            await arrived.wait()
        return selector.select(contacts, intent, playable()).predictions

    found = asyncio.run(predicted())
    by_key = {each.contact.key: each.promised_contrast_db or math.nan for each in found}
    return [by_key[each.key] for each in contacts]


def test_mirrored_regions_are_promised_the_same() -> None:
    """The plate and its ERAs are symmetric: east and west of north alike, but for the draws."""
    found = check_together(
        layout(region("west", WEST), region("east", EAST), region("north", NORTH)), table()
    )
    worst = {each.regions: each.worst_db for each in found}
    assert len(worst) == 4
    assert worst["west", "north"] == pytest.approx(worst["east", "north"], abs=1.5)
    # A third finger leaves no two more than they had.
    assert worst["west", "east", "north"] < min(worst[pair] for pair in [*worst][:3]) + 0.5


def test_places_are_the_worst_of_their_regions() -> None:
    """Within both, and promised less than the centres, if anything; nearer regions less."""
    west, near, east = region("west", WEST), region("near", NEXT), region("east", EAST)
    found = check_together(layout(west, near, east), table())
    by_name = {each.regions: each for each in found}
    for pair, each in by_name.items():
        shapes = [one.shape for one in (west, near, east) if one.name in pair]
        assert all(shape.contains(*at) for shape, at in zip(shapes, each.at, strict=True))
        if len(pair) == 2:
            fingers = [wants(shape.centre, level_db_sl=14.0) for shape in shapes]
            centred = phased(table(), fingers, min_contrast_db=-math.inf)
            assert centred.promised_worst_db is not None
            assert each.worst_db <= centred.promised_worst_db
            assert each.worst_db <= min(each.contrasts)
    assert by_name["west", "near"].worst_db < by_name["west", "east"].worst_db


def test_pairs_that_are_felt_as_one_are_named() -> None:
    """Those below 6 dB, the rule's bound of what is mixed, the worst first; none of three."""
    at, worst = (0.0, 0.0), {"ab": 3.2, "ac": 6.0, "bc": -1.0, "abc": -5.0}
    found = [Together((*names,), (at, at), (db, db), db, ()) for names, db in worst.items()]
    said = close_pairs(found)
    assert "2 of 3 pairs" in said
    assert said.index("b with c -1.0 dB") < said.index("a with b 3.2 dB")
    assert close_pairs(found[1:2]) == ""


def test_verdicts_follow_the_rule_and_what_regions_say() -> None:
    """Below 12 dB mixed; where a region requires its own or is protected another is held back."""
    near = region("near", (0.12, 0.06))
    (mixed,) = check_together(layout(region("west", WEST), near), table())
    assert 6 < mixed.worst_db < 12
    assert "mixed" in mixed.verdicts
    for said in (replace(near, is_own=True), replace(near, is_protected=True)):
        (found,) = check_together(layout(region("west", WEST), replace(said, priority=1)), table())
        assert found.verdicts[0] == "held back"
        assert (found.at, found.worst_db) == (mixed.at, mixed.worst_db)


@pytest.mark.parametrize(
    "effect", [Buzz(level=14.0, modulation=20.0), Click(level=14.0)], ids=["rough", "click"]
)
def test_what_comes_and_goes_is_promised_as_the_daemon_promises_it(effect: Effect) -> None:
    """Side bands and short effects leak more than a steady tone, by what a selection says."""
    steady = layout(region("west", WEST), region("north", NORTH))
    changed = replace(steady, effects={**steady.effects, "west": effect})
    (before,), (found,) = (check_together(each, table()) for each in (steady, changed))
    assert found.at == before.at
    assert found.worst_db < before.worst_db - 0.2
    contacts, player = fingers_at(found.at), EffectPlayer(changed)
    promised = promised_by_the_loop(contacts, player.intent(contacts, 0.0))
    assert found.contrasts[0] == pytest.approx(promised[0], abs=0.3)
    assert promised[1] <= found.contrasts[1] + 0.3  # less while a click plays


def test_matrix_has_two_below_and_three_above_the_diagonal() -> None:
    """Of three above it the least with any third."""
    regions = [region(name, at) for name, at in zip("abcd", (WEST, EAST, NEXT, NORTH), strict=True)]
    found = check_together(layout(*regions), table())
    names, promised = matrix_of(found)
    assert names == [*"abcd"]
    assert np.isnan(np.diag(promised)).all()
    for one, other in pairwise(range(4)):
        (pair,) = (each for each in found if each.regions == (names[one], names[other]))
        third = min(
            each.worst_db
            for each in found
            if len(each.regions) == 3 and {names[one], names[other]} <= {*each.regions}
        )
        assert (promised[other, one], promised[one, other]) == (pair.worst_db, third)


def test_of_many_regions_the_nearest_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bound on what is computed keeps the pair that is hardest to tell apart."""
    monkeypatch.setattr(layout_picture, "MAX_PAIRS", 1)
    monkeypatch.setattr(layout_picture, "MAX_TRIPLES", 0)
    regions = [region(name, at) for name, at in zip("abcd", (WEST, EAST, NEXT, NORTH), strict=True)]
    silent = Region("silent", Rectangle(0.03, 0.10, SIZE, SIZE))
    (found,) = check_together(layout(*regions, silent), table())
    assert found.regions == ("a", "c")
