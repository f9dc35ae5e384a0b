"""By how much a plate differs from its rig, and what that costs in contrast."""

from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.choice import best_along
from model.diagnosis.plate_match import Match
from model.rig.rig import Rig

NOTICEABLE_DB = 1.0
"""Loss of contrast that a report names [dB]."""


@dataclass(frozen=True)
class PlateDifference:
    """The most probable plate against the rig's.

    changes: by kind of value, relative, of ERAs the mean (bolts are left out, with none in most
    rigs); contrast_db: median that patterns for the rig reach on that plate with one quiet finger,
    contrast_known_db: that patterns for that plate reach.
    """

    changes: dict[str, float]
    contrast_db: float
    contrast_known_db: float

    @property
    def loss_db(self) -> float:
        """Contrast that the difference costs [dB]."""
        return self.contrast_known_db - self.contrast_db


def plate_difference(rig: Rig, rig_responses: ComplexArray, match: Match) -> PlateDifference:
    """Compare a rig with the match of its plate; rig_responses (f, e, s)."""
    kinds = ("modulus", "loss_factor", "stiffness", "damping")
    changes = {}
    for kind in kinds:
        found = [
            row.of(match.rig) / row.of(rig) - 1
            for row in match.plate.rows
            if row.kind == kind and row.of(rig)
        ]
        if found:
            changes[kind] = float(np.mean(found))
    variance = max(rig.uncertainty.gain_variance, 1e-6)
    known = _contrasts(match.responses, match.responses, variance)
    reached = _contrasts(rig_responses, match.responses, variance)
    return PlateDifference(changes, float(np.median(reached)), float(np.median(known)))


def _contrasts(model: ComplexArray, true: ComplexArray, variance: float) -> FloatArray:
    """Contrasts [dB] of every sensor against every other one, of phased drives for a model.

    Responses (f, e, s); variance: of each ERA's gain. For target t and quiet q the weights maximize
    |a_t w|² / (|a_q w|² + variance sum |a_q w|²), at the frequency that the model prefers.
    """
    _, e, s = model.shape
    quiet = np.moveaxis(model, 2, 1)  # (f, s, e)
    error = variance * np.abs(quiet) ** 2
    matrix = quiet.conj()[..., :, None] * quiet[..., None, :] + error[..., None] * np.eye(e)
    weights = np.linalg.solve(matrix, model.conj()[:, None])  # (f, q, e, t)

    def ratio(responses: ComplexArray) -> FloatArray:
        at = np.moveaxis(responses, 2, 1)
        target = np.abs(np.einsum("fte,fqet->fqt", at, weights)) ** 2
        rest = np.abs(np.einsum("fqe,fqet->fqt", at, weights)) ** 2
        leakage = variance * np.einsum("fqe,fqet->fqt", np.abs(at) ** 2, np.abs(weights) ** 2)
        return np.asarray(10 * np.log10(target / (rest + leakage)))

    best = best_along(ratio(model), axis=0)
    found = np.take_along_axis(ratio(true), best[None], axis=0)[0]
    return np.asarray(found[~np.eye(s, dtype=bool)])
