"""A fast robust score of a layout: expected contrast over sampled contact sets.

As answers are found (`model.ensemble.contact_forms`, `model.drive_modes.coherent`), at a few
frequencies, from the receptances of the free plate, and with each finger loading the plate where it
rests: what it changes at the others is left out, so that all is computed once for each finger. With
ERAs e of dynamic stiffness Z on the plate, a finger f of dynamic stiffness D and its points p:

    K = (1 + Z A_ee)^-1,  G = A_pe K,  L = A_pf - G Z A_ef,  M = D / (1 + D L_f)
    t_e = G_p - L_p M G_f,  h = -w² t_e z stroke,  r_e = stroke - u_e,  r_f = -u_f
    R = mean_p {h* h^T + dh* dh^T + dc* dc^T + sum_j |s_j w² t_j|² r_j* r_j^T + sigma² diag |h|²}

with dh by thickness and dc by the ERAs' damping, s_j of each ERA's stiffness and the finger's load.
The score of a set is |h_t w|² / max_q w^H R_q w of the best weights w at the best frequency, less a
tenth of what they miss the wanted level by: an answer that has to reach it loses little.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.choice import best_rows
from model.design.places import DesignPlate, Places
from model.finger.perception import STRONG_DB_SL, detection_threshold
from model.structure.actuator import Era
from model.structure.dynamic_stiffness import attached_stiffness, drive_forces, full_strokes

LEVEL_RESERVE = 1.2
"""Factor on the wanted level for what nine of ten plates need beyond the plate as modelled."""

BEST_FREQUENCIES = 3
"""Frequencies of each set at which the maximum over the quiet fingers is minimised."""

LAWSON_STEPS = 2

LEVEL_PENALTY = 0.1
"""Decibels of score for one of level: with 1 in place of 0 to 0.15 scores follow answers less."""

_RIDGE, _LEAST = np.float32(1e-6), np.float32(1e-30)


@dataclass(frozen=True, eq=False)
class Mounts:
    """ERAs at frequencies (f,): dynamic stiffness, force and base at full stroke, (f, n) each.

    by_stiffness, by_damping: change of the stiffness by one standard deviation.
    """

    stiffness: Complex64Array
    force: Complex64Array
    stroke: Complex64Array
    by_stiffness: Complex64Array
    by_damping: Complex64Array


class Scorer:
    """Scores layouts on a plate with contact sets."""

    def __init__(self, plate: DesignPlate, *, level_db_sl: float = STRONG_DB_SL) -> None:
        rig, omega = plate.rig, plate.omega
        self._plate = plate
        uncertainty = rig.uncertainty
        self._gain_variance = np.float32(uncertainty.gain_variance)
        self._log_damping = math.log(uncertainty.damping)
        self._load_std = np.float32(uncertainty.fingertip)
        self._minus_omega2 = -(omega**2).astype(np.float32)[:, None, None]
        tip = rig.fingertip
        finger = np.zeros(len(omega)) if tip is None else tip.dynamic_stiffness(omega)
        self._finger = finger.astype(np.complex64)[:, None, None]
        least = LEVEL_RESERVE * 10 ** (level_db_sl / 20)
        threshold = detection_threshold(plate.frequencies, rig.threshold)
        self._wanted = (least * threshold).astype(np.float32)

    def mounts(self, eras: Sequence[Era]) -> Mounts:
        """What the score needs of ERAs, whose places do not matter."""
        omega, uncertainty = self._plate.omega, self._plate.rig.uncertainty
        stiffness = np.array([era.stiffness for era in eras])
        damping = np.array([era.damping for era in eras])
        each = (
            attached_stiffness(eras, (), omega),
            drive_forces(eras, omega),
            full_strokes(eras, omega),
            np.broadcast_to(uncertainty.stiffness * stiffness, (len(omega), len(eras))),
            self._log_damping * 1j * omega[:, None] * damping,
        )
        return Mounts(*(values.astype(np.complex64) for values in each))

    def scores(self, places: Places, chosen: IntArray, mounts: Mounts) -> list[FloatArray]:
        """Score [dB] of the contact sets (s,) of each group for ERAs at chosen places (n,)."""
        target, power = self.forms(places, chosen, mounts)
        return [self._group(target, power, fingers) for fingers in self._plate.groups]

    def mean(self, places: Places, chosen: IntArray, mounts: Mounts) -> float:
        """Mean score [dB], each number of fingers counting the same."""
        return float(np.mean([each.mean() for each in self.scores(places, chosen, mounts)]))

    def forms(
        self, places: Places, chosen: IntArray, mounts: Mounts
    ) -> tuple[Complex64Array, Complex64Array]:
        """Mean fields (f, m, n) [m/s²] at the fingertips, and expected power there (f, m, n, n)."""
        weights, D, minus_omega2 = self._plate.weights, self._finger, self._minus_omega2
        m, p = weights.shape
        n = len(chosen)
        # The plate on the ERAs, without fingers.
        A = places.between[:, chosen[:, None], chosen]
        E = places.to_tips[:, :, chosen]
        f = len(A)
        K = np.linalg.inv(np.eye(n, dtype=np.float32) + mounts.stiffness[:, :, None] * A)
        F = K * mounts.force[:, None]
        G = E @ K
        motion = -(A @ F)
        motion.reshape(f, -1)[:, :: n + 1] += mounts.stroke

        # The finger, where it rests.
        G_f = G[:, ::p]
        L = self._plate.own - (
            (E[:, ::p] * mounts.stiffness[:, None])[:, :, None] * G.reshape(f, m, p, n)
        ).sum(axis=3)
        released = 1 / (1 + D[:, :, 0] * L[:, :, 0])  # (f, m)
        reaction = (L * (D[:, :, 0] * released)[:, :, None]).reshape(f, m * p, 1)
        t = G - reaction * np.repeat(G_f, p, axis=1)
        h = t * (minus_omega2 * mounts.force[:, None])
        u_f = G_f * mounts.force[:, None]  # without its load, (f, m, n)

        parts = [h, (t * (minus_omega2 * mounts.by_damping[:, None])) @ motion]
        dA = places.between_change
        if dA is not None and places.tips_change is not None:
            dE = places.tips_change[:, :, chosen]
            held = mounts.stiffness[:, :, None] * (dA[:, chosen[:, None], chosen] @ F)
            change = minus_omega2 * (dE @ F - G @ held)
            parts.append(change - reaction * np.repeat(change[:, ::p], p, axis=1))
        root = np.sqrt(weights).reshape(-1, 1)
        rows = [(each * root).reshape(f, m, p, n) for each in parts]
        reach = np.sqrt(_mean_power(t, weights)) * -minus_omega2
        springs = mounts.by_stiffness[:, :, None] * motion
        rows.append(reach[..., None] * springs[:, None])
        if self._load_std > 0:
            by_load = (
                _mean_power(L.reshape(f, m * p, 1), weights) * np.abs(released)[..., None] ** 2
            )
            load = np.sqrt(by_load) * minus_omega2 * (self._load_std * D)
            rows.append((load * released[..., None] * u_f)[:, :, None])
        every = np.concatenate(rows, axis=2)
        power = every.conj().swapaxes(2, 3) @ every
        diagonal = power.reshape(f, m, -1)[..., :: n + 1]
        ridge = _RIDGE / n * diagonal.real.sum(axis=2, keepdims=True)
        diagonal += self._gain_variance * _mean_power(h, weights) + ridge + _LEAST
        target = (h.reshape(f, m, p, n) * weights[..., None]).sum(axis=2)
        return target, power

    def _group(
        self, target: Complex64Array, power: Complex64Array, fingers: IntArray
    ) -> FloatArray:
        """Score [dB] of sets (s, k) of fingers, (s,)."""
        f, _, n = target.shape
        s, q = len(fingers), fingers.shape[1] - 1
        quiet = fingers[:, 1:]
        c = target[:, fingers[:, 0]].conj()
        R = power[:, quiet[:, 0]] if q == 1 else power[:, quiet].sum(axis=2) / np.float32(q)
        w = np.linalg.solve(R, c[..., None])[..., 0]
        bound = self._decibels(np.vecdot(c, w).real, c, w, np.arange(f)[:, None])
        if q == 1:
            return np.asarray(bound.max(axis=0), dtype=float)
        kept = min(BEST_FREQUENCIES, f)
        rows = best_rows(bound, kept)
        some = (rows, np.arange(s))
        c, w = c[some], w[some]
        R = power[rows[..., None], quiet]  # (kept, s, q, n, n)
        best = np.full(s, -np.inf)
        shares = np.ones((kept, s, q), dtype=np.float32)
        for step in range(LAWSON_STEPS + 1):
            each = w[:, :, None]
            expected = np.vecdot(each, np.matvec(R, each)).real
            peak = np.abs(np.vecdot(c, w))
            score = peak**2 / np.maximum(expected.max(axis=2), _LEAST)
            best = np.maximum(best, self._decibels(score, c, w, rows).max(axis=0))
            if step < LAWSON_STEPS:
                shares = shares * np.sqrt(np.maximum(expected, _LEAST))
                shares /= shares.sum(axis=2, keepdims=True)
                mean = (shares[:, :, None] @ R.reshape(kept, s, q, -1)).reshape(kept, s, n, n)
                w = np.linalg.solve(mean, c[..., None])[..., 0]
        return np.asarray(best, dtype=float)

    def _decibels(
        self, score: Float32Array, c: Complex64Array, w: Complex64Array, rows: IntArray
    ) -> Float32Array:
        """Scores (f, s) of weights (f, s, n) less what their level misses."""
        level = np.abs(np.vecdot(c, w)) / np.maximum(np.abs(w).max(axis=-1), _LEAST)
        missing = 20 * np.log10(np.maximum(level, _LEAST) / self._wanted[rows])
        return np.asarray(
            10 * np.log10(np.maximum(score, _LEAST)) + LEVEL_PENALTY * np.minimum(missing, 0)
        )


def _mean_power(values: Complex64Array, weights: Float32Array) -> Float32Array:
    """Mean of |values|² (f, m p, n) over fingertips of weights (m, p), (f, m, n)."""
    power = values.real**2 + values.imag**2
    f, _, n = power.shape
    return np.asarray((weights[:, None] @ power.reshape(f, *weights.shape, n))[:, :, 0])
