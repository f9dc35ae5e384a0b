"""The search of `model.drive_modes.coherent` by its kernel in C."""

from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.compiled.kernels import Kernels, run
from model.compiled.lanes import address_of, as_given
from model.compiled.structures import GivenForms, Method
from model.drive_modes.coherent import (
    LAWSON_STEPS,
    LEVEL_RELAXATION,
    LEVEL_RESERVE,
    LIMITED_STEPS,
    MAX_GROWTH,
    MAX_MULTIPLIER,
    Coherent,
    CoherentResult,
)
from model.drive_modes.forms import Forms

ONE_FINGER, SEVERAL = Method(steps=1), Method(steps=1 + LAWSON_STEPS)
WITHIN_STROKE = (
    Method(
        steps=LIMITED_STEPS,
        limited=1,
        gain=1,
        reserve=LEVEL_RESERVE,
        growth=MAX_GROWTH,
        most=MAX_MULTIPLIER,
    ),
    *(Method(steps=1, variance=sigma**2, gain=gain) for sigma, gain in LEVEL_RELAXATION),
)


def search(kernels: Kernels, coherent: Coherent, forms: Forms) -> CoherentResult:
    """As `Coherent.search`: by the first method, by further ones where that misses the level."""
    given = _given(coherent, forms)
    first = SEVERAL if forms.quiet.shape[1] > 1 else ONE_FINGER
    found = _tried(kernels, given, np.arange(forms.frequency_count), first)
    score, missed = found.score, found.missed
    for method in WITHIN_STROKE:
        open_ = _level_limited(score, missed)
        if len(open_) == 0:
            break
        more = _tried(kernels, given, open_, method)
        score[open_], found.weights[open_] = more.score, more.weights
        missed[open_] = np.maximum(missed[open_], more.missed)
    is_limited = len(_level_limited(score, missed)) > 0
    return CoherentResult(score, found.weights, found.bound, is_limited)


def _level_limited(score: Float32Array, missed: Float32Array) -> IntArray:
    """Frequencies without weights that reach the level, but of a better score than the best."""
    return np.asarray(((score == 0) & (missed > score.max())).nonzero()[0])


@dataclass(frozen=True, eq=False)
class _Tried:
    """The best weights (n, eras) that reach the level and their score (n,), 0 where none do.

    missed (n,): the best score of those that miss it; bound (n,): upper bound of the score.
    """

    weights: Complex64Array
    score: Float32Array
    missed: Float32Array
    bound: Float32Array


def _given(coherent: Coherent, forms: Forms) -> GivenForms:
    """Forms as kernels read them."""
    _, q, n, _ = forms.quiet.shape
    is_deep = forms.few is not None and forms.fine is not None
    points = [
        each.shape[2] if each is not None and is_deep else 0 for each in (forms.few, forms.fine)
    ]
    found = GivenForms(
        *(n, len(forms.targets), q, *points, forms.wanted, forms.level_margin),
        *(coherent.phases[1], coherent.iterations),
    )
    found.point(
        of_targets=forms.targets.swapaxes(0, 1),
        target_power=forms.target_power.swapaxes(0, 1),
        quiet=forms.quiet,
        threshold=forms.threshold,
        few_fields=forms.few,
        fine_fields=forms.fine,
    )
    return found


def _tried(kernels: Kernels, forms: GivenForms, rows: IntArray, method: Method) -> _Tried:
    """What a method finds at frequencies, by index (n,)."""
    count, at = len(rows), as_given(rows)
    weights = np.empty((count, forms.n), dtype=np.complex64)
    measures = np.empty((3, count), dtype=np.float32)
    to = [address_of(each) for each in (weights, *measures)]
    run(kernels.library.search_stage, forms, method, address_of(at), count, *to)
    return _Tried(weights, *measures)
