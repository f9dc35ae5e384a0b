"""Tones of contents in numpy: where there is no compiler, and what the kernel in C must find."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.choice import NEARLY, best_few, best_first, best_of
from model.drive_modes.coherent import Coherent
from model.drive_modes.forms import Forms
from model.drive_modes.phased import PHASED
from model.ensemble.draws import Drawing
from model.ensemble.measures import percentile
from model.ensemble.touched_plate import Sensed, TouchedPlate
from model.finger.perception import decibels
from model.table.contents import (
    JUDGING_DRAWS,
    KEPT,
    MAX_COMBINATIONS,
    MIN_CANDIDATES,
    MISSING,
    NEARLY_HIGHEST,
    ONSET_MARGIN_DB,
    ONSET_WEIGHT,
    PROMISED_DRAWS,
    PROMISED_PERCENTILE,
    PRUNING_STEP,
    REACHED,
    Contents,
    Stream,
    Tones,
)
from model.table.fingers_on_plate import MAX_FINGERS_BY_POINT, FingersOnPlate
from model.table.raster import FingertipShapes

if TYPE_CHECKING:
    from model.table.table import LocalizationTable

_SEARCH = Coherent(PHASED.phases, PHASED.iterations)
_TINY, _SAME_FREQUENCY = 1e-20, 1e-3  # -, Hz


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates (m,) of all contents: of which stream and band, row, score, weights (m, n)."""

    streams: IntArray
    bands: IntArray
    rows: IntArray
    scores: FloatArray
    weights: Complex64Array


@dataclass(frozen=True, eq=False)
class Asked:
    """Contents on a table, and their fingers on its plate."""

    table: "LocalizationTable"
    contents: Contents
    tips: FingertipShapes
    touched: TouchedPlate

    @classmethod
    def of(cls, table: "LocalizationTable", contents: Contents) -> "Asked":
        """Put the fingers of contents on a table's plate."""
        tips = table.read_fingertips(contents.places)
        stiffness = table.attached.finger_stiffness(len(tips.few), contents.loads)
        touched = TouchedPlate(table.on_eras, tips.few[:, 0], stiffness)
        return cls(table, contents, tips, touched)

    def drawn(
        self, by: Drawing, rows: IntArray, weights: Complex64Array, *, with_powers: bool = False
    ) -> Sensed:
        """What tones at rows (m,) of weights (m, n) do at all fine points on drawn plates."""
        points, table = self.tips.fine.reshape(-1, self.tips.fine.shape[2]), self.table
        given = points, self.tips.fine_weights, table.error_power, table.thresholds
        return self.touched.drawn(by, rows, weights, *given, with_powers=with_powers)


def choose_by_numpy(table: "LocalizationTable", contents: Contents) -> Tones | None:
    """Choose a tone for each content; None where one frequency hardly reaches a strict level."""
    asked, rows = Asked.of(table, contents), contents.rows
    kept = ranked(asked) if contents.is_ranked else rows
    found, is_limited = _candidates(asked, kept)
    if len(kept) < len(rows) and (not len(found.rows) or (is_limited and not contents.is_strict)):
        found, is_limited = _candidates(asked, rows)
    if not len(found.rows) or (is_limited and contents.is_strict):
        return None
    best, is_apart = np.zeros(1, dtype=int), True
    if len(found.rows) > 1:
        own, loudest = _judged(asked, found)
        if len(contents.streams) == 1:
            best[0] = _best_tone(asked, found, own, loudest)
        else:
            best, is_apart = best_combination(table, contents, found, own, loudest)
    return _promised(asked, found.rows[best], found.weights[best], is_apart)


def ranked(asked: Asked) -> IntArray:
    """The rows most worth a search for one target, ascending; by one form of all other fingers."""
    table, contents, tips, touched = asked.table, asked.contents, asked.tips, asked.touched
    rows, target = contents.rows, contents.streams[0].targets[0]
    others = _others(contents, 0)
    points, weights = tips.few, tips.few_weights
    if len(others) > MAX_FINGERS_BY_POINT:
        points, weights = touched.centres[:, None], np.ones_like(weights[:, :1])
    shares = np.zeros_like(weights)
    shares[others] = weights[others] / np.float32(len(others))
    every = points.reshape(1, -1, points.shape[2])
    found = touched.forms(rows, every, shares.reshape(1, -1), table.error_power)
    fields = found.fields.reshape(len(rows), *points.shape[:2], -1)
    mean = (weights[target] @ fields[:, target])[None]
    level, threshold = float(contents.levels[0]), table.thresholds.take(rows)
    power = found.power.swapaxes(0, 1)
    searched = _SEARCH.search_all(Forms(mean, power, found.power, threshold, level, 0.0))
    order = best_first(searched.bound)
    reaches = searched.score[order] > 0
    # Those that would be better than the best, were they loud enough.
    first = int(reaches.argmax()) if reaches.any() else len(order)
    missing = order[:first][:MISSING]
    reaching = order[reaches][: KEPT - len(missing)]
    return np.asarray(rows[np.sort(np.concatenate([reaching, missing]))])


def _others(contents: Contents, number: int) -> list[int]:
    """Fingers that a content is kept from."""
    every = {*contents.quiet}.union(*(stream.targets for stream in contents.streams))
    return sorted(every - {*contents.streams[number].targets})


def _candidates(asked: Asked, rows: IntArray) -> tuple[Candidates, bool]:
    """The best tones of each content in each band, and whether a level was hard to reach."""
    table, contents, tips, touched = asked.table, asked.contents, asked.tips, asked.touched
    count = len(contents.streams)
    formed = touched.forms(rows, tips.few, tips.few_weights, table.error_power, tips.fine)
    fingers = FingersOnPlate(
        *(touched, rows, tips, table.thresholds, table.error_power, formed),
        *(np.arange(0), np.arange(0), 1.0),
    )
    candidate_count = MIN_CANDIDATES + (count // 2 if count > 1 else 0)
    found: list[tuple[int, int, int, float, Complex64Array]] = []
    is_limited = False
    for number, stream in enumerate(contents.streams):
        others = _others(contents, number)
        level = stream.level_db_sl + 20 * math.log10(count)
        view = fingers.for_targets(stream.targets, others, level_db_sl=level)
        rest = None if contents.background is None or others else contents.background[rows]
        for band, (low, end) in enumerate(stream.bands):
            at = np.flatnonzero((rows >= low) & (rows < end))
            forms = view.forms(rest).at(at)
            searched = _SEARCH.search(forms)
            is_limited |= searched.is_level_limited
            if not searched.score.any() and not contents.is_strict:
                highest = np.float32(NEARLY_HIGHEST * _SEARCH.max_sensation(forms))
                forms = replace(forms, wanted=float(highest), level_margin=0.0)
                searched, is_limited = _SEARCH.search(forms), True
            ways = [searched]
            by_point = 1 <= len(others) <= MAX_FINGERS_BY_POINT
            if by_point and searched.score.any():
                ways.append(_SEARCH.search(view.by_point(forms, at)))
            hertz = table.frequencies[rows[at]]
            apart_hz = contents.apart_hz if count > 1 else 0.0
            for way in ways:
                for each in _apart(way.score, hertz, candidate_count, apart_hz):
                    score, weights = float(way.score[each]), way.weights[each]
                    found.append((number, band, int(rows[at[each]]), score, weights))
    parts = zip(*found, strict=True) if found else ((),) * 5
    return Candidates(*(np.array(part) for part in parts)), is_limited


def _apart(score: Float32Array, frequencies: FloatArray, count: int, apart_hz: float) -> list[int]:
    """Indices of the two best scores, and of the best ones that are apart from all of these."""
    found: list[int] = []
    for at in best_first(score).tolist():
        if score[at] <= 0 or len(found) == count:
            break
        gaps = np.abs(frequencies[found] - frequencies[at])
        if len(found) < 2 or (gaps >= apart_hz - _SAME_FREQUENCY).all():
            found.append(at)
    return found


def _judged(asked: Asked, found: Candidates) -> tuple[FloatArray, FloatArray]:
    """Amplitude (m, d) at the targets of each candidate, squared one (m, k, d) at loudest points.

    Those of several contents at the contents' levels.
    """
    contents = asked.contents
    judged = asked.drawn(JUDGING_DRAWS, found.rows, found.weights)
    loudest = judged.loudest[:, :, 1:].astype(float)
    own = np.empty((len(loudest), loudest.shape[2]))
    for number, stream in enumerate(contents.streams):
        of = found.streams == number
        own[of] = judged.means[of][:, [*stream.targets], 1:].min(axis=1)
        if len(contents.streams) > 1:
            gain = contents.levels[number] / np.maximum(percentile(own[of]), _TINY)
            own[of] *= gain[:, None]
            loudest[of] *= gain[:, None, None] ** 2
    return own, loudest


def _best_tone(asked: Asked, found: Candidates, own: FloatArray, loudest: FloatArray) -> int:
    """The tone of an only content: level first, then contrast, of nearly the same the onset.

    Without other fingers the score counts, and as much a level that is much the same on all plates.
    """
    contents = asked.contents
    quiet, least = [*contents.quiet], percentile(own)
    reaches = least >= contents.levels[0] * REACHED
    if not reaches.any():
        reaches[:] = True
    if not quiet:
        return best_of(reaches * found.scores * least / percentile(own, 50))
    loud = np.sqrt(loudest[:, quiet].max(axis=1))
    robust = np.where(reaches, percentile(own / np.maximum(loud, 1e-30)), 0.0)
    near = np.flatnonzero(robust >= 10 ** (-ONSET_MARGIN_DB / 20) * robust.max())
    contrast = None
    if contents.with_onset and len(near) > 1:
        drives, targets = (found.rows[near], found.weights[near]), [*contents.streams[0].targets]
        contrast = onset_contrast(asked.table, asked.tips, targets, quiet, *drives)
    if contrast is None:
        return best_of(robust)
    return int(near[best_of(robust[near] * contrast**ONSET_WEIGHT)])


def onset_contrast(
    table: "LocalizationTable",
    tips: FingertipShapes,
    targets: list[int],
    quiet: list[int],
    rows: IntArray,
    weights: Complex64Array,
) -> FloatArray | None:
    """Contrast (m,) along a plain ramp of tones at rows (m,), weights (m, n); None if unsolved."""
    if table.onsets is None:
        return None
    # An onset's target counts by the plain mean over its points.
    scales = tips.fine.shape[1] * tips.fine_weights[targets]
    return table.onsets.contrast(
        rows,
        weights,
        targets=list(tips.fine[targets] * scales[:, :, None].astype(np.float32)),
        quiet=tips.fine[quiet].reshape(-1, tips.fine.shape[2]),
    )


def best_combination(
    table: "LocalizationTable",
    contents: Contents,
    found: Candidates,
    own: FloatArray,
    loudest: FloatArray,
) -> tuple[IntArray, bool]:
    """A candidate of each content (K,), and whether their frequencies are apart.

    Of all that exchange bands and are apart, else of all that exchange bands.
    """
    streams, hertz = contents.streams, table.frequencies[found.rows]
    for gap in (contents.apart_hz, 0.0):
        combinations = np.flatnonzero(found.streams == 0)[:, None]
        for number in range(1, len(streams)):
            own_candidates = np.flatnonzero(found.streams == number)
            before = np.repeat(combinations, len(own_candidates), axis=0)
            last = np.tile(own_candidates, len(combinations))[:, None]
            gaps = np.abs(hertz[last] - hertz[before])
            allowed = (gaps >= gap - _SAME_FREQUENCY).all(axis=1)
            if len(streams[0].bands) > 1:
                allowed &= (found.bands[last] != found.bands[before]).all(axis=1)
            combinations = np.concatenate([before, last], axis=1)[allowed]
            if len(combinations) > MAX_COMBINATIONS:
                some = own[:, ::PRUNING_STEP], loudest[:, :, ::PRUNING_STEP]
                worst = worst_ratios(combinations, streams, contents.quiet, *some)
                combinations = combinations[best_few(worst, MAX_COMBINATIONS)]
        if len(combinations):
            worst = worst_ratios(combinations, streams, contents.quiet, own, loudest)
            return combinations[best_of(worst)], gap == contents.apart_hz
    raise AssertionError("contents with as many bands must have a combination")


def worst_ratios(
    combinations: IntArray,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    own: FloatArray,
    loudest: FloatArray,
) -> FloatArray:
    """Power ratio at the worst finger on nine of ten plates, of combinations (c, j): (c,).

    Of the first j contents alone; own (m, d), loudest (m, k, d) as of `_judged`.
    """
    levels, total = own[combinations] ** 2, loudest[combinations].sum(axis=1)
    worst = np.full((len(combinations), own.shape[1]), np.inf)
    for j, at in enumerate(combinations.T):
        if combinations.shape[1] > 1:
            for finger in streams[j].targets:
                others_power = np.maximum(total[:, finger] - loudest[at, finger], _TINY)
                worst = np.minimum(worst, levels[:, j] / others_power)
    for finger in quiet:
        worst = np.minimum(worst, levels.min(axis=1) / np.maximum(total[:, finger], _TINY))
    return percentile(worst)


def _promised(asked: Asked, rows: IntArray, weights: Complex64Array, is_apart: bool) -> Tones:
    """What fingers feel of tones at rows (K,) of weights (K, n), brought to their levels."""
    contents, shares = asked.contents, asked.tips.fine_weights
    streams, levels, k = contents.streams, contents.levels, len(shares)
    powers = asked.drawn(PROMISED_DRAWS, rows, weights, with_powers=True).powers
    power = np.asarray(powers).reshape(len(rows), *shares.shape, -1)
    alone = np.arange(len(rows))  # as if each had a frequency of its own
    own = [
        promise(felt_amplitudes(power, shares, alone, j, s.targets)) for j, s in enumerate(streams)
    ]
    gains = levels / np.maximum(own, 1e-30)
    priorities = [stream.priority for stream in streams]
    gains, factor = share_stroke(gains, weights, levels.astype(float), priorities)
    power = power * np.square(gains, dtype=np.float32)[:, None, None, None]
    contrast, level, foreign_amplitudes = (np.full(size, np.nan) for size in ((k, 3), (k, 2), k))
    each_own = [felt_amplitudes(power, shares, rows, j, s.targets) for j, s in enumerate(streams)]
    ratios: list[Float32Array] = []
    loudest = np.zeros(power.shape[-1], dtype=np.float32)
    for finger in (*(finger for stream in streams for finger in stream.targets), *contents.quiet):
        felt, others = np.min(each_own, axis=0), np.ones(len(rows), dtype=bool)
        for j, stream in enumerate(streams):
            if finger in stream.targets:
                felt, others[j] = felt_amplitudes(power, shares, rows, j, (finger,)), False
                level[finger] = felt[0], promise(felt)
        if not others.any():
            continue
        heard = np.sqrt(np.maximum(loudest_power(power[others], rows[others], finger), _TINY))
        ratios.append(felt / heard)
        foreign_amplitudes[finger] = promise(heard, 100 - PROMISED_PERCENTILE)
        contrast[finger] = figures(ratios[-1])
        if finger in contents.quiet:
            loudest = np.maximum(loudest, heard)
    worst = figures(np.min(ratios, axis=0)) if ratios else (np.nan,) * 3
    if len(streams) == 1:
        contrast[[*streams[0].targets]] = worst  # the one at the loudest quiet finger
    of_all = worst[2], promise(loudest, 100 - PROMISED_PERCENTILE)
    worst_db, loudest_db_sl = decibels(np.array(of_all)).tolist()
    return Tones(
        rows=rows.tolist(),
        weights=weights.tolist(),
        gains=gains.tolist(),
        contrast_db=decibels(contrast).tolist(),
        level_db_sl=decibels(level).tolist(),
        foreign_db_sl=decibels(foreign_amplitudes).tolist(),
        worst_db=worst_db,
        loudest_db_sl=loudest_db_sl,
        stroke_factor=factor,
        is_apart=is_apart,
    )


def share_stroke(
    gains: FloatArray, weights: Complex64Array, levels: FloatArray, priorities: Sequence[int]
) -> tuple[FloatArray, float]:
    """Gains (K,) to levels (K,) within the stroke, and the least factor on them.

    Of each priority the louder contents are lowered first, to one level (max-min), until all fit
    into what is left by the higher ones.
    """
    amplitudes = gains[:, None] * np.abs(weights)
    factors, left = np.zeros(len(gains)), np.ones(amplitudes.shape[1])
    for priority in sorted({*priorities}, reverse=True):
        of = np.array(priorities) == priority
        level, is_lowered = 0.0, of
        while is_lowered.any():
            kept = amplitudes[of & ~is_lowered].sum(axis=0)
            per_level = (amplitudes[is_lowered] / levels[is_lowered, None]).sum(axis=0)
            level = float((np.maximum(left - kept, 0) / np.maximum(per_level, 1e-30)).min())
            if (levels[is_lowered] > level).all():
                break
            is_lowered = is_lowered & (levels > level)
        factors[of] = np.where(is_lowered[of], level / levels[of], 1.0)
        used = factors[of] @ amplitudes[of]
        left = np.where(used >= left * (1 - NEARLY), 0.0, left - used)  # rounding leaves no stroke
    return gains * factors, float(factors.min())


def felt_amplitudes(
    power: Float32Array,
    weights: Float32Array,
    rows: IntArray,
    number: int,
    targets: Sequence[int],
) -> Float32Array:
    """The least that a content's fingertips feel of it, (d,), of power (K, k, p, d).

    weights (k, p): of the points in the mean. Tones of other contents at its frequency, by rows
    (K,), may cancel part of it.
    """
    amplitude = np.sqrt(power[number])
    for other in np.flatnonzero(rows == rows[number]).tolist():
        if other != number:
            amplitude = amplitude - np.sqrt(power[other])
    return np.asarray(np.min([weights[t] @ np.maximum(amplitude[t], 0) for t in targets], axis=0))


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


def promise(values: Float32Array, percent: float = PROMISED_PERCENTILE) -> float:
    """Percentile of the drawn plates, without the first, the nominal one."""
    return float(percentile(values[1:].astype(float), percent))


def figures(ratio: Float32Array) -> tuple[float, float, float]:
    """Of ratios (1 + d,): nominal, of half of the drawn plates, of nine of ten."""
    return float(ratio[0]), promise(ratio, 50), promise(ratio)
