"""Files at fingers in virtual time: beside other effects and each other, at the edge."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from controller.content.pattern import Pattern
from controller.effects.effect import Region
from controller.effects.kinds import Buzz, File
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from model.answer.answer_report import Timing
from model.answer.stimulus import STRONGEST
from model.config.fields import Circle
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from several_fingers import LEFT, Fingers, fingers_on, table
from sim.far_ends.wire_assignment import Wire
from virtual_lines import in_virtual_time

SWELL = Pattern(1.5, ((0.0, 0.3), (0.7, 1.0), (1.5, 0.2)), ((0.0, 0.4),))
SHARPER = Pattern(1.5, SWELL.intensity, ((0.0, 0.7),))
FADING = Pattern(1.0, ((0.0, 1.0), (0.2, 0.3), (0.5, 1.0), (1.0, 0.5)), ((0.0, 0.1),))


def file_of(pattern: Pattern, of: LocalizationTable, *, loop: bool = False) -> File:
    """A file at 14 dB SL."""
    return File.of(pattern, name="it", level_db_sl=14.0, loop=loop).for_table(of.frequencies)


@in_virtual_time
async def test_of_a_buzz_and_a_file_the_later_is_felt_then_what_is_left_of_the_other() -> None:
    """By hand: 0.4 s into the file it has 12.8 dB SL, after a buzz of half a second 11.6 at 1.3 s.

    The buzz of the finger that rests goes on once both are over.
    """
    short, file = Buzz(level=14.0, duration=0.5), file_of(SWELL, table())
    layout = SurfaceLayout(effects={"it": file, "short": short, "buzz": Buzz()}, elsewhere="buzz")
    async with fingers_on(table(), layout, at={1: LEFT}, held=0.5) as fingers:

        def felt() -> tuple[str | None, float]:
            (target,) = fingers.applied[-1].targets
            return target.content, 20 * np.log10(max(fingers.far_end.levels))

        fingers.play("it")
        await fingers.hold(0.41)
        name, before = felt()
        assert name == "it"
        await fingers.hold(0.3)
        fingers.play("short")
        await fingers.hold(0.3)
        assert felt()[0] == "short"
        await fingers.hold(0.3)
        name, after = felt()
        assert (name, after - before) == ("it", pytest.approx(11.6 - 12.8, abs=0.15))
        await fingers.hold(0.5)
        assert felt()[0] == "buzz"


@pytest.mark.parametrize("at", [(0.0, 0.1), (0.01, 0.1), (0.001, 0.001), (0.3048, 0.2286)])
@in_virtual_time
async def test_a_file_has_its_level_at_the_edge_and_in_corners(at: tuple[float, float]) -> None:
    """14 dB SL as a mean over the tip where it has risen slowly; nothing is refused."""
    pattern = Pattern(2.0, ((0.0, 0.01), (0.3, 1.0), (2.0, 1.0)), ((0.0, 0.5),))
    layout = SurfaceLayout(effects={"it": file_of(pattern, table())}, elsewhere="it")
    async with fingers_on(table(), layout, at={1: at}, held=1.0) as fingers:
        ((_, weights, own, _),) = fingers.reached()
        level = 20 * np.log10(own @ weights / weights.sum())
        assert level == pytest.approx([14.0], abs=0.1)
        assert not fingers.refused


@cache
def eight() -> LocalizationTable:
    """Of the example with eight ERAs."""
    rig = load_rig(Path(__file__).parents[3] / "examples" / "eight_eras.yaml")
    return build_table(rig, frequencies=np.arange(60.0, 321.0, 20.0), drive_mode="phased")


@in_virtual_time
async def test_three_fingers_feel_three_files_apart() -> None:
    """Each at its own frequency with the contrast that it is promised, turn after turn.

    The witness finds every piece of each on the wire where the one before ends.
    """
    plate, files = eight().plate, (SWELL, SHARPER, FADING)
    places = [(0.2, 0.25), (0.8, 0.2), (0.4, 0.85)]
    at = {n: (x * plate.length, y * plate.width) for n, (x, y) in enumerate(places, start=1)}
    layout = SurfaceLayout(
        tuple(Region(f"at{n}", Circle(*each, 0.03), on_press=f"f{n}") for n, each in at.items()),
        {f"f{n}": file_of(each, eight(), loop=True) for n, each in enumerate(files, start=1)},
        elsewhere=None,
    )
    async with Fingers.armed(
        Wire("serial", speed=921_600, unpluggable=True),
        load_rig(Path(__file__).parents[3] / "examples" / "eight_eras.yaml"),
        eight(),
        intent_source=EffectPlayer(layout),
        timing=Timing(eight()),
    ) as fingers:
        fingers.at = at
        await fingers.hold(0.6)
        own, foreign = np.full((2, 3), 1e-9)
        for _ in range(50):
            await fingers.hold(0.03)
            for id, weights, lasting, others in fingers.reached(over=STRONGEST):
                power = ((lasting @ weights / weights.sum()) ** 2).max(initial=0)
                own[id - 1] = max(own[id - 1], power)
                loudest = (others**2).sum(axis=0).max(initial=0)
                foreign[id - 1] = max(foreign[id - 1], loudest)
        targets = sorted(fingers.applied[-1].targets, key=lambda each: each.contact.key.id)
        promised = np.array([each.promised_contrast_db for each in targets])
        assert len({each.frequency for each in targets}) == len(targets) == 3
        assert (10 * np.log10(own / foreign) > promised).all()
        assert not fingers.refused
