"""Patterns: the one form into which all content formats are read.

Events and curves over time, as AHAP, HJIF and their relatives have them: how strongly what lasts is
felt, how sharply, and transients beside it.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from model.arrays import FloatArray

MAX_DURATION = 60.0
"""Longest content [s]."""

Curve: TypeAlias = tuple[tuple[float, float], ...]
"""Times [s], none before the one ahead of it, and values 0 to 1: straight lines, steps where two
times are equal."""


@dataclass(frozen=True)
class Transient:
    """A short tap at a time [s]: intensity and sharpness, 0 to 1."""

    time: float
    intensity: float
    sharpness: float


@dataclass(frozen=True)
class Pattern:
    """What a file asks for.

    duration [s]; intensity, sharpness: of what lasts, intensity 0 outside its curve, sharpness as
    at its ends; transients: ascending in time; remarks: what of the file was changed or left out,
    in words.
    """

    duration: float
    intensity: Curve = ()
    sharpness: Curve = ()
    transients: tuple[Transient, ...] = ()
    remarks: tuple[str, ...] = ()


def misfit(pattern: Pattern) -> str:
    """Return what is wrong with a pattern that a format has made, or ""."""
    if not pattern.duration >= 0:  # also for NaN
        return f"must last 0 s or longer, got {pattern.duration:g} s"
    taps = pattern.transients
    for name, curve in (
        ("intensity", pattern.intensity),
        ("sharpness", pattern.sharpness),
        ("intensity of transients", [(each.time, each.intensity) for each in taps]),
        ("sharpness of transients", [(each.time, each.sharpness) for each in taps]),
    ):
        before = 0.0
        for index, (time, value) in enumerate(curve):
            if not before <= time <= MAX_DURATION:
                bounds = f"{before:g} to {MAX_DURATION:g} s"
                return f"time of {name}[{index}] must be {bounds}, got {time:g} s"
            if not 0 <= value <= 1:
                return f"{name}[{index}] must be 0 to 1, got {value:g} at {time:g} s"
            before = time
    return ""


def along(curve: Curve, times: FloatArray, *, beyond: float | None = None) -> FloatArray:
    """Values of a curve at times [s]; outside of it a value, by default that of its ends."""
    moments, values = np.array(curve or ((0.0, 0.0),)).T
    return np.asarray(np.interp(times, moments, values, left=beyond, right=beyond))
