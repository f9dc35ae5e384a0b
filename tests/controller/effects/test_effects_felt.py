"""What a finger feels of an effect over every wire, against what was promised, in virtual time."""

from functools import cache

import numpy as np
import pytest

from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.detents import Detents
from controller.effects.effect import Effect
from controller.effects.layout import SurfaceLayout
from controller.effects.region import Region
from controller.effects.shapes import Rectangle
from model.table.build import build_table
from model.table.table import LocalizationTable
from paper_table import smooth_rig
from pressed_layout import WIRES, Felt, Pressed

PRESSES = 10
PLACE = (0.09, 0.07)
EFFECTS: dict[str, tuple[Effect, float, float]] = {
    "short click": (Click(duration=0.020), 0.0, 0.020),
    "click": (Click(), 0.0, 0.040),
    "long click": (Click(duration=0.120, level=14.0), 0.0, 0.120),
    "buzz": (Buzz(), 0.3, 0.1),
}
"""Effects, and over which part of each its level is felt: start and length [s]."""


@cache
def table() -> LocalizationTable:
    """Ten frequencies, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.linspace(60.0, 420.0, 10))


def pressed(effect: Effect, wire: str) -> list[Felt]:
    """What ten equal presses feel first."""
    layout = SurfaceLayout(effects={"it": effect}, elsewhere="it")
    chain = Pressed(smooth_rig(), table(), layout, wire)
    held = 0.42 if isinstance(effect, Buzz) else 0.15
    presses = chain.press(*[lambda since: PLACE] * PRESSES, held=held)
    assert all(len(each) == 1 for each in presses)
    return [felt for (felt,) in presses]


@pytest.mark.parametrize(
    ("band", "played"), [((170.0, 230.0), {180.0, 220.0}), ((205.0, 205.0), {220.0})]
)
def test_notches_of_a_slider_are_alike(band: tuple[float, float], played: set[float]) -> None:
    """Of the table's frequencies in the band or the nearest, within 2 dB wherever the finger is."""
    slider = Region("slider", Rectangle(0.02, 0.10, 0.26, 0.04), on_move="notches", band=band)
    layout = SurfaceLayout((slider,), {"notches": Detents(spacing=0.02, level=18.0)})
    (notches,) = Pressed(smooth_rig(), table(), layout, "serial").press(
        lambda since: (0.03 + 0.02 * (since // 0.2), 0.12), held=2.2
    )
    assert len(notches) == 10
    assert {felt.frequency for felt in notches} <= played
    levels = [felt.level_db_sl(0.030) for felt in notches]
    assert levels == pytest.approx([18.0] * 10, abs=2.0)


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize("name", EFFECTS)
def test_effect_is_felt_as_promised_and_alike_at_every_press(name: str, wire: str) -> None:
    """Within 3 dB of what layout and report promise, ten presses within 2 dB, on the plate."""
    effect, since, duration = EFFECTS[name]
    presses = pressed(effect, wire)
    levels = [felt.level_db_sl(duration, since=since) for felt in presses]
    assert levels == pytest.approx([effect.level] * PRESSES, abs=3.0)
    assert levels == pytest.approx([felt.promised_db_sl for felt in presses], abs=3.0)
    assert max(levels) - min(levels) <= 2.0
