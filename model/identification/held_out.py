"""How well a fit predicts paths that it was not shown: every fifth one, five times over.

A path is from an ERA to a sensor, and what it shows is shown by the reverse one as well. Paths tell
how far the fields are off that are not measured; tones left out would tell whether a resonance was
seen, which the covariance knows. What counts against a model is the part of the error that neither
noise nor the uncertainty of the parameters explains. In that part fits to different paths disagree
in parameters, too, by more than their covariance says (a jackknife over groups: B. Efron, The
Jackknife, the Bootstrap and Other Resampling Plans, SIAM 1982, ch. 3).
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.identification.derivatives import jacobian
from model.identification.least_squares import IdentificationProblem, solve
from model.identification.stages import FittedModel, chi2
from model.processes import Progress, unseen

SHARE = 5
"""One in so many is held out."""

_EVALUATIONS = 8
_PREDICTED = 0.1  # of the rms at a tone: standard error of a prediction that can be held against it
_LEAST_VALUES = 16
# Of standard deviations: what no path tells is wrong in all fits alike.
_IN_COMMON = 2.0


@dataclass(frozen=True, eq=False)
class HeldOutPaths:
    """Errors of prediction, root mean square relative to the responses at a tone.

    total: without what noise explains; unexplained: without what noise and the uncertain parameters
    explain together; disagreement: covariance (p, p) of parameters x beside that of their fit.
    """

    total: float
    unexplained: float
    disagreement: FloatArray


def hold_out(fitted: FittedModel, *, progress: Progress = unseen) -> HeldOutPaths | None:
    """Predict paths from a fit to the others; None where these do not tell enough of them."""
    measurement, model = fitted.problem.measurement, fitted.problem.model
    folds = (model.observed[:, None] + np.arange(len(model.rig.eras))) % SHARE
    squares, variance = np.full((2, *measurement.values.shape), np.nan)
    free, fits = np.flatnonzero(fitted.space.uncertain), []
    noise = min(chi2(fitted), 1.0)  # readings may be better than they are stated
    for fold in range(SHARE):
        progress(1 + fold, 1 + SHARE)
        unseen = measurement.known & (folds == fold)
        if not unseen.any():
            continue
        if (unseen == measurement.known).all():
            return None
        shown = IdentificationProblem(model, measurement.part(folds != fold))
        found = solve(shown, fitted.best.x, fitted.space.uncertain, evaluations=_EVALUATIONS)
        fits.append(found.x)
        plate = model.at(found.x)
        error = (plate.responses - measurement.values)[unseen]
        squares[unseen] = np.abs(error) ** 2 - 2 * noise * measurement.std[unseen] ** 2
        J = jacobian(plate)[unseen][:, free]
        covariance = linalg.inv(found.information[np.ix_(free, free)])
        variance[unseen] = ((J @ covariance) * J.conj()).sum(axis=1).real
    mean_square = np.broadcast_to(measurement.tone_rms**2, variance.shape)
    predicted = variance < _PREDICTED**2 * mean_square
    if predicted.sum() < _LEAST_VALUES:
        return None

    total, unexplained = (
        relative_rms(parts[predicted], mean_square[predicted])
        for parts in (squares, squares - variance)
    )
    share = (unexplained / total) ** 2 if unexplained else 0.0
    off = np.array(fits) - np.mean(fits, axis=0)
    jackknife = (1 - 1 / len(fits)) * off.T @ off
    return HeldOutPaths(total, unexplained, share * _IN_COMMON**2 * jackknife)


def relative_rms(squares: FloatArray, mean_squares: FloatArray) -> float:
    """Root mean square of errors, each relative to the rms of its responses, by their squares.

    None where what is taken from squares, such as noise, exceeds them; infinite where all are NaN.
    """
    share = squares / mean_squares
    known = share[np.isfinite(share)]
    return float(np.sqrt(max(known.mean(), 0.0))) if len(known) else np.inf
