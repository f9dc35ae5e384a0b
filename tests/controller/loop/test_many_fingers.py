"""As many fingers as there may be, on the chain in virtual time."""

import asyncio
from collections.abc import Mapping
from itertools import pairwise

import pytest

from chain import Position
from controller.effects.buzz import Buzz
from controller.effects.layout import SurfaceLayout
from controller.effects.region import Region
from drivers.host.timing import HEARTBEAT
from model.config.shapes import Rectangle
from several_fingers import answers_take, fingers_on, table
from virtual_loop import in_virtual_time

WHOLE = Region("all", Rectangle(0.0, 0.0, 0.31, 0.23), on_press="buzz")
LAYOUT = SurfaceLayout((WHOLE,), {"buzz": Buzz(level=14.0)}, elsewhere=None)


def spread(count: int, *, above: int = 0) -> Mapping[int, Position]:
    """Fingers 4 cm apart or more, numbered from one on."""
    places = [(0.04 + 0.055 * (n % 5), 0.035 + 0.05 * (n // 5)) for n in range(count)]
    return {above + number: at for number, at in enumerate(places, start=1)}


@pytest.mark.parametrize("count", [10, 20])
@in_virtual_time
async def test_all_fingers_of_a_region_feel_its_effect(count: int) -> None:
    """In one layer of eight, within the time of an answer; a further one is refused and counted."""
    async with fingers_on(table(), LAYOUT) as fingers:
        fingers.at = {**spread(count)}
        await fingers.hold(0.4)
        applied = fingers.applied[-1]
        assert {each.contact.key.id for each in applied.targets} == fingers.at.keys()
        assert {each.content for each in applied.targets} == {"buzz"}
        assert {each.verdict for each in applied.targets} <= {"own", "mixed", "shared"}
        assert len(applied.contents) == 1
        levels = fingers.levels_db_sl()
        assert levels.keys() == fingers.at.keys()
        assert min(levels.values()) > 5
        assert applied.targets[0].level_db_sl is not None
        if count == 20:
            fingers.must_be_felt = False
            fingers.at[21] = (0.15, 0.21)
            await fingers.hold(0.1)
            assert fingers.controller.rejects.counts["too_many"] >= 1
            assert len(fingers.applied[-1].contacts) == 20


@pytest.mark.parametrize("what", ["stop", "lift"])
@in_virtual_time
async def test_ten_moving_fingers_with_slow_answers_starve_nothing(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 0.4 s each: heartbeats as ever, and silence as soon as at rest; nothing plays after it."""
    loop = asyncio.get_running_loop()
    async with fingers_on(table(), LAYOUT, breaks="touch") as fingers:
        asked, rest = answers_take(monkeypatch, 0.4), spread(10)

        def move(since: float) -> None:
            fingers.at = {id: (x + 0.03 * since, y) for id, (x, y) in rest.items()}

        await fingers.hold(1.5, move)
        assert len(asked) >= 3
        assert fingers.applied
        feeding = fingers.far_end.times("Ping", "Set", "Commit")
        assert max(later - sooner for sooner, later in pairwise(feeding)) <= HEARTBEAT + 0.01
        begin, count = loop.time(), len(fingers.committed)
        if what == "stop":
            fingers.witness.operator_command(begin, "stop")
            stopped = await fingers.controller.stop()
            assert all(each.is_confirmed for each in stopped.values())
            assert loop.time() - begin < 0.02
        else:
            fingers.at = {}
            await fingers.hold(0.02)
            assert fingers.committed[count][2] == ()
            assert fingers.committed[count][0] - begin < 0.005
        await fingers.hold(1.0)
        assert fingers.levels() == {"main": (0.0,) * 4}
        assert len(fingers.committed) <= count + 1
