"""Check how every region of a surface layout feels on a table's plate, simulated in time."""

import math
from collections.abc import Iterator, Sequence
from itertools import compress

import numpy as np

from controller.effects.effect import ON_RELEASE, Region
from controller.effects.layout import ELSEWHERE, SurfaceLayout
from controller.effects.player import CLICK_ABOVE_DB, NOTICED_ABOVE_DB
from controller.play.intent import Target, band_problem
from era_haptics.lab.checks.checked_effect import CheckedEffect, frequencies_of
from era_haptics.lab.checks.strongest_target import strongest_target
from era_haptics.lab.checks.touch_simulator import SimulatedTouch, TouchSimulator
from model.arrays import FloatArray, Point
from model.processes import Progress, unseen
from model.structure.plate import Plate
from model.table.table import LocalizationTable

LEVEL_TOLERANCE = 2.0
"""Tolerance of a level [dB], below or above the promised one."""

MARGIN_TOLERANCE = 4.0
"""Tolerance [dB] above a level that is promised on 90 % of plates."""

MAX_REGION_TOUCHES = 30
"""Largest number of positions in a region."""

MAX_POSITIONS = 120
"""Largest number of positions in all regions."""

_NOWHERE = "is felt nowhere"
_COVERED = "is covered by later regions, or is off the plate"
_ALIKE = 1.25  # ratio of frequencies that feel nearly alike
_MIN_STEP = 0.008  # m; closer touches hardly differ
_RESTING_AWAY = 0.06  # m, minimum distance from a touch to the resting finger


def check_layout(
    layout: SurfaceLayout,
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> list[CheckedEffect]:
    """Simulate touches over every region of a layout, alone and with a resting second finger.

    progress: called with the number of effects checked and the total.
    """
    simulator = TouchSimulator(table)
    uses = [*layout.uses()]
    checked = []
    count = max(1, min(MAX_REGION_TOUCHES, MAX_POSITIONS // max(1, len(uses))))
    for number, (region, on, name) in enumerate(uses):
        progress(number, len(uses))
        checked.append(_check(layout, region, on, name, simulator, count))
    progress(len(uses), len(uses))
    return checked


def _check(
    layout: SurfaceLayout,
    region: Region | None,
    on: str,
    name: str,
    simulator: TouchSimulator,
    count: int,
) -> CheckedEffect:
    """Simulate up to `count` touches of an effect, each alone and with a resting finger."""
    table = simulator.table
    positions, area = touch_positions(layout, region, table.plate, count)
    start = (0.0, 0.0)
    if region is not None:
        start = region.shape.center
    elif positions:
        start = positions[0]
    target = strongest_target(layout, name, region, at=start)
    region_name = ELSEWHERE if region is None else region.name
    if target is None or not positions:
        problem = _NOWHERE if target is None else _COVERED
        level = layout.level_of(name, region)
        return CheckedEffect(region_name, name, on, level, (), (f"{name} {problem}",))
    touches = []
    for number, at in enumerate(positions):
        touches.append(simulator.touch(target, at, None))
        resting = _resting(table.plate, at, number)
        if resting is not None:
            touches.append(simulator.touch(target, at, resting))
    is_raised = target.pulse is not None and target.pulse.is_raised
    has_margin = target.band is None and not is_raised
    is_for_motion = layout.effects[name].is_for_motion
    problems = [
        *_silent(target, touches, area),
        *_off_level(target.level_db_sl, touches, area, has_margin=has_margin),
        *_unnoticed(layout, region, on, name, target, at=start),
        *_off_band(target.band, table, touches, must_be_alike=is_for_motion),
    ]
    return CheckedEffect(region_name, name, on, target.level_db_sl, tuple(touches), tuple(problems))


def touch_positions(
    layout: SurfaceLayout, region: Region | None, plate: Plate, count: int = MAX_REGION_TOUCHES
) -> tuple[list[Point], float]:
    """Return up to `count` positions [m], evenly spaced over a region, and the area of each [m²].

    Excludes parts that later regions cover, and parts outside the plate or its outline.
    """
    sides = np.array([plate.length, plate.width])
    low, high = np.zeros(2), sides
    if region is not None:
        corners = [*region.shape.corners()]
        low = np.clip(np.min(corners, axis=0), 0, sides)
        high = np.clip(np.max(corners, axis=0), 0, sides)
    if not (low < high).all():
        return [], 0.0
    step = _MIN_STEP
    while True:
        grid, area = _grid(low, high, step)
        is_on_plate = plate.covers(np.array(grid)).tolist()
        on_plate = list(compress(grid, is_on_plate))
        positions = [at for at in on_plate if layout.region_at(*at) is region]
        if len(positions) <= count:
            return positions, area
        step *= 1.1


def _grid(low: FloatArray, high: FloatArray, step: float) -> tuple[list[Point], float]:
    """Return the centers of equal cells of at least a step [m] between two corners, and their
    area."""
    columns, rows = (max(1, math.floor(size / step + 1e-9)) for size in high - low)
    length = (high[0] - low[0]) / columns
    width = (high[1] - low[1]) / rows
    centers = []
    for row in range(rows):
        y = float(low[1] + (row + 0.5) * width)
        for column in range(columns):
            x = float(low[0] + (column + 0.5) * length)
            centers.append((x, y))
    return centers, length * width


def _resting(plate: Plate, at: Point, number: int) -> Point | None:
    """Return the position of the second finger: in another quarter of the plate each time.

    None if the centers of all quarters are outside the outline of the plate.
    """
    quarters = []
    for x in (0.25 * plate.length, 0.75 * plate.length):
        for y in (0.25 * plate.width, 0.75 * plate.width):
            if plate.contains(x, y):
                quarters.append((x, y))
    distant = [quarter for quarter in quarters if math.dist(quarter, at) >= _RESTING_AWAY]
    if not distant:
        return max(quarters, key=lambda quarter: math.dist(quarter, at), default=None)
    return distant[number % len(distant)]


def _silent(target: Target, touches: Sequence[SimulatedTouch], area: float) -> Iterator[str]:
    """Yield touches that are not felt; the level that the neighbors allow can be zero."""
    can_be_silent = target.level_db_sl is None
    silent = []
    for touch in touches:
        is_excused = can_be_silent and touch.resting is not None
        if touch.reason is not None and not is_excused:
            silent.append(touch)
    if silent:
        yield f"nothing is felt {_location(silent, touches, area)}: {silent[0].reason}"


def _off_level(
    promised: float | None, touches: Sequence[SimulatedTouch], area: float, *, has_margin: bool
) -> Iterator[str]:
    """Yield levels below and above the promised one [dB SL]; has_margin: promised on 90 % of
    plates."""
    if promised is None:
        return
    max_excess = MARGIN_TOLERANCE if has_margin else LEVEL_TOLERANCE
    below: dict[SimulatedTouch, float] = {}
    above: dict[SimulatedTouch, float] = {}
    for touch in touches:
        if touch.felt_db_sl is None:
            continue
        excess = touch.felt_db_sl - promised
        if -excess > LEVEL_TOLERANCE:
            below[touch] = -excess
        elif excess > max_excess:
            above[touch] = excess
    for direction, differences in (("below", below), ("above", above)):
        if differences:
            yield (
                f"level is up to {max(differences.values()):.1f} dB {direction} {promised:g} dB SL "
                f"{_location([*differences], touches, area)}"
            )


def _unnoticed(
    layout: SurfaceLayout,
    region: Region | None,
    on: str,
    name: str,
    click: Target,
    *,
    at: Point,
) -> Iterator[str]:
    """Yield short effects whose stated level is masked by a continuous effect of the region."""
    if on == ON_RELEASE or not click.is_short or not layout.effects[name].gives_level_in(region):
        return
    if click.level_db_sl is None:
        return
    for used_region, used_on, used_name in layout.uses():
        if used_region is not region or used_on in (on, ON_RELEASE):
            continue
        target = strongest_target(layout, used_name, region, at=at)
        if target is None or target.is_short or target.level_db_sl is None:
            continue
        if click.level_db_sl < target.level_db_sl + NOTICED_ABOVE_DB:
            yield (
                f"level {click.level_db_sl:g} dB SL is less than {NOTICED_ABOVE_DB:g} dB above "
                f"{used_name}, {target.level_db_sl:g} dB SL, and is hardly noticed; raise "
                f"it, or give {name} no level: it is then {CLICK_ABOVE_DB:g} dB above"
            )


def _off_band(
    band: tuple[float, float] | None,
    table: LocalizationTable,
    touches: Sequence[SimulatedTouch],
    *,
    must_be_alike: bool,
) -> Iterator[str]:
    """Yield frequencies that depend on the position, or a band without a frequency of the table."""
    frequencies = frequencies_of(touches)
    if not frequencies:
        return
    low, high = frequencies[0], frequencies[-1]
    if band is None:
        if must_be_alike and high > _ALIKE * low:
            yield (
                f"frequency is {low:g} to {high:g} Hz, depending on position; give it "
                "a frequency or a band"
            )
        return
    problem = band_problem(band, table.frequencies)
    if problem is not None:
        yield problem


def _location(
    affected: Sequence[SimulatedTouch], touches: Sequence[SimulatedTouch], area: float
) -> str:
    """Format the part of a region with affected touches, in percent and by position.

    area [m²]: of each position.
    """
    positions = sorted({touch.at for touch in affected})
    share = len(positions) / len({touch.at for touch in touches})
    (x_min, y_min), (x_max, y_max) = np.min(positions, axis=0), np.max(positions, axis=0)
    is_with_second = all(touch.resting is not None for touch in affected)
    second = ", with a second finger" if is_with_second else ""
    return (
        f"on {100 * share:.0f} % of the region ({1e4 * area * len(positions):.1f} cm²), x "
        f"{x_min:.3f} to {x_max:.3f}, y {y_min:.3f} to {y_max:.3f} m{second}"
    )
