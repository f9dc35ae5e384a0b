"""What a finger feels of an effect over every wire, against what was promised, in virtual time."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.detents import Detents
from controller.effects.dial import Dial
from controller.effects.effect import Effect
from controller.effects.layout import SurfaceLayout
from controller.effects.ramp import Ramp
from controller.effects.region import Region
from long_form import in_turn
from model.config.shapes import Circle
from model.table.build import build_table
from model.table.table import LocalizationTable
from paper_table import smooth_rig
from pressed_layout import WIRES, Felt, Pressed

PRESSES = {"modbus-rtu": 6}
"""Equal presses, each at another phase of the heartbeats; on the other wires `FEW`."""
FEW = 3
PLACE, CENTRE = (0.09, 0.07), (0.09, 0.10)
Way = Callable[[float], tuple[float, float]]


def rest(since: float) -> tuple[float, float]:
    """A finger that stays where it came down."""
    return PLACE


def step(since: float) -> tuple[float, float]:
    """A finger that moves by 8 mm after a tenth of a second."""
    return (PLACE[0] + (0.008 if since > 0.1 else 0.0), PLACE[1])


@dataclass(frozen=True)
class Case:
    """An effect and over which part of it [s] its level is felt, and the way of the finger."""

    effect: Effect
    duration: float
    since: float = 0.0
    way: Way = rest
    held: float = 0.15


CASES = {
    "short click": Case(Click(duration=0.020), 0.020),
    "click": Case(Click(), 0.040),
    "long click": Case(Click(duration=0.120, level=14.0), 0.120, held=0.2),
    "short buzz": Case(Buzz(duration=0.300, level=16.0), 0.300, held=0.4),
    "buzz": Case(Buzz(), 0.1, since=0.3, held=0.42),
    "ramp": Case(Ramp(start_level=14.0, duration=0.4), 0.08, since=0.32, held=0.42),
    "detents": Case(Detents(), 0.030, way=step, held=0.2),
    "dial": Case(Dial(), 0.030, way=step, held=0.2),
}


@cache
def table() -> LocalizationTable:
    """Ten frequencies, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.linspace(60.0, 420.0, 10))


@cache
def pressed(case: Case, wire: str) -> list[Felt]:
    """What equal presses feel."""
    where = "on_move" if case.effect.is_for_motion else "on_press"
    region = Region("all", Circle(*CENTRE, 0.06), **{where: "it"})
    layout = SurfaceLayout((region,), {"it": case.effect}, elsewhere=None)
    chain = Pressed(smooth_rig(), table(), layout, wire)
    presses = chain.press(*[case.way] * PRESSES.get(wire, FEW), held=case.held)
    assert all(len(each) == 1 for each in presses)
    return [felt for (felt,) in presses]


@pytest.mark.parametrize(("name", "wire"), in_turn(CASES, [*WIRES]))
def test_effect_is_felt_as_promised_and_alike_at_every_press(name: str, wire: str) -> None:
    """Within 3 dB of what layout and report promise, all presses within 2 dB, on the plate."""
    case = CASES[name]
    presses = pressed(case, wire)
    levels = [felt.level_db_sl(case.duration, since=case.since) for felt in presses]
    assert levels == pytest.approx([case.effect.level] * len(presses), abs=3.0)
    if name != "ramp":  # which reports each of its steps
        assert levels == pytest.approx([felt.promised_db_sl for felt in presses], abs=3.0)
    assert max(levels) - min(levels) <= 2.0
