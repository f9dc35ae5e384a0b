"""Scores of contact sets at given fields: contrast of the best weights, less a penalty.

Notation and reasons: `era_haptics.lab.design.score`.
"""

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray, best_rows
from model.finger import STRONG_DB_SL, detection_threshold
from model.rig.rig import Rig

BEST_FREQUENCIES = 3
"""Frequencies of each set at which the maximum over the quiet fingers is minimized."""

LEVEL_PENALTY = 0.1
"""Score penalty per dB of missing level; with 1 instead of 0 to 0.15, scores predict answers
worse."""

_LEVEL_RESERVE = 1.2
"""Factor on the wanted level, as 90 % of plates need more than the nominal plate."""

_LAWSON_STEPS = 2
_SMALLEST = np.float32(1e-30)


class SetScores:
    """Scores contact sets at frequencies (f,) [Hz] of a rig, with a number of contents."""

    def __init__(self, rig: Rig, frequencies: FloatArray, contents: int) -> None:
        self._required = _required_levels(rig, frequencies, contents)

    def of_sets(
        self, target: Complex64Array, power: Complex64Array, fingers: IntArray
    ) -> FloatArray:
        """Return the score [dB] for sets (s, k) of fingers, (s,); only the first finger has the
        content."""
        frequencies = np.arange(len(target))
        quiet = fingers[:, 1:]
        quiet_count = quiet.shape[1]
        c = target[:, fingers[:, 0]].conj()  # (f, s, n)
        if quiet_count == 1:
            mean_power = power[:, quiet[:, 0]]
        else:
            mean_power = power[:, quiet].sum(axis=2) / np.float32(quiet_count)
        w = np.linalg.solve(mean_power, c[..., None])[..., 0]
        # The mean over the quiet fingers bounds the maximum.
        bound = self._decibels(np.vecdot(c, w).real, c, w, frequencies[:, None])
        if quiet_count == 1:
            return np.asarray(bound.max(axis=0), dtype=float)
        rows = best_rows(bound, min(BEST_FREQUENCIES, len(target)))
        kept = (rows, np.arange(len(fingers)))
        return self._minimax_score(c[kept], w[kept], power[rows[..., None], quiet], rows)

    def _minimax_score(
        self, c: Complex64Array, w: Complex64Array, power: Complex64Array, rows: IntArray
    ) -> FloatArray:
        """Return the best score [dB] while Lawson's algorithm minimizes the loudest quiet finger.

        c, w (r, s, n): of r frequencies; power (r, s, q, n, n); rows (r, s): frequency numbers.
        """
        best = np.full(w.shape[1], -np.inf)
        shares = np.ones(power.shape[:3], dtype=np.float32)
        for step in range(_LAWSON_STEPS + 1):
            by_finger = w[:, :, None]
            expected = np.vecdot(by_finger, np.matvec(power, by_finger)).real
            loudest = np.maximum(expected.max(axis=2), _SMALLEST)
            score = np.abs(np.vecdot(c, w)) ** 2 / loudest
            decibels = self._decibels(score, c, w, rows)
            best = np.maximum(best, decibels.max(axis=0))
            if step < _LAWSON_STEPS:
                shares = shares * np.sqrt(np.maximum(expected, _SMALLEST))
                shares /= shares.sum(axis=2, keepdims=True)
                flat_power = power.reshape(*power.shape[:3], -1)
                weighted = (shares[:, :, None] @ flat_power).reshape(*w.shape, -1)
                w = np.linalg.solve(weighted, c[..., None])[..., 0]
        return np.asarray(best, dtype=float)

    def _decibels(
        self, score: Float32Array, c: Complex64Array, w: Complex64Array, rows: IntArray
    ) -> Float32Array:
        """Return scores (f, s) of weights (f, s, n), minus the penalty for missing level."""
        stroke = np.maximum(np.abs(w).max(axis=-1), _SMALLEST)
        level = np.abs(np.vecdot(c, w)) / stroke
        surplus = 20 * np.log10(np.maximum(level, _SMALLEST) / self._required[rows])
        decibels = 10 * np.log10(np.maximum(score, _SMALLEST))
        return np.asarray(decibels + LEVEL_PENALTY * np.minimum(surplus, 0))


def _required_levels(rig: Rig, frequencies: FloatArray, contents: int) -> Float32Array:
    """Return the acceleration (f,) [m/s²] that each content needs, including a reserve."""
    factor = _LEVEL_RESERVE * contents * 10 ** (STRONG_DB_SL / 20)
    return (factor * detection_threshold(frequencies, rig.threshold)).astype(np.float32)
