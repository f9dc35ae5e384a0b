"""The best drive of a single frequency for a percentile of contrast, climbed directly.

Independent of the search of the model: stochastic scenarios, a start from their mean power, then
gradient steps (Adam) on the percentile itself from several starts at the best frequencies.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from model.arrays import ComplexArray, FloatArray

STARTS, STEPS, RATE = 8, 120, 0.05
NEAR = 0.05
"""Scenarios whose rank is within this share of the percentile's have a say in its gradient."""


class Fingers(Protocol):
    """Fingers on plates, the first of them the target.

    finger (p,): whose point; weights (p,): of the mean over its disc.
    """

    finger: FloatArray
    weights: FloatArray
    finger_count: int

    def accelerations(self, frequency: float, plates: Any) -> ComplexArray:
        """Acceleration [m/s²] at the points of each ERA at full stroke, (m, p, eras)."""
        ...


class Plates(Protocol):
    """Plates that deviate."""

    def first(self, count: int) -> "Plates":
        """The first of them."""
        ...


@dataclass(frozen=True, eq=False)
class Drive:
    """Complex weights of the ERAs (eras,), at most 1, at a frequency [Hz]."""

    frequency: float
    weights: ComplexArray


def contrasts_db(
    fingers: Fingers, fields: ComplexArray, weights: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Contrast [dB] and acceleration of the target [m/s²] on each plate, (m,) both.

    fields (..., m, p, eras), weights (..., eras).
    """
    size = np.abs(fields @ weights[..., None, :, None])[..., 0]
    target = size @ np.where(fingers.finger == 0, fingers.weights, 0)
    loudest = size[..., fingers.finger > 0].max(axis=-1)
    return 20 * np.log10(target / loudest), target


def optimum(
    fingers: Fingers,
    frequencies: FloatArray,
    plates: Plates,
    *,
    percentile: float,
    least: FloatArray,
) -> Drive:
    """Find the drive of the highest percentile of contrast over plates.

    least (f,) [m/s²]: acceleration that the target must have at full stroke, in the tenth
    percentile of the plates; 0 for none.
    """
    few = plates.first(60)
    ranked: list[tuple[float, int, ComplexArray]] = []
    for number, frequency in enumerate(frequencies):
        fields = fingers.accelerations(float(frequency), few)
        for start in _starts(fingers, fields):
            worth = _worth(fingers, fields, start, percentile, float(least[number]))
            ranked.append((worth, number, start))
    ranked.sort(key=lambda each: -each[0])
    chosen = list(dict.fromkeys(number for _, number, _ in ranked))[:STARTS]
    best, answer = -np.inf, None
    for number in chosen:
        fields = fingers.accelerations(float(frequencies[number]), plates)
        for start in [weights for _, at, weights in ranked if at == number][:2]:
            weights = _climb(fingers, fields, start, percentile, float(least[number]))
            worth = _worth(fingers, fields, weights, percentile, float(least[number]))
            if worth > best:
                best, answer = worth, Drive(float(frequencies[number]), weights)
    assert answer is not None
    return answer


def _worth(
    fingers: Fingers, fields: ComplexArray, weights: ComplexArray, percentile: float, least: float
) -> float:
    """The percentile, less two decibels for every one that the level falls short of."""
    contrast, target = contrasts_db(fingers, fields, weights / np.abs(weights).max())
    worth = float(np.percentile(contrast, percentile))
    if least > 0:
        level = float(np.percentile(target, 10))
        worth -= 2 * max(0.0, 20 * np.log10(least / level))
    return worth


def _starts(fingers: Fingers, fields: ComplexArray) -> list[ComplexArray]:
    """Weights of the least mean power at the quiet fingers, for several weightings of them."""
    target = fields[:, fingers.finger == 0].mean(axis=(0, 1))
    forms = []
    for finger in range(1, fingers.finger_count):
        rows = fields[:, fingers.finger == finger].reshape(-1, fields.shape[-1])
        forms.append(rows.conj().T @ rows / len(rows))
    share, starts = np.ones(len(forms)), []
    # Loaded diagonals raise the level for less contrast.
    for load in (1e-6, 1e-6, 1e-6, 1e-3, 1e-2, 1e-1):
        form = np.tensordot(share / share.sum(), np.array(forms), axes=1)
        form += load * np.trace(form).real / len(form) * np.eye(len(form))
        weights = np.linalg.solve(form, target.conj())
        weights /= np.abs(weights).max()
        starts.append(weights)
        share = share * np.sqrt([(weights.conj() @ each @ weights).real for each in forms])
    return starts


def _climb(
    fingers: Fingers, fields: ComplexArray, weights: ComplexArray, percentile: float, least: float
) -> ComplexArray:
    """Adam on the mean of the contrasts whose rank is near the percentile."""
    is_target = fingers.finger == 0
    over = fingers.weights[is_target]
    target_fields, quiet_fields = fields[:, is_target], fields[:, ~is_target]
    first, second = np.zeros(len(weights), complex), 0.0
    best, best_weights = -np.inf, weights
    around = percentile / 100 + np.array([-NEAR, NEAR])
    low, high = (np.clip(around, 0, 1) * len(fields)).astype(int)
    for step in range(1, STEPS + 1):
        at_target = target_fields @ weights
        size = np.abs(at_target)
        mean = size @ over
        at_quiet = quiet_fields @ weights
        loudest = np.abs(at_quiet).argmax(axis=1)
        rows = np.arange(len(fields))
        quiet = at_quiet[rows, loudest]
        contrast = np.log(mean / np.abs(quiet))
        worth = float(np.percentile(contrast, percentile)) * 20 / np.log(10)
        short = 0.0
        if least > 0:
            full = mean / np.abs(weights).max()
            short = 20 * np.log10(least / float(np.percentile(full, 10)))
            worth -= 2 * max(0.0, short)
        if worth > best:
            best, best_weights = worth, weights.copy()
        near = np.argsort(contrast)[low : max(high, low + 1)]
        unit = at_target[near] / size[near]
        gain = np.einsum("mp,p,mpe->me", unit, over, target_fields[near].conj())
        gain /= mean[near, None]
        loss = quiet[near, None] * quiet_fields[near, loudest[near]].conj()
        loss /= np.abs(quiet[near, None]) ** 2
        gradient = (gain - loss).mean(axis=0)
        if short > 0:
            # Towards the level: more of the target for the strongest weight.
            strongest = np.abs(weights).argmax()
            towards = gain.mean(axis=0)
            towards[strongest] -= weights[strongest] / np.abs(weights[strongest]) ** 2
            gradient = gradient + 2 * towards
        first = 0.9 * first + 0.1 * gradient
        second = 0.99 * second + 0.01 * float(np.vdot(gradient, gradient).real)
        rate = RATE * np.linalg.norm(weights) * min(1.0, 2 * (1 - step / STEPS) + 0.02)
        weights = weights + rate * (first / (1 - 0.9**step)) / np.sqrt(second / (1 - 0.99**step))
    return np.asarray(best_weights / np.abs(best_weights).max())
