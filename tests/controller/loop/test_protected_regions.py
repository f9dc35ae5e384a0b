"""Regions whose fingers feel their own or nothing, and regions where others are not noticed."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from controller.daemon.api_views import PlateView
from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.layout import SurfaceLayout
from controller.effects.region import Region
from model.config.shapes import Rectangle
from model.finger.perception import detection_threshold
from several_fingers import ABOVE, LEFT, RIGHT, Fingers, fingers_on, table
from virtual_loop import in_virtual_time

UPPER = Rectangle(0.0, 0.13, 0.3, 0.09)
LAYOUT = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="right"),
        Region("above", UPPER, is_protected=True),
    ),
    {"left": Buzz(level=16.0), "right": Buzz(level=14.0), "above": Buzz(level=14.0)},
    elsewhere=None,
)


def levels_at(fingers: Fingers, id: int) -> float:
    """Level [dB SL] of all tones at the loudest point of a finger over the last quarter second."""
    now = asyncio.get_running_loop().time()
    bench = fingers.far.bench
    bench.advance(now)
    felt = bench.felt(now - 0.25, now)[str(id)]
    thresholds = detection_threshold(np.array(felt.frequencies), bench.rig.threshold)
    power = ((felt.amplitude / thresholds[:, None]) ** 2).sum(axis=0)
    return float(10 * np.log10(max(power.max(initial=0), 1e-9)))


@in_virtual_time
async def test_nothing_plays_that_a_protected_finger_would_notice() -> None:
    """Both contents are silent while it rests, each with its reason, and play once it has lifted.

    16 dB SL would need 26 dB of contrast there, of which four ERAs promise fewer than 20.
    """
    async with fingers_on(
        table(), LAYOUT, breaks="touch", at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=0.6
    ) as fingers:
        assert levels_at(fingers, 3) < -10
        silenced = fingers.silenced[-1]
        assert {each.contact.key.id for each in silenced.targets} == {1, 2}
        view = PlateView(lambda key: "effect", silenced.contacts, silenced=silenced)
        for status in view.contact_statuses():
            assert (status.verdict == "held back") is (status.id != 3)
            assert ("protected" in (status.held_back or "")) is (status.id != 3)
        del fingers.at[3]
        await fingers.hold(1.0)
        assert {each.contact.key.id for each in fingers.applied[-1].targets} == {1, 2}
        assert levels_at(fingers, 1) > 14
        fingers.at[3] = ABOVE
        await fingers.hold(1.0)
        assert levels_at(fingers, 3) < -10


@pytest.mark.parametrize(
    ("effect", "is_played"),
    [(Buzz(level=0.5), True), (Buzz(level=12.0), False), (Click(level=20.0), False)],
)
@in_virtual_time
async def test_one_content_beside_a_protected_finger(effect: Buzz | Click, is_played: bool) -> None:
    """Played if at most -10 dB SL reach that finger, of a click over its duration; else silent."""
    layout = replace(LAYOUT, effects={**LAYOUT.effects, "left": effect})
    async with fingers_on(table(), layout, breaks="touch", at={3: ABOVE}, held=0.2) as fingers:
        fingers.at[1] = LEFT
        await fingers.hold(1.0)
        assert bool(fingers.applied) is is_played
        assert levels_at(fingers, 3) < -10
        if is_played:
            (applied,) = fingers.applied
            (quiet,) = applied.quiet_levels.values()
            assert levels_at(fingers, 3) < quiet < -10


@in_virtual_time
async def test_a_protected_finger_feels_its_own_effect() -> None:
    """That of the others is held back for it, whatever their priorities."""
    above = Region("above", UPPER, on_press="above", is_protected=True, priority=0)
    left = replace(LAYOUT.regions[0], priority=5)
    async with fingers_on(
        table(), replace(LAYOUT, regions=(left, above)), at={1: LEFT, 3: ABOVE}, held=1.0
    ) as fingers:
        verdicts = {each.contact.key.id: each.verdict for each in fingers.applied[-1].targets}
        assert verdicts == {1: "held back", 3: "own"}
        assert levels_at(fingers, 3) > 12


@in_virtual_time
async def test_a_region_with_its_own_is_never_mixed() -> None:
    """Of three fingers on four ERAs one is mixed; where it wants its own, another gives way."""
    third = Region("above", UPPER, on_press="above", priority=1)
    for is_own in (False, True):
        regions = (*LAYOUT.regions[:2], replace(third, is_own=is_own))
        async with fingers_on(
            table(), replace(LAYOUT, regions=regions), at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.0
        ) as fingers:
            targets = fingers.applied[-1].targets
            verdicts = {each.contact.key.id: each.verdict for each in targets}
            assert ("held back" in verdicts.values()) is is_own
            if is_own:
                assert verdicts[3] == "own"
                assert all(level > 12 for level in fingers.contrasts().values())


@in_virtual_time
async def test_fingers_that_may_share_say_whose_content_they_feel() -> None:
    """Two near fingers of different effects: one vibration, of the name of the higher priority."""
    regions = (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left", may_share=True),
        Region("right", Rectangle(0.15, 0.0, 0.15, 0.12), "right", may_share=True, priority=1),
    )
    async with fingers_on(
        table(), replace(LAYOUT, regions=regions), at={1: (0.138, 0.06), 2: (0.165, 0.06)}, held=1.0
    ) as fingers:
        applied = fingers.applied[-1]
        view = PlateView(lambda key: ("", "left", "right")[key.id], applied.contacts, applied)
        first, second = view.contact_statuses()
        assert (first.verdict, first.effect, first.feels) == ("shared", "left", "right")
        assert (second.effect, second.feels) == ("right", "right")
        assert first.frequency_hz == second.frequency_hz
