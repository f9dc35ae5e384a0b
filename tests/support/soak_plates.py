"""Plates of the soak: the founding paper's, and that of a weekend on exciters, with a layout."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np

from controller.content.pattern import Pattern, Transient
from controller.effects.effect import Region
from controller.effects.kinds import Buzz, File, Texture
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.play.intent import IntentSource
from model.answer.answer_report import Timing
from model.config.fields import Rectangle
from model.finger import STRONG_DB_SL, Grid
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import TableProblem, solve_table
from newest_contact import BuzzNewestContact
from paper_plate import make_paper_rig
from rig_on_wire import on_amplifiers
from small_table import small_table

_WEEKEND = Path(__file__).parents[2] / "examples/weekend/rig.yaml"
_FREQUENCIES = np.array([110.0, 170.0, 250.0])
_COURSE = Pattern(
    0.8,
    ((0.0, 0.3), (0.4, 1.0), (0.8, 0.2)),
    ((0.0, 0.2), (0.8, 0.8)),
    (Transient(0.1, 1.0, 0.5),),
)
_EFFECTS: Mapping[str, tuple[str | None, str | None]] = {
    "course": ("course", None),
    "clicks": ("click", "texture"),
    "taps": ("success", None),
    "short": ("short", "click"),
}
"""What is felt on a press and on a move in a quarter of the plate each; a buzz on its rims."""


def soak_table(plate: str) -> LocalizationTable:
    """The table of a plate by name."""
    return small_table() if plate == "eras" else _board_table()


@cache
def soak_timing(plate: str) -> Timing:
    """Its timing."""
    return Timing(soak_table(plate))


@cache
def soak_rig(plate: str, amplifiers: tuple[str, ...]) -> Rig:
    """Its rig, on amplifiers of these names in turn, or on its own one."""
    rig = make_paper_rig(12, 9) if plate == "eras" else load_rig(_WEEKEND)
    return on_amplifiers(rig, amplifiers) if amplifiers else rig


def soak_source(plate: str) -> IntentSource:
    """What its fingers shall feel, as a new process begins it."""
    return BuzzNewestContact() if plate == "eras" else EffectPlayer(_layout())


@cache
def _board_table() -> LocalizationTable:
    problem = TableProblem(load_rig(_WEEKEND), _FREQUENCIES, Grid(4, 3))
    return solve_table(problem, drive_mode="phased")


@cache
def _layout() -> SurfaceLayout:
    """Four quarters of the board with effects of their own, and a buzz around them."""
    plate = _board_table().plate
    width, height, rim = 0.42 * plate.length, 0.42 * plate.width, 0.04 * plate.length
    corners = [(rim, rim), (plate.length - rim - width, rim)]
    corners += [(x, plate.width - rim - height) for x, _ in corners]
    regions = [
        Region(name, Rectangle(*corner, width, height), on_press=press, on_move=move)
        for (name, (press, move)), corner in zip(_EFFECTS.items(), corners, strict=True)
    ]
    effects = {
        **default_effects(STRONG_DB_SL),
        "course": File.of(_COURSE, name="course", level_db_sl=STRONG_DB_SL, loop=True),
        "short": Buzz(level=STRONG_DB_SL, duration=0.1),
        "texture": Texture(level=STRONG_DB_SL),
    }
    return SurfaceLayout(tuple(regions), effects).for_table(_board_table().frequencies)
