"""Response shapes of channels, compared with the shapes of a rig's ERAs.

The modal assurance criterion (MAC) of measured values d and model responses a over the sensors,

    MAC = |a^H d|² / (|a|² |d|²),

is 1 for the same shape with any gain and phase, and about one over the number of sensors for noise
(Allemang and Brown, Proc. 1st IMAC, 1982). It identifies the ERA that a channel drives before gains
and phases are known.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.special import stdtr

from model.arrays import ComplexArray, FloatArray, best_by, best_of
from model.estimate.sensed_plate import SensedPlate

Start: TypeAlias = tuple[float, float]
"""Logarithms of factors on the modulus and on all stiffnesses, at which a fit starts."""

RIG_START: Start = (0.0, 0.0)
"""Start at the rig's own values."""

# Moduli are 5 to 8 % apart in natural frequency. Stiffnesses, which data sheets state less
# accurately and which change shapes less, have a wider range.
STARTS: list[Start] = [
    (modulus, stiffness)
    for modulus in np.log(np.linspace(0.6, 1.6, 11)).tolist()
    for stiffness in np.log([0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.5]).tolist()
]

_START_PENALTY = 0.05
"""Reduction of the score of a start for each unit of its logarithms and each channel: shapes that
hardly depend on a value leave it near the rig's."""

_LEAST_MISFIT = 0.02
"""Value of 1 - MAC below which errors of the sensors dominate."""

_MIN_COMPARED = 3
"""Minimum number of frequencies of a t-test."""


def known_median(values: FloatArray) -> FloatArray:
    """Return the median over the first axis of the known values (f, ...), NaN without any."""
    ordered = np.sort(values, axis=0)
    count = np.isfinite(values).sum(axis=0)[None]
    lower = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=0)
    upper = np.take_along_axis(ordered, count // 2, axis=0)  # NaN without any
    return np.asarray((lower[0] + upper[0]) / 2)


def modal_assurance(values: ComplexArray, model: ComplexArray) -> FloatArray:
    """Return the MAC of shapes (..., s); values that are not finite are ignored, NaN without any.

    values: d; model: a.
    """
    measured = np.isfinite(values)
    values = np.where(measured, values, 0)
    model = np.where(measured, model, 0)
    inner = np.abs((model.conj() * values).sum(axis=-1)) ** 2
    power = (np.abs(values) ** 2).sum(axis=-1) * (np.abs(model) ** 2).sum(axis=-1)
    return np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)


@dataclass(frozen=True, eq=False)
class ShapeMatch:
    """MAC of channels and ERAs on the plate with the most similar shapes."""

    mac: FloatArray
    """MAC (f, n, n) between the channel wired to the first ERA in the rig and the second ERA, NaN
    if not driven."""
    start: Start = RIG_START
    """Factors of that plate."""

    @property
    def starts(self) -> tuple[Start, ...]:
        """Starts of a fit: the rig's values, and the factors of that plate."""
        return tuple(dict.fromkeys([RIG_START, self.start]))

    @cached_property
    def medians(self) -> FloatArray:
        """Medians of the MAC over frequency (n, n)."""
        return known_median(self.mac)

    @cached_property
    def nearest(self) -> list[int]:
        """Index of the ERA most similar to each channel; its own if not driven."""
        nearest = list(range(len(self.medians)))
        for channel, mac in enumerate(self.medians):
            if np.isfinite(mac).any():
                nearest[channel] = best_of(np.nan_to_num(mac, nan=-1.0))
        return nearest

    def error(self, eras: Sequence[int] | None = None) -> float:
        """RMS fraction of the responses that the shapes of ERAs (n,) leave unexplained.

        eras: default each channel's own.
        """
        channels = range(self.mac.shape[1])
        mac = self.mac[:, channels, list(channels if eras is None else eras)]
        unexplained = 1 - mac[np.isfinite(mac)]
        if not len(unexplained):
            return math.inf
        return math.sqrt(max(0.0, float(unexplained.mean())))

    def confidence(self, channel: int, era: int, rival: int) -> float:
        """Confidence 0 to 1 that the channel drives one ERA and not a rival.

        From Student's t-test on the difference of their misfits over frequencies, which counts
        every frequency as independent. Neighboring frequencies near one resonance are not, so that
        the confidence is overstated: with m dependent values each, t is sqrt(m) times too large. A
        wiring other than the rig's must therefore also reduce the cost of the fit
        (`plate_match.best_wiring`).
        """
        misfit = np.log(np.maximum(1 - self.mac[:, channel], _LEAST_MISFIT))
        gain = misfit[:, rival] - misfit[:, era]
        gain = gain[np.isfinite(gain)]
        if len(gain) < _MIN_COMPARED or np.ptp(gain) == 0:
            return 0.5
        t = gain.mean() * np.sqrt(len(gain)) / gain.std(ddof=1)
        return float(stdtr(len(gain) - 1, t))


def match_responses(
    model: ComplexArray, values: ComplexArray, start: Start = RIG_START
) -> ShapeMatch:
    """Compare values (f, s, n) with the responses (f, s, n) of a single plate."""
    shapes = model.swapaxes(1, 2)[:, None]
    return ShapeMatch(modal_assurance(values.swapaxes(1, 2)[:, :, None], shapes), start)


def match_shapes(plate: SensedPlate, values: ComplexArray) -> ShapeMatch:
    """Compare values (f, s, n) with a rig's ERAs on plates with other modulus and stiffnesses."""
    matches = []
    for start in [RIG_START, *STARTS]:
        responses = plate.responses(plate.start(*start))
        matches.append(match_responses(responses, values, start))
    return best_by(matches, _shape_score)


def _shape_score(shapes: ShapeMatch) -> float:
    """Sum of the MAC of all channels, less the penalty of a start far from the rig's values."""
    mac = [shapes.medians[channel, era] for channel, era in enumerate(shapes.nearest)]
    return float(np.nansum(mac) - _START_PENALTY * sum(map(abs, shapes.start)) * len(mac))
