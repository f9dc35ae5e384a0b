"""What leaks to a finger that has moved since its answer, against the fingertips of the plate."""

import asyncio
import math

import numpy as np
import pytest

from controller.daemon.api_views import PlateView
from controller.effects.buzz import Buzz
from controller.effects.layout import SurfaceLayout
from controller.effects.region import Region
from controller.sources.contacts import Contact, ContactKey
from model.config.shapes import Rectangle
from model.finger.perception import detection_threshold
from several_fingers import ABOVE, LEFT, RIGHT, Fingers, fingers_on, table
from virtual_loop import in_virtual_time

LAYOUT = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="right"),
    ),
    {"left": Buzz(level=14.0), "right": Buzz(level=14.0)},
    elsewhere=None,
)


def statuses(fingers: Fingers) -> dict[int, float]:
    """What the status says that leaks to each finger [dB SL]."""
    contacts = tuple(
        Contact(ContactKey("panel", id), *at, since=0.0) for id, at in fingers.at.items()
    )
    view = PlateView(lambda key: None, contacts, fingers.applied[-1])
    found = {each.id: each.leak_db_sl for each in view.statuses_now(table())}
    return {id: -math.inf if level is None else level for id, level in found.items()}


def measured(fingers: Fingers) -> dict[int, float]:
    """Level [dB SL] of what is not its own at each finger's loudest point, of the last seconds."""
    now, bench = asyncio.get_running_loop().time(), fingers.far.bench
    bench.advance(now)
    own = {each.contact.key.id: each.frequency for each in fingers.applied[-1].targets}
    found = {}
    for name, felt in bench.felt(now - 0.25, now).items():
        thresholds = detection_threshold(np.array(felt.frequencies), bench.rig.threshold)
        others = ~np.isclose(felt.frequencies, own.get(int(name)) or 0.0, atol=0.2)
        power = ((felt.amplitude / thresholds[:, None]) ** 2)[others].sum(axis=0)
        found[int(name)] = float(10 * np.log10(power.max()))
    return found


@in_virtual_time
async def test_status_says_what_leaks_to_a_finger_that_has_moved() -> None:
    """By less than 8 mm no weights change: within a decibel of what is measured there."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.2) as fingers:
        rested = statuses(fingers)
        assert rested == pytest.approx(measured(fingers), abs=1.0)
        count = len(fingers.applied)
        fingers.at[3] = (ABOVE[0] + 0.0055, ABOVE[1] - 0.0055)
        await fingers.hold(1.2)
        assert len(fingers.applied) == count
        moved = statuses(fingers)
        assert moved == pytest.approx(measured(fingers), abs=1.0)
        assert moved[3] > rested[3]


@in_virtual_time
async def test_weights_follow_a_finger_at_half_a_metre_a_second() -> None:
    """10 cm in 0.2 s: several answers on the way, after which as little leaks as before."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.0) as fingers:
        rested, count = statuses(fingers)[3], len(fingers.applied)
        on_the_way = []

        def way(since: float) -> None:
            on_the_way.append(statuses(fingers)[3])
            fingers.at[3] = (ABOVE[0] + 0.5 * since, ABOVE[1])

        await fingers.hold(0.2, way)
        changes = [each.time for each in fingers.applied[count:]]
        assert 4 <= len(changes) <= 0.2 / 0.017 + 1
        await fingers.hold(1.0)
        assert statuses(fingers)[3] == pytest.approx(measured(fingers)[3], abs=1.0)
        assert max(on_the_way) > rested
        assert statuses(fingers)[3] < max(on_the_way)


@in_virtual_time
async def test_nothing_leaks_without_fingers() -> None:
    """The status is read when the last has lifted and its silence is not confirmed yet."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT}, held=0.3) as fingers:
        view = PlateView(lambda key: None, (), fingers.applied[-1])
        assert view.statuses_now(table()) == []
