"""How well a fit predicts tones that it was not shown: every fifth one, five times over."""

from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.identification.fit import Problem, solve
from model.identification.stages import Fitted

_FOLDS = 5
_EVALUATIONS = 8


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of prediction at tones (f,) [Hz]: root mean square relative to the response there.

    errors (f,): without what noise explains; total: of all tones together, the same.
    """

    frequencies: FloatArray
    errors: FloatArray
    total: float

    def at(self, frequencies: FloatArray) -> FloatArray:
        """Error at other frequencies [Hz], linear between tones, of their shape."""
        return np.asarray(np.interp(frequencies, self.frequencies, self.errors))


def hold_out(fitted: Fitted) -> HeldOut | None:
    """Predict tones from a fit to the others; None where there are fewer than ten."""
    measurement, model = fitted.problem.measurement, fitted.problem.model
    count = len(measurement.tones)
    if count < 2 * _FOLDS:
        return None
    predicted = np.empty(len(measurement.values), dtype=complex)
    for fold in range(_FOLDS):
        unseen = measurement.rows % _FOLDS == fold
        part = measurement.part(~unseen)
        shown = model.with_frequencies(part.tones)
        free = fitted.space.uncertain
        found = solve(Problem(shown, part), fitted.best.x, free, evaluations=_EVALUATIONS)
        rest = measurement.part(unseen)
        responses = model.with_frequencies(rest.tones).at(found.x).responses
        predicted[unseen] = responses[rest.rows, rest.at, rest.eras]
    values, rows = measurement.values, measurement.rows
    squares = np.bincount(rows, np.abs(predicted - values) ** 2 - 2 * measurement.std**2)
    sizes = np.bincount(rows, np.abs(values) ** 2)
    return HeldOut(
        measurement.tones,
        np.sqrt(np.maximum(squares, 0) / sizes),
        float(np.sqrt(max((squares / sizes).mean(), 0.0))),
    )
