"""Strongest stimulus of a layout's effect, from simulated movements of a finger."""

import math
from collections.abc import Iterator
from typing import TypeAlias

from controller.effects.effect import Effect, EffectStimulus, Region
from controller.effects.layout import SurfaceLayout
from controller.play.intent import Target
from controller.sources.touch import Contact, ContactKey
from model.arrays import Point

_REPORT_INTERVAL = 0.01  # s; of the panel
_WATCHED = 3.0  # s; simulated length of an effect that changes with time
_MAX_STEPS = 2000
_PATH_LENGTH = 0.12  # m
_SPEEDS = (0.05, 0.2, 1.0, 5.0)  # m/s
_TURNING_RADIUS = 0.02  # m
_Direction: TypeAlias = tuple[float, float]
_DIRECTIONS: tuple[_Direction | None, ...] = ((1.0, 0.0), (0.0, 1.0), None)  # None: a circle
_KEY = ContactKey("check", 1)


def strongest_target(
    layout: SurfaceLayout, name: str, region: Region | None, *, at: Point
) -> Target | None:
    """Return the strongest target of an effect in a region, or outside all regions; None for none.

    at [m]: where the finger lands. A finger of a motion effect is moved along x, along y and around
    `at`.
    """
    effect = layout.effects[name]
    level = layout.level_of(name, region)
    watch = _while_moving if effect.is_for_motion else _while_resting
    stimuli = watch(effect, region, level, at)
    strongest = max(stimuli, key=_strength, default=None)
    if strongest is None:
        return None
    priority = 0 if region is None else region.priority
    band = effect.band_in(region)
    return strongest.target(_KEY, name, region, band=band, priority=priority)


def _strength(stimulus: EffectStimulus) -> float:
    return math.inf if stimulus.level_db_sl is None else stimulus.level_db_sl


def _while_resting(
    effect: Effect, region: Region | None, level: float | None, at: Point
) -> Iterator[EffectStimulus]:
    """Yield the stimuli of a finger that rests at a position [m]."""
    contact = _finger(at)
    run = effect.start_in(region, contact, 0.0, level_db_sl=level)
    now: float | None = 0.0
    for _ in range(_MAX_STEPS):
        if now is None or now > _WATCHED:
            return
        stimulus = run.feel(contact, now)
        if stimulus is None:
            return
        if isinstance(stimulus, EffectStimulus):
            yield stimulus
        now = None if stimulus.until is None else max(stimulus.until, now + 1e-6)


def _while_moving(
    effect: Effect, region: Region | None, level: float | None, at: Point
) -> Iterator[EffectStimulus]:
    """Yield the stimuli of a finger that moves from a position [m], fast and slowly."""
    for speed in _SPEEDS:
        count = max(2, math.ceil(_PATH_LENGTH / speed / _REPORT_INTERVAL)) + 8
        for direction in _DIRECTIONS:
            path = []
            for step in range(count):
                path.append(_moved(at, direction, step * speed * _REPORT_INTERVAL))
            run = effect.start_in(region, _finger(path[0]), 0.0, level_db_sl=level)
            for step, position in enumerate(path):
                stimulus = run.feel(_finger(position), step * _REPORT_INTERVAL)
                if isinstance(stimulus, EffectStimulus):
                    yield stimulus


def _moved(at: Point, direction: _Direction | None, distance: float) -> Point:
    """Return the position [m] after a distance [m] in a direction, or around a circle for None."""
    if direction is not None:
        return at[0] + distance * direction[0], at[1] + distance * direction[1]
    angle = distance / _TURNING_RADIUS
    x = at[0] + _TURNING_RADIUS * math.cos(angle)
    y = at[1] + _TURNING_RADIUS * math.sin(angle)
    return x, y


def _finger(at: Point) -> Contact:
    return Contact(_KEY, *at, since=0.0)
