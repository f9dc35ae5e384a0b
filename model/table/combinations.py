"""Combinations of a tone for each of several contents, by the worst finger on drawn plates."""

import ctypes
from collections.abc import Sequence
from ctypes import c_float, c_int, c_size_t, c_void_p
from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.choice import best_few, best_of
from model.compiled.kernels import kernels
from model.compiled.lanes import as_given, work_space
from model.ensemble.measures import PERCENTILE, percentile

MAX_COMBINATIONS, PRUNING_STEP = 200, 4
"""Combinations of candidates that are kept for the next content and the choice, by some draws."""

_TINY = 1e-20


@dataclass(frozen=True, eq=False)
class Stream:
    """A content for fingers, by index, at a level.

    rows: of the frequencies that it may have, for each band (one unless bands may be exchanged).
    """

    targets: tuple[int, ...]
    level_db_sl: float
    rows: tuple[IntArray, ...]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates (m,) of all contents: of which stream and band, row, weights (m, n)."""

    streams: IntArray
    bands: IntArray
    rows: IntArray
    weights: Complex64Array


def best_combination(
    candidates: Candidates,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    own: Float32Array,
    loudest: Float32Array,
    frequencies: FloatArray,
    apart_hz: float,
) -> tuple[IntArray, bool]:
    """A candidate of each content (K,), and whether their frequencies are apart.

    own (m, d), loudest (m, k, d): amplitude and power of the candidates, at the contents' levels.
    Of all that exchange bands and are apart, else of all that exchange bands.
    """
    hertz, may_exchange = frequencies[candidates.rows], len(streams[0].rows) > 1
    for gap in (apart_hz, 0.0):
        combinations = np.flatnonzero(candidates.streams == 0)[:, None]
        for number in range(1, len(streams)):
            own_candidates = np.flatnonzero(candidates.streams == number)
            combinations = np.concatenate(
                [
                    np.repeat(combinations, len(own_candidates), axis=0),
                    np.tile(own_candidates, len(combinations))[:, None],
                ],
                axis=1,
            )
            last, before = combinations[:, -1:], combinations[:, :-1]
            allowed = (np.abs(hertz[last] - hertz[before]) >= gap).all(axis=1)
            if may_exchange:
                allowed &= (candidates.bands[last] != candidates.bands[before]).all(axis=1)
            combinations = combinations[allowed]
            if len(combinations) > MAX_COMBINATIONS:
                some = own[:, ::PRUNING_STEP], loudest[:, :, ::PRUNING_STEP]
                worst = worst_ratios(combinations, streams, quiet, *some)
                combinations = combinations[best_few(worst, MAX_COMBINATIONS)]
        if len(combinations):
            worst = worst_ratios(combinations, streams, quiet, own, loudest)
            return combinations[best_of(worst)], gap == apart_hz
    raise AssertionError("contents with as many bands must have a combination")


def worst_ratios(
    combinations: IntArray,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    own: Float32Array,
    loudest: Float32Array,
) -> FloatArray:
    """Power ratio at the worst finger on nine of ten plates, of combinations (c, j): (c,).

    Of the first j contents alone.
    """
    by = kernels()
    if by is None:
        return _by_numpy(combinations, streams, quiet, own, loudest)
    (count, contents), (_, fingers, draws) = combinations.shape, loudest.shape
    content = np.full(fingers, -1, dtype=np.int32)
    content[[*quiet]] = contents
    for number, stream in enumerate(streams[:contents]):
        content[[*stream.targets]] = number
    at = np.ascontiguousarray(combinations, dtype=np.int32)
    given, worst = [content, as_given(own**2), as_given(loudest)], np.empty(count, np.float32)
    place = PERCENTILE / 100 * (draws - 1)
    low = int(place)
    pointers = [each.ctypes.data for each in given]
    on = ctypes.byref(_Tones(contents, fingers, draws, low, place - low, *pointers))
    by.library.combinations_space.restype = c_size_t
    work = work_space(by, by.library.combinations_space(on))
    found = c_void_p(at.ctypes.data), count, work, c_void_p(worst.ctypes.data)
    by.library.worst_of_combinations(on, *found)
    return worst.astype(float)


class _Tones(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in ("contents", "fingers", "draws", "low")),
        ("part", c_float),
        *((name, c_void_p) for name in ("content", "own", "loudest")),
    )


def _by_numpy(
    combinations: IntArray,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    own: Float32Array,
    loudest: Float32Array,
) -> FloatArray:
    """As `worst_ratios` without a compiler."""
    levels, total = own[combinations] ** 2, loudest[combinations].sum(axis=1)
    worst = np.full((len(combinations), own.shape[1]), np.inf, dtype=np.float32)
    for j, at in enumerate(combinations.T):
        if combinations.shape[1] > 1:
            for finger in streams[j].targets:
                others_power = np.maximum(total[:, finger] - loudest[at, finger], _TINY)
                worst = np.minimum(worst, levels[:, j] / others_power)
    for finger in quiet:
        worst = np.minimum(worst, levels.min(axis=1) / np.maximum(total[:, finger], _TINY))
    return percentile(worst.astype(float))
