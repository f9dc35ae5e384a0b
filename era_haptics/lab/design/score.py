"""Fast score of layouts, and a search for ERA positions that maximizes it.

The score is the expected contrast over sampled contact sets, computed like answers
(`model.ensemble.expected_power`, `model.drive_modes`), at a few frequencies, from the receptances
of the free plate. Each finger loads the plate at its own position; its effect on the other fingers
is neglected, so everything is computed once per finger. With ERAs e of dynamic stiffness Z on the
plate, a finger f of dynamic stiffness D and its points p:

    K = (1 + Z A_ee)^-1,  G = A_pe K,  L = A_pf - G Z A_ef,  M = D / (1 + D L_f)
    t_e = G_p - L_p M G_f,  h = -w² t_e z stroke,  r_e = stroke - u_e,  r_f = -u_f
    R = mean_p {h* h^T + dh* dh^T + dc* dc^T + sum_j |s_j w² t_j|² r_j* r_j^T + sigma² diag |h|²}
        + field² mean_plate diag |h|²

where dh comes from the plates thicker and thinner by one standard deviation, each solved exactly
with half weight, dc from the ERAs' damping, and s_j from each ERA's stiffness and the finger's
load. The last term is over the plate without fingers, as in `LocalizationTable.error_power`. The
score of a set is |h_t w|² / max_q w^H R_q w of the best weights w at the best frequency, minus a
tenth of the shortfall from the wanted level, since an answer that has to reach the level loses
little contrast. With several contents it is the score of the worst one, with all other fingers
quiet, because their crosstalk sums to little more than the highest. Each content is then searched
at a multiple of the level, since they share the stroke.

The search adds, one ERA after the other, the candidate that raises the score most. Exchanges then
move one ERA at a time to the best candidate until none improves. Finally every ERA is moved by ever
smaller steps, independently of the candidates. A list of layouts is a search without steps.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from era_haptics.lab.design.problem import (
    ANYWHERE,
    MIN_SUPPORTING,
    SEARCH_FINGERS,
    DesignProblem,
    area_of,
)
from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray, best_by, best_rows
from model.ensemble.attached_plate import mounts_of
from model.ensemble.expected_power import expected_power, power_of
from model.errors import InputError
from model.finger import FIVE_POINTS, STRONG_DB_SL, Grid, detection_threshold, fingertips_on
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.structure.attachments import coupled_forces
from model.structure.exciter import Actuator

_LEVEL_RESERVE = 1.2
"""Factor on the wanted level, as 90 % of plates need more than the nominal plate."""

BEST_FREQUENCIES = 3
"""Frequencies of each set at which the maximum over the quiet fingers is minimized."""

_LAWSON_STEPS = 2

LEVEL_PENALTY = 0.1
"""Score penalty per dB of missing level; with 1 instead of 0 to 0.15, scores predict answers
worse."""

_LEAST = np.float32(1e-30)

MAX_SWEEPS = 4
"""Exchanges of every ERA."""

FINEST_STEP = 0.001
"""Last step of freely moved positions [m]."""

_GAIN = 0.01  # dB; smaller gains do not justify a move
_UNSUPPORTED = -100.0  # dB; below the score of every layout that supports the plate


@dataclass(frozen=True, eq=False)
class PlaceReceptances:
    """Receptances [m/N] of c positions on plates of v thicknesses, the nominal one first.

    at (c, 2) [m]; between (v, f, c, c); to_tips (v, f, m p, c): at the points of m fingertips;
    to_plate (f, g, c): over the nominal plate, empty if the rig's field has no uncertainty.
    """

    at: FloatArray
    between: Complex64Array
    to_tips: Complex64Array
    to_plate: Complex64Array


class Scorer:
    """Score layouts on a rig's plate, solved once, with given contact sets.

    frequencies (f,) [Hz]; sets: contacts (fingers, 2) [m] of each set, those with contents first;
    eras: ERAs of every layout in order, at any positions; additional ones equal the last.
    """

    def __init__(
        self,
        rig: Rig,
        frequencies: FloatArray,
        sets: Sequence[FloatArray],
        *,
        eras: Sequence[Actuator],
        contents: int = 1,
    ) -> None:
        self._rig = rig
        self._frequencies, self._omega = frequencies, 2 * np.pi * frequencies
        uncertainty = rig.uncertainty
        std = uncertainty.frequency  # a modulus shifts resonances like a thickness
        self._thicknesses = np.array([1.0, 1 + std, 1 - std] if std > 0 else [1.0])
        self._mounts = mounts_of(eras, (), self._omega, uncertainty)
        tip = rig.fingertip
        finger = np.zeros(len(frequencies)) if tip is None else tip.dynamic_stiffness(self._omega)
        self._finger = finger.astype(np.complex64)[:, None]
        self._contents = contents
        least = _LEVEL_RESERVE * contents * 10 ** (STRONG_DB_SL / 20)
        threshold = detection_threshold(frequencies, rig.threshold)
        self._required = (least * threshold).astype(np.float32)
        self._free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(frequencies.max()))
        centres, numbers = np.unique(np.vstack(sets), axis=0, return_inverse=True)
        points, weights = fingertips_on(
            centres, length=rig.plate.length, width=rig.plate.width, rule=FIVE_POINTS
        )
        self._points = points.reshape(-1, 2)
        self._weights: Float32Array = weights.astype(np.float32)  # (m, p), the center first
        self._cells = np.empty((0, 2))
        if uncertainty.field > 0:
            self._cells = Grid(12, 9).centres(rig.plate)
        # Sets of equal size form one array (s, k).
        sizes = [len(each) for each in sets]
        first = np.cumsum(sizes) - sizes
        self._groups = tuple(
            numbers.ravel()[first[np.equal(sizes, size)][:, None] + np.arange(size)]
            for size in np.unique(sizes).tolist()
        )
        # From a fingertip's center to its points, (v, f, m, p).
        every, tips = np.arange(len(centres)), self._solved(centres).to_tips
        tips = tips.reshape(*tips.shape[:2], *weights.shape, -1)
        self._own = np.moveaxis(tips[:, :, every, :, every], 0, 2)

    def places(self, at: FloatArray) -> PlaceReceptances:
        """Solve for ERAs at positions [m] (c, 2)."""
        return self._solved(np.column_stack([at, np.full(len(at), self._rig.eras[0].foot)]))

    def _solved(self, footprints: FloatArray) -> PlaceReceptances:
        between, to_points = self._free.receptances(
            footprints,
            self._points,
            self._frequencies,
            loads=self._rig.masses,
            thickness=self._thicknesses,
        )
        to_tips = np.ascontiguousarray(to_points.swapaxes(2, 3), dtype=np.complex64)
        _, to_plate = self._free.receptances(
            footprints, self._cells, self._frequencies, loads=self._rig.masses
        )
        over_plate = np.asarray(to_plate.swapaxes(1, 2), dtype=np.complex64)
        return PlaceReceptances(
            footprints[:, :2], between.astype(np.complex64), to_tips, over_plate
        )

    def mean(self, places: PlaceReceptances, chosen: IntArray) -> float:
        """Return the mean score [dB] of ERAs at chosen positions (n,), equal weight per number of
        fingers."""
        target, power = self._forms(places, chosen)
        scores = [self._of_sets(target, power, fingers).mean() for fingers in self._groups]
        return float(np.mean(scores))

    def _of_sets(
        self, target: Complex64Array, power: Complex64Array, fingers: IntArray
    ) -> FloatArray:
        """Return the score [dB] of the worst content for sets (s, k) of fingers, (s,)."""
        each = [
            self._score(target, power, np.roll(fingers, -number, axis=1))
            for number in range(self._contents)
        ]
        return np.asarray(np.min(each, axis=0))

    def _forms(
        self, places: PlaceReceptances, chosen: IntArray
    ) -> tuple[Complex64Array, Complex64Array]:
        """Return mean fields (f, m, n) [m/s²] at the fingertips, and expected power there (f, m, n,
        n)."""
        uncertainty, weights, D = self._rig.uncertainty, self._weights, self._finger
        m, p = weights.shape
        n, mounts = len(chosen), self._mounts
        which = np.minimum(np.arange(n), mounts.stiffness.shape[1] - 1)
        Z, force, stroke, by_stiffness, by_damping = (
            each[:, which]
            for each in (
                mounts.stiffness,
                mounts.forces,
                mounts.strokes,
                mounts.by_stiffness,
                mounts.by_damping,
            )
        )
        minus_omega2 = mounts.minus_omega2[:, None, None]
        # Plates on the ERAs, without fingers; other thicknesses come first.
        A = places.between[:, :, chosen[:, None], chosen]
        E = places.to_tips[:, :, :, chosen]
        v, f = A.shape[:2]
        K = coupled_forces(A, Z, np.eye(n, dtype=np.complex64))
        G = E @ K

        # Add the finger at its position.
        G_f = G[:, :, ::p]
        held = (E[:, :, ::p] * Z[:, None])[..., None, :] * G.reshape(v, f, m, p, n)
        L = self._own - held.sum(axis=-1)
        released = 1 / (1 + D * L[..., 0])  # (v, f, m)
        reaction = L * (D * released)[..., None]
        t = G.reshape(v, f, m, p, n) - reaction[..., None] * G_f[:, :, :, None]
        scale = minus_omega2 * force[:, None]
        fields = t * scale[:, None]
        h = fields[0]

        # Sensitivities of the nominal plate.
        motion = -(A[0] @ (K[0] * force[:, None]))
        motion.reshape(f, -1)[:, :: n + 1] += stroke
        t, L, released, G_f = t[0], L[0], released[0], G_f[0]
        damping = t.reshape(f, -1, n) @ (minus_omega2 * by_damping[:, :, None] * motion)
        parts = [h, damping.reshape(h.shape), *((fields[1:] - h) * np.float32(math.sqrt(0.5)))]
        reach = np.sqrt(_mean_power(t, weights)) * -minus_omega2
        own = reach[..., None] * (by_stiffness[:, :, None] * motion)[:, None]
        if uncertainty.fingertip > 0:
            by_load = np.sqrt(_mean_power(L[..., None], weights)) * np.abs(released)[..., None]
            load = by_load * np.float32(uncertainty.fingertip) * (D * released)[..., None]
            own = np.concatenate([own, (load * G_f * scale)[:, :, None]], axis=2)
        error = np.full((f, 1, n), _LEAST)
        if uncertainty.field > 0:
            over_plate = places.to_plate[:, :, chosen] @ K[0] * scale
            mean_square = (np.abs(over_plate) ** 2).mean(axis=1, keepdims=True)
            error += np.float32(uncertainty.field**2) * mean_square
        power = expected_power(
            parts, own, weights, gain_variance=uncertainty.gain_variance, error_power=error
        )
        return (h * weights[..., None]).sum(axis=2), power

    def _score(
        self, target: Complex64Array, power: Complex64Array, fingers: IntArray
    ) -> FloatArray:
        """Return the score [dB] for sets (s, k) of fingers, (s,); only the first finger has the
        content."""
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
        for step in range(_LAWSON_STEPS + 1):
            each = w[:, :, None]
            expected = np.vecdot(each, np.matvec(R, each)).real
            peak = np.abs(np.vecdot(c, w))
            score = peak**2 / np.maximum(expected.max(axis=2), _LEAST)
            best = np.maximum(best, self._decibels(score, c, w, rows).max(axis=0))
            if step < _LAWSON_STEPS:
                shares = shares * np.sqrt(np.maximum(expected, _LEAST))
                shares /= shares.sum(axis=2, keepdims=True)
                mean = (shares[:, :, None] @ R.reshape(kept, s, q, -1)).reshape(kept, s, n, n)
                w = np.linalg.solve(mean, c[..., None])[..., 0]
        return np.asarray(best, dtype=float)

    def _decibels(
        self, score: Float32Array, c: Complex64Array, w: Complex64Array, rows: IntArray
    ) -> Float32Array:
        """Return scores (f, s) of weights (f, s, n), minus the penalty for missing level."""
        level = np.abs(np.vecdot(c, w)) / np.maximum(np.abs(w).max(axis=-1), _LEAST)
        missing = 20 * np.log10(np.maximum(level, _LEAST) / self._required[rows])
        return np.asarray(
            10 * np.log10(np.maximum(score, _LEAST)) + LEVEL_PENALTY * np.minimum(missing, 0)
        )


def _mean_power(values: Complex64Array, weights: Float32Array) -> Float32Array:
    """Return the mean of |values|² (f, m, p, n) over fingertips with weights (m, p), (f, m, n)."""
    return np.asarray((weights[:, None] @ power_of(values))[:, :, 0])


@dataclass(frozen=True, eq=False)
class ScoredLayout:
    """Layout with positions (n, 2) [m], kept ones first, and its score [dB]."""

    positions: FloatArray
    score_db: float

    @property
    def is_supported(self) -> bool:
        """Return whether it supports the plate."""
        return self.score_db > _UNSUPPORTED


class LayoutSearch:
    """Searches layouts of a problem; its seed draws the contact sets for the scores."""

    def __init__(self, problem: DesignProblem) -> None:
        """Solve the plate for all candidates; raises InputError for an area without room."""
        self.problem = problem
        kept = problem.kept_positions
        self._k = len(kept)
        self._scorer = Scorer(
            problem.rig,
            problem.searched_frequencies,
            problem.contacts.pooled_sets(SEARCH_FINGERS, seed=problem.seed),
            eras=problem.eras(np.zeros((self._k + 1, 2))),
            contents=problem.contacts.contents,
        )
        self._places = self._scorer.places(np.vstack([kept, problem.candidates]))

    def path(self) -> Iterator[ScoredLayout]:
        """Yield layouts with increasing numbers of ERAs, starting with the kept or the minimum
        number."""
        problem, positions = self.problem, self.problem.kept_positions
        while len(positions) < problem.count:
            positions = self.add(positions).positions
            if len(positions) + problem.supports >= MIN_SUPPORTING:
                positions = self.exchange(positions, sweeps=1 + (len(positions) == problem.count))
                yield self.refine(positions)
        if len(positions) == self._k:
            yield self.refine(positions)

    def from_random(self, rng: np.random.Generator) -> ScoredLayout:
        """Search from a random layout; raises InputError if there is no room."""
        return self.refine(self.exchange(self.problem.random_layout(rng)))

    def add(self, positions: FloatArray) -> ScoredLayout:
        """Add the best candidate to positions (n, 2) [m]; raises InputError without room."""
        tried = [np.vstack([positions, place]) for place in self._open(positions)]
        return best_by(self.scored(tried), _score)

    def exchange(self, positions: FloatArray, *, sweeps: int = MAX_SWEEPS) -> FloatArray:
        """Move one ERA after the other to the best candidate, until none gains, (n, 2) [m]."""
        (best,) = self.scored([positions])
        unchanged, count = 0, len(positions)
        for number in sweeps * list(range(self._k, count)):
            rest = np.delete(best.positions, number, axis=0)
            tried = _replaced(best.positions, number, self._open(rest))
            found = best_by(self.scored(tried), _score)
            gains = found.score_db > best.score_db + _GAIN
            best, unchanged = (found, 0) if gains else (best, unchanged + 1)
            if unchanged >= count - self._k:
                break
        return best.positions

    def one_more(self, positions: FloatArray) -> ScoredLayout | None:
        """Add the best candidate to positions (n, 2) [m], then move all ERAs; None without room."""
        try:
            return self.refine(self.add(positions).positions)
        except InputError:
            return None

    def refine(self, positions: FloatArray) -> ScoredLayout:
        """Refine positions (n, 2) [m] by ever smaller steps."""
        (best,) = self.scored([positions])
        step = self.problem.spacing / 2
        while step >= FINEST_STEP / 2:
            before = best.score_db
            for number in range(self._k, len(positions)):
                moves = self.problem.area.moved(best.positions[number], step)
                tried = _replaced(best.positions, number, moves)
                found = self.scored([each for each in tried if self.problem.are_apart(each)])
                for each in found:
                    if each.score_db > best.score_db + _GAIN:
                        best = each
            if best.score_db <= before + _GAIN:
                step /= 2
        return best

    def scored(self, layouts: Sequence[FloatArray]) -> list[ScoredLayout]:
        """Score layouts (n, 2) [m] without changing them."""
        if not layouts:
            return []
        every = np.unique(np.vstack(layouts), axis=0)
        is_known = (every[:, None] == self._places.at).all(axis=-1).any(axis=1).all()
        places = self._places if is_known else self._scorer.places(every)
        return [ScoredLayout(each, self._score_at(places, each)) for each in layouts]

    def sensitivities(self, positions: FloatArray, *, step: float) -> FloatArray:
        """Return the largest change of the score [dB] per meter for a step [m] of each ERA,
        (n,)."""
        (own,) = self.scored([positions])
        changes = np.zeros(len(positions))
        for number, place in enumerate(positions):
            found = self.scored(_replaced(positions, number, self._steps(place, step)))
            supported = [abs(each.score_db - own.score_db) for each in found if each.is_supported]
            changes[number] = max(supported, default=0.0) / step
        return changes

    def _steps(self, place: FloatArray, step: float) -> FloatArray:
        """Return steps of a position within the area; anywhere on the plate if it is outside the
        area."""
        area, plate = self.problem.area, self.problem.rig.plate
        if area.contains(place[None])[0]:
            found = area.moved(place, step)
            if len(found):
                return found
        return area_of(ANYWHERE, plate).moved(place, step)

    def _score_at(self, places: PlaceReceptances, positions: FloatArray) -> float:
        """Return the score [dB] of positions among `places`, far below 0 if the plate is not
        supported."""
        if len(positions) + self.problem.supports >= MIN_SUPPORTING:
            shortfall = self.problem.shortfall(positions)
            if shortfall > 0:
                return _UNSUPPORTED * (1 + shortfall)
        numbers = (places.at == positions[:, None]).all(axis=-1).argmax(axis=1)
        return self._scorer.mean(places, numbers)

    def _open(self, positions: FloatArray) -> FloatArray:
        """Return the candidates [m] far enough from positions (n, 2) [m]; raises InputError for
        none."""
        return self.problem.candidates[self.problem.open_candidates(positions)]


def _score(found: ScoredLayout) -> float:
    return found.score_db


def _replaced(positions: FloatArray, number: int, places: FloatArray) -> list[FloatArray]:
    """Return positions (n, 2) with one ERA moved to each of the places (m, 2)."""
    at = np.arange(len(positions))[:, None] == number
    return [np.where(at, place, positions) for place in places]
