"""Check of a surface layout on the plate of a table: how every region will feel."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.check.representative import strongest_target
from controller.check.simulated_touch import Position, SimulatedTouch, TouchSimulator
from controller.effects.effect import ON_RELEASE, Region
from controller.effects.layout import ELSEWHERE, SurfaceLayout
from controller.effects.player import CLICK_ABOVE_DB, NOTICED_ABOVE_DB
from controller.play.intent import Target, band_problem
from model.processes import Progress, unseen
from model.structure.plate import Plate
from model.table.table import LocalizationTable

LEVEL_TOLERANCE, MARGIN_TOLERANCE = 2.0, 4.0
"""How far [dB] a level may be off, and above where it is promised on nine of ten plates."""

_ALIKE = 1.25  # ratio of frequencies that hardly differ in feel

MAX_TOUCHES, MAX_POSITIONS = 30, 120  # of one region, of all
_MIN_STEP = 0.008  # m; nearer touches hardly differ
_RESTING_AWAY = 0.06  # m; at least, from a touch to a resting finger


@dataclass(frozen=True)
class CheckedEffect:
    """An effect of a region as it will feel.

    on: the key that plays it; promised_db_sl: None for as strong as the neighbours allow; touches:
    each position alone, then with a resting finger; area [m²]: of the region for each position.
    """

    region: str
    effect: str
    on: str
    promised_db_sl: float | None
    touches: tuple[SimulatedTouch, ...]
    problems: tuple[str, ...]

    @property
    def felt(self) -> list[float]:
        """Levels over the effect [dB SL] of all touches that are felt."""
        return [each.felt_db_sl for each in self.touches if each.felt_db_sl is not None]

    @property
    def contrasts(self) -> list[float]:
        """Level above that of the resting finger on the nominal plate [dB]."""
        return [
            each.felt_db_sl - each.resting_db_sl
            for each in self.touches
            if each.felt_db_sl is not None and each.resting_db_sl is not None
        ]

    @property
    def promised_contrasts(self) -> list[float]:
        """Level above that of the resting finger on nine of ten plates [dB]."""
        found = [each.promised_contrast_db for each in self.touches]
        return [each for each in found if each is not None]

    @property
    def held_back_db(self) -> float:
        """By how much [dB] a touch is weaker at most so that the resting finger feels no more."""
        return max((each.held_back_db for each in self.touches), default=0.0)

    @property
    def exposure_m_s2(self) -> float:
        """Weighted acceleration of a touch at most [m/s²], root mean square (`exposures`)."""
        return max((each.exposure_m_s2 for each in self.touches), default=0.0)

    @property
    def frequencies(self) -> list[float]:
        """All frequencies that play [Hz], ascending."""
        return sorted({frequency for each in self.touches for frequency in each.frequencies})

    def as_json(self) -> dict[str, Any]:
        """Return it as `era layout check --json` prints it."""
        return {
            "region": self.region,
            "effect": self.effect,
            "on": self.on,
            "promised_db_sl": self.promised_db_sl,
            "felt_db_sl": summary(self.felt),
            "promised_contrast_db": summary(self.promised_contrasts),
            "felt_contrast_db": summary(self.contrasts),
            "held_back_db": self.held_back_db,
            "exposure_m_s2": self.exposure_m_s2,
            "frequency_hz": self.frequencies,
            "touches": len(self.touches),
            "problems": [*self.problems],
        }


def summary(values: Sequence[float]) -> dict[str, float | None]:
    """Return minimum, median and maximum; None without values."""
    if not values:
        return {"min": None, "median": None, "max": None}
    return {
        "min": float(min(values)),
        "median": float(np.median(values)),
        "max": float(max(values)),
    }


def check_layout(
    layout: SurfaceLayout,
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> list[CheckedEffect]:
    """Simulate touches over every region of a layout, alone and with a resting second finger.

    progress: called with the number of effects checked, and of all.
    """
    simulator = TouchSimulator(table)
    parts = [*layout.uses()]
    checked = []
    count = max(1, min(MAX_TOUCHES, MAX_POSITIONS // max(1, len(parts))))
    for number, (region, on, name) in enumerate(parts):
        progress(number, len(parts))
        checked.append(_check(layout, region, on, name, table, simulator, count))
    progress(len(parts), len(parts))
    return checked


def _check(
    layout: SurfaceLayout,
    region: Region | None,
    on: str,
    name: str,
    table: LocalizationTable,
    simulator: TouchSimulator,
    count: int,
) -> CheckedEffect:
    places, area = raster(layout, region, table.plate, count)
    start = region.shape.centre if region is not None else (places[0] if places else (0.0, 0.0))
    target = strongest_target(layout, name, region, at=start)
    called = ELSEWHERE if region is None else region.name
    if target is None or not places:
        why = "is felt nowhere" if target is None else "is covered by later regions"
        level = layout.level_of(name, region)
        return CheckedEffect(called, name, on, level, (), (f"{name} {why}",))
    is_fixed = target.band is not None or (target.pulse is not None and target.pulse.is_raised)
    touches = [
        simulator.touch(target, at, resting)
        for number, at in enumerate(places)
        for resting in (None, _resting(table.plate, at, number))
    ]
    problems = [
        *_silent(target, touches, area),
        *_off_level(target.level_db_sl, touches, area, has_margin=not is_fixed),
        *_unnoticed(layout, region, on, name, target, at=start),
        *_off_band(target.band, table, touches, must_be_alike=layout.effects[name].is_for_motion),
    ]
    return CheckedEffect(called, name, on, target.level_db_sl, tuple(touches), tuple(problems))


def raster(
    layout: SurfaceLayout, region: Region | None, plate: Plate, count: int = MAX_TOUCHES
) -> tuple[list[Position], float]:
    """Return at most so many positions [m], evenly over a region, and the area of each [m²].

    Without what later regions cover.
    """
    corners = [(0.0, 0.0), (plate.length, plate.width)]
    if region is not None:
        corners = [*region.shape.corners()]
    (x0, y0), (x1, y1) = np.min(corners, axis=0), np.max(corners, axis=0)
    step = _MIN_STEP
    while True:
        nx, ny = (max(1, math.floor(size / step + 1e-9)) for size in (x1 - x0, y1 - y0))
        dx, dy = (x1 - x0) / nx, (y1 - y0) / ny
        places = [
            (float(x0 + (column + 0.5) * dx), float(y0 + (row + 0.5) * dy))
            for row in range(ny)
            for column in range(nx)
        ]
        found = [at for at in places if layout.region_at(*at) is region]
        if len(found) <= count:
            return found, dx * dy
        step *= 1.1


def _resting(plate: Plate, at: Position, number: int) -> Position:
    """Return where a second finger rests: each time in another quarter of the plate."""
    quarters = [(x * plate.length, y * plate.width) for x in (0.25, 0.75) for y in (0.25, 0.75)]
    away = [each for each in quarters if math.dist(each, at) >= _RESTING_AWAY]
    if not away:
        return max(quarters, key=lambda each: math.dist(each, at))
    return away[number % len(away)]


def _silent(target: Target, touches: Sequence[SimulatedTouch], area: float) -> Iterator[str]:
    # As strong as the neighbours allow may be nothing.
    can_be = target.level_db_sl is None
    silent = [each for each in touches if each.reason is not None and not (can_be and each.resting)]
    if silent:
        yield f"nothing is felt {_where(silent, touches, area)}: {silent[0].reason}"


def _off_level(
    promised: float | None, touches: Sequence[SimulatedTouch], area: float, *, has_margin: bool
) -> Iterator[str]:
    if promised is None:
        return
    above = MARGIN_TOLERANCE if has_margin else LEVEL_TOLERANCE
    for sense, words, tolerance in ((-1, "below", LEVEL_TOLERANCE), (1, "above", above)):
        off = {
            each: sense * (each.felt_db_sl - promised)
            for each in touches
            if each.felt_db_sl is not None and sense * (each.felt_db_sl - promised) > tolerance
        }
        if off:
            yield (
                f"level is up to {max(off.values()):.1f} dB {words} {promised:g} dB SL "
                f"{_where([*off], touches, area)}"
            )


def _unnoticed(
    layout: SurfaceLayout,
    region: Region | None,
    on: str,
    name: str,
    click: Target,
    *,
    at: Position,
) -> Iterator[str]:
    """Short effects whose given level hides below what lasts in the region."""
    if on == ON_RELEASE or not click.is_short or not layout.gives_level(name, region):
        return
    for other, beside, lasting in layout.uses():
        if other is not region or beside in (on, ON_RELEASE):
            continue
        felt = strongest_target(layout, lasting, region, at=at)
        if felt is None or felt.is_short or felt.level_db_sl is None or click.level_db_sl is None:
            continue
        if click.level_db_sl < felt.level_db_sl + NOTICED_ABOVE_DB:
            yield (
                f"level {click.level_db_sl:g} dB SL is less than {NOTICED_ABOVE_DB:g} dB above "
                f"{lasting}, {felt.level_db_sl:g} dB SL, beside which it is hardly noticed; raise "
                f"it, or give {name} no level: it is {CLICK_ABOVE_DB:g} dB above then"
            )


def _off_band(
    band: tuple[float, float] | None,
    table: LocalizationTable,
    touches: Sequence[SimulatedTouch],
    *,
    must_be_alike: bool,
) -> Iterator[str]:
    played = sorted({frequency for each in touches for frequency in each.frequencies})
    if not played:
        return
    if band is None:
        if must_be_alike and played[-1] > _ALIKE * played[0]:
            yield (
                f"frequency is {played[0]:g} to {played[-1]:g} Hz, another at every place; give it "
                "a frequency or a band"
            )
        return
    problem = band_problem(band, table.frequencies)
    if problem is not None:
        yield problem


def _where(some: Sequence[SimulatedTouch], touches: Sequence[SimulatedTouch], area: float) -> str:
    """Format on how much of a region something happens, and where."""
    places = sorted({each.at for each in some})
    share = len(places) / len({each.at for each in touches})
    (x0, y0), (x1, y1) = np.min(places, axis=0), np.max(places, axis=0)
    second = "" if any(each.resting is None for each in some) else ", beside a second finger"
    return (
        f"on {100 * share:.0f} % of the region ({1e4 * area * len(places):.1f} cm²), x {x0:.3f} to "
        f"{x1:.3f}, y {y0:.3f} to {y1:.3f} m{second}"
    )
