"""Several contents at once: one tone each, the other fingers protected from it.

Content j for its fingers is the question "these are targets, all others quiet", and K contents are
K searches over one load of the plate: weights that share the prices of the fingers gain 0.3 dB at
most. Tones of different frequencies add in power. The combination of a few candidates each is
chosen by the worst finger on drawn plates; the promise is of other draws, the same for all tones.

    C_k = g_k own_k / sqrt(max_p sum_j g_j^2 power_j(p)),  j other contents, p points of finger k

and for a quiet finger the weakest content counts, over all contents.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.choice import best_first
from model.drive_modes.forms import Weights
from model.drive_modes.phased import PHASED
from model.ensemble.measures import percentile
from model.table.combinations import Candidates, Stream, best_combination
from model.table.fingers_on_plate import MAX_FINGERS_BY_POINT, DriveResponses, FingersOnPlate
from model.table.pattern_choice import JUDGING_DRAWS, PROMISED_DRAWS, PROMISED_PERCENTILE

MIN_CANDIDATES, ROWS_BY_POINT = 4, 16
"""Candidates of a content by the mean over fingertips and as many by their points; frequencies that
are searched by point."""

_TINY = 1e-20
_NEARLY_HIGHEST = 0.99


@dataclass(frozen=True, eq=False)
class Chosen:
    """The tones of K contents.

    rows (K,): of their frequencies; weights (K, n): up to full stroke; power (K, k, p, 1 + d):
    squared amplitudes to threshold at the points of all fingers, on the plate as modelled and on
    drawn ones; is_apart: whether the frequencies are.
    """

    rows: IntArray
    weights: Complex64Array
    power: Float32Array
    is_apart: bool


def choose_contents(
    fingers: FingersOnPlate,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    frequencies: FloatArray,
    *,
    apart_hz: float,
) -> Chosen:
    """Choose a tone for each content.

    fingers: all on the plate, at rows (f,) of frequencies [Hz]; quiet: those that feel nothing.
    """
    candidates = _candidates(fingers, streams, quiet, frequencies, apart_hz)
    judged = _respond(fingers, candidates.rows, candidates.weights).drawn(JUDGING_DRAWS)
    loudest = judged.loudest[:, :, 1:]
    own = np.empty((len(loudest), loudest.shape[2]), dtype=np.float32)
    for number, stream in enumerate(streams):
        of = candidates.streams == number
        own[of] = judged.means[of][:, [*stream.targets], 1:].min(axis=1)
        gain = 10 ** (stream.level_db_sl / 20) / np.maximum(percentile(own[of]), _TINY)
        own[of] *= gain[:, None]
        loudest[of] *= gain[:, None, None] ** 2
    best, is_apart = best_combination(
        candidates, streams, quiet, own, loudest, frequencies, apart_hz
    )
    return tones_chosen(fingers, candidates.rows[best], candidates.weights[best], is_apart=is_apart)


def tones_chosen(
    fingers: FingersOnPlate, rows: IntArray, weights: Complex64Array, *, is_apart: bool = True
) -> Chosen:
    """Tones at rows (K,) of the frequencies with weights (K, n), and what they promise."""
    drawn = _respond(fingers, rows, weights).drawn(PROMISED_DRAWS, with_powers=True)
    if drawn.powers is None:
        raise AssertionError("powers must be given")
    points = fingers.tips.fine_weights.shape
    power = drawn.powers.reshape(len(rows), *points, -1)
    return Chosen(rows, weights, power, is_apart)


def own_amplitudes(
    power: Float32Array, weights: Float32Array, targets: Sequence[int]
) -> Float32Array:
    """Mean amplitude over the weakest target fingertip, (..., d), of powers (..., k, p, d).

    weights (k, p): of the points in the mean.
    """
    means = [weights[t] @ np.sqrt(power[..., t, :, :]) for t in targets]
    return np.asarray(np.minimum.reduce(means))


def felt_amplitudes(
    power: Float32Array,
    weights: Float32Array,
    rows: IntArray,
    number: int,
    targets: Sequence[int],
) -> Float32Array:
    """The least that a content's fingertips feel of it, (d,), of power (K, k, p, d).

    Tones of other contents at its frequency, by rows (K,), may cancel part of it.
    """
    amplitude = np.sqrt(power[number])
    for other in np.flatnonzero(rows == rows[number]).tolist():
        if other != number:
            amplitude = amplitude - np.sqrt(power[other])
    return own_amplitudes(np.maximum(amplitude, 0) ** 2, weights, targets)


def loudest_power(power: Float32Array, rows: IntArray, finger: int) -> Float32Array:
    """Power (d,) of contents at the loudest point of a finger, of power (j, k, p, d).

    Of contents of one frequency, by rows (j,), the amplitudes add.
    """
    at = power[:, finger]
    total = np.zeros(at.shape[1:], dtype=at.dtype)
    order = np.argsort(rows, kind="stable").tolist()
    for _, same in groupby(order, key=rows.__getitem__):
        total += np.sqrt(at[list(same)]).sum(axis=0) ** 2
    return np.asarray(total.max(axis=0))


def contrasts(
    power: Float32Array,
    weights: Float32Array,
    rows: IntArray,
    streams: Sequence[Stream],
    quiet: Sequence[int],
) -> dict[int, Float32Array]:
    """Ratio of own amplitude to that of others on each plate (d,), by finger; none of one alone.

    That of an only content is the one at the loudest quiet finger.

    power (K, k, p, d): of the contents at their gains; rows (K,): of their frequencies.
    """
    own = [felt_amplitudes(power, weights, rows, j, each.targets) for j, each in enumerate(streams)]
    every = np.arange(len(streams))
    found: dict[int, Float32Array] = {}
    for j, stream in enumerate(streams):
        others = every != j
        if others.any():
            for finger in stream.targets:
                level = felt_amplitudes(power, weights, rows, j, (finger,))
                others_power = loudest_power(power[others], rows[others], finger)
                found[finger] = _ratio(level, others_power)
    for finger in quiet:
        others_power = loudest_power(power, rows, finger)
        found[finger] = _ratio(np.min(own, axis=0), others_power)
    if found and len(streams) == 1:
        loudest = np.min([*found.values()], axis=0)
        found.update(dict.fromkeys(streams[0].targets, loudest))
    return found


def _ratio(level: Float32Array, others_power: Float32Array) -> Float32Array:
    return np.asarray(level / np.sqrt(np.maximum(others_power, _TINY)), dtype=np.float32)


def promise(values: Float32Array, percent: float = PROMISED_PERCENTILE) -> float:
    """Percentile of the drawn plates, without the first, that as modelled."""
    return float(percentile(values[1:].astype(float), percent))


def _respond(fingers: FingersOnPlate, rows: IntArray, weights: Complex64Array) -> DriveResponses:
    return fingers.respond(
        [Weights.at(row, each) for row, each in zip(rows.tolist(), weights, strict=True)]
    )


def _candidates(
    fingers: FingersOnPlate,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    frequencies: FloatArray,
    apart_hz: float,
) -> Candidates:
    """The best drives of each content in each band, apart from each other."""
    every = {*quiet}.union(*(stream.targets for stream in streams))
    count = MIN_CANDIDATES + len(streams) // 2
    found: list[tuple[int, int, int, Complex64Array]] = []
    for number, stream in enumerate(streams):
        others = sorted(every - {*stream.targets})
        for band, rows in enumerate(stream.rows):
            for score, weights in _search(fingers, stream, others, rows, len(streams)):
                for at in _apart(score, frequencies[rows], count, apart_hz):
                    found.append((number, band, int(rows[at]), weights[at]))
    streams_of, bands, at_rows, chosen = zip(*found, strict=True)
    return Candidates(np.array(streams_of), np.array(bands), np.array(at_rows), np.array(chosen))


def _search(
    fingers: FingersOnPlate, stream: Stream, others: Sequence[int], rows: IntArray, contents: int
) -> list[tuple[Float32Array, Complex64Array]]:
    """Scores (n,) and weights (n, eras) at rows (n,), by the fingertips' mean and by their points.

    Weights reach a level that the other contents leave room for, else the highest there is.
    """
    level = stream.level_db_sl + 20 * math.log10(contents)
    view = fingers.for_targets(stream.targets, others, level_db_sl=level)
    forms = view.forms(None).at(rows)
    found = PHASED.search(forms, 0.0)
    if not found.score.any():
        highest = np.float32(_NEARLY_HIGHEST * PHASED.max_sensation(forms))
        forms = replace(forms, wanted=float(highest), level_margin=0.0)
        found = PHASED.search(forms, 0.0)
    drives = [(found.score, found.weights)]
    if len(others) <= MAX_FINGERS_BY_POINT and len(stream.targets) == 1:
        top = np.sort(best_first(found.score)[:ROWS_BY_POINT])
        by_point = PHASED.search(view.by_point(forms.at(top), rows[top]), 0.0)
        score, weights = np.zeros_like(found.score), np.zeros_like(found.weights)
        score[top], weights[top] = by_point.score, by_point.weights
        drives.append((score, weights))
    return drives


def _apart(score: Float32Array, frequencies: FloatArray, count: int, apart_hz: float) -> list[int]:
    """Indices of the two best scores, and of the best ones that are apart from all of these."""
    found: list[int] = []
    scores, hertz = score.tolist(), frequencies.tolist()
    for at in best_first(score).tolist():
        if scores[at] <= 0 or len(found) == count:
            break
        if len(found) < 2 or all(abs(hertz[each] - hertz[at]) >= apart_hz for each in found):
            found.append(at)
    return found
