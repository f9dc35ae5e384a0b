"""What an effect makes felt in general: its strongest stimulus, at rest and along some ways."""

import math
from collections.abc import Iterator

from controller.effects.effect import Effect, EffectStimulus, Region
from controller.effects.layout import SurfaceLayout
from controller.play.intent import Target
from controller.sources.touch import Contact, ContactKey

_REPORT = 0.01  # s; between two reports of the panel
_WATCHED = 3.0  # s; of an effect that changes with time
_MAX_STEPS = 2000
_WAY = 0.12  # m
_SPEEDS = (0.05, 0.2, 1.0, 5.0)  # m/s
_TURNING_RADIUS = 0.02  # m


_KEY = ContactKey("check", 1)


def strongest_target(
    layout: SurfaceLayout, name: str, region: Region | None, *, at: tuple[float, float]
) -> Target | None:
    """Return what an effect, by name, makes felt most in a region, or outside of all; or None.

    at [m]: where a finger comes down. An effect for motion is moved along x, y and around `at`.
    """
    effect, level = layout.effects[name], layout.level_of(name, region)
    watch = _while_moving if effect.is_for_motion else _while_resting
    strongest = max(watch(effect, region, level, at), key=_strength, default=None)
    if strongest is None:
        return None
    priority = 0 if region is None else region.priority
    band = layout.band_of(name, region)
    return strongest.target(_KEY, name, region, band=band, priority=priority)


def _strength(stimulus: EffectStimulus) -> float:
    return math.inf if stimulus.level_db_sl is None else stimulus.level_db_sl


def _while_resting(
    effect: Effect, region: Region | None, level: float | None, at: tuple[float, float]
) -> Iterator[EffectStimulus]:
    contact = _finger(at)
    run = effect.start_in(region, contact, 0.0, level_db_sl=level)
    now: float | None = 0.0
    for _ in range(_MAX_STEPS):
        if now is None or now > _WATCHED:
            return
        felt = run.feel(contact, now)
        if felt is None:
            return
        if isinstance(felt, EffectStimulus):
            yield felt
        now = None if felt.until is None else max(felt.until, now + 1e-6)


def _while_moving(
    effect: Effect, region: Region | None, level: float | None, at: tuple[float, float]
) -> Iterator[EffectStimulus]:
    for speed in _SPEEDS:
        for along in ((1.0, 0.0), (0.0, 1.0), None):
            count = max(2, math.ceil(_WAY / speed / _REPORT)) + 8
            way = [_along(at, along, step * speed * _REPORT) for step in range(count)]
            run = effect.start_in(region, _finger(way[0]), 0.0, level_db_sl=level)
            for step, position in enumerate(way):
                felt = run.feel(_finger(position), step * _REPORT)
                if isinstance(felt, EffectStimulus):
                    yield felt


def _along(
    at: tuple[float, float], direction: tuple[float, float] | None, distance: float
) -> tuple[float, float]:
    """Return the position [m] after a distance [m] in a direction, None for around a circle."""
    if direction is not None:
        return (at[0] + distance * direction[0], at[1] + distance * direction[1])
    angle = distance / _TURNING_RADIUS
    return (
        at[0] + _TURNING_RADIUS * math.cos(angle),
        at[1] + _TURNING_RADIUS * math.sin(angle),
    )


def _finger(at: tuple[float, float]) -> Contact:
    return Contact(_KEY, *at, since=0.0)
