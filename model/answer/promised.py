"""What fingers feel of the tones of all contents on drawn plates, and what is promised of it."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import IMPERCEPTIBLE_DB_SL, Answer
from model.answer.fingers_on_plate import FingersOnPlate
from model.answer.over_duration import RingingUnderFingers, on_drawn_plates, shaped_gain
from model.answer.search import PROMISED_PERCENTILE, Contents, Tones
from model.arrays import NEARLY, Complex64Array, Float32Array, FloatArray, IntArray
from model.ensemble.draws import PROMISED_DRAWS, percentile
from model.finger import decibels
from model.table.table import LocalizationTable

MIN_RAISED_CONTRAST_DB = 6.0
"""Contrast over an effect down to which its drive is raised: quiet fingers feel half of it."""

_TINY = 1e-20


def with_tones(
    table: LocalizationTable,
    found: Answer,
    rows: IntArray,
    weights: Sequence[Sequence[complex]],
    owners: IntArray,
    gains: FloatArray | None,
) -> Answer:
    """The answer with other tones, and what these promise together, on the same plates.

    gains: None for those to the contents' levels.
    """
    contents = found.contents
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    of_tones = rows, np.array(weights, dtype=np.complex64), owners
    ringing = RingingUnderFingers.of_streams(table, contents)
    tones = promised(fingers, contents, *of_tones, gains=gains, ringing=ringing)
    factor = tones.stroke_factor if gains is None else found.stroke_factor
    return replace(found, tones=replace(tones, stroke_factor=factor))


def promised(
    fingers: FingersOnPlate,
    contents: Contents,
    rows: IntArray,
    weights: Complex64Array,
    owners: IntArray,
    *,
    is_apart: bool = True,
    gains: FloatArray | None = None,
    ringing: Sequence[RingingUnderFingers | None] = (),
) -> Tones:
    """What fingers feel of tones at rows (m,) of weights (m, n), at gains (m,).

    owners (m,): the content of each tone; gains: None for those to the contents' levels; ringing:
    of the contents that have a duration.
    """
    shares, streams = fingers.tips.fine_weights, contents.streams
    steady = power = fingers.powers(PROMISED_DRAWS, rows, weights)
    harmonics = fingers.harmonics(PROMISED_DRAWS, rows, weights)
    if any(stream.duration is not None for stream in streams):
        over = fingers, contents, steady, harmonics, rows, weights, owners, ringing
        power, harmonics = _over_durations(*over)
    by_tone, factor = gains, 1.0
    if by_tone is None:
        of_contents, factor = _gains_to_levels(
            contents, power, steady, harmonics, shares, rows, weights, owners
        )
        by_tone = of_contents[owners]
    squares = np.square(by_tone, dtype=np.float32)[:, None, None]
    power, harmonics, table = power * squares[..., None], harmonics * squares, fingers.table
    sensitivities = table.sensitivities[:, rows], table.harmonic_sensitivities[:, rows]
    by_set = [
        _compared(
            contents,
            power * np.square(at_tones)[:, None, None, None],
            harmonics * np.square(at_harmonics)[:, None, None],
            shares,
            rows,
            owners,
        )
        for at_tones, at_harmonics in zip(*sensitivities, strict=True)
    ]
    (level, *_), contrast, of_others, worst = map(np.array, zip(*by_set, strict=True))
    return Tones(
        rows=rows.tolist(),
        weights=weights.tolist(),
        gains=by_tone.tolist(),
        owners=owners.tolist(),
        contrast_db=decibels(contrast.min(axis=0)).tolist(),
        level_db_sl=decibels(level).tolist(),
        foreign_db_sl=decibels(of_others.T).tolist(),
        worst_db=float(decibels(worst.min())),
        stroke_factor=factor,
        is_apart=is_apart,
    )


def _compared(
    contents: Contents,
    power: Float32Array,
    harmonics: Float32Array,
    shares: Float32Array,
    rows: IntArray,
    owners: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Level (k, 2), contrast (k, 3), what is felt of others (k,), and promised of all fingers.

    By one set of thresholds, to which power (m, k, p, d) and that of harmonics (m, k, d) are; NaN
    where there is nothing to compare.
    """
    streams, k = contents.streams, len(contents.places)
    level, contrast, of_others = (np.full(size, np.nan) for size in ((k, 2), (k, 3), k))
    own_of = {finger: owners == j for j, stream in enumerate(streams) for finger in stream.targets}
    every = {
        finger: felt_amplitudes(power, shares, rows, own, (finger,))
        for finger, own in own_of.items()
    }
    level[[*every]] = [(felt[0], promise(felt)) for felt in every.values()]
    ratios: list[Float32Array] = []
    for finger in (*every, *contents.quiet):
        felt = every[finger] if finger in every else np.min([*every.values()], axis=0)
        others = ~own_of.get(finger, np.zeros(len(rows), dtype=bool))
        if not others.any():
            continue
        heard = loudest_power(power[others], harmonics[others], rows[others], finger)
        heard = np.sqrt(np.maximum(heard, _TINY))
        ratios.append(felt / heard)
        of_others[finger] = promise(heard, 100 - PROMISED_PERCENTILE)
        contrast[finger] = figures(ratios[-1])
    worst = figures(np.min(ratios, axis=0)) if ratios else (np.nan,) * 3
    if len(streams) == 1:
        contrast[[*streams[0].targets]] = worst  # the one at the loudest quiet finger
    return level, contrast, of_others, worst[2]


def _over_durations(
    fingers: FingersOnPlate,
    contents: Contents,
    steady: Float32Array,
    harmonics: Float32Array,
    rows: IntArray,
    weights: Complex64Array,
    owners: IntArray,
    ringing: Sequence[RingingUnderFingers | None],
) -> tuple[Float32Array, Float32Array]:
    """Power (m, k, p, d) of tones over the durations of their contents, and of harmonics (m, k, d).

    By the energy of the tones in their spectrum, on each plate.
    """
    power, harmonics = steady.copy(), harmonics.copy()
    shares = fingers.tips.fine_weights
    for tone, owner in enumerate(owners.tolist()):
        stream, over = contents.streams[owner], ringing[owner]
        if stream.duration is None:
            continue
        if over is None:  # along a shaped onset
            factor = np.float32(shaped_gain(stream.duration) ** 2)
            power[tone] *= factor
            harmonics[tone] *= factor
            continue
        own, drive = [*stream.targets], [(int(rows[tone]), weights[tone])]
        felt = over.over_drive(drive)
        near, beside = zip(*over.spectrum(drive), strict=True)
        energy = fingers.powers(PROMISED_DRAWS, np.array(near), np.array(beside)).sum(axis=0)
        lasting, nominal = (
            (shares[own] * np.sqrt(each[own, :, 0])).sum(axis=1) for each in (steady[tone], energy)
        )
        by_target = np.square(felt.gains[own] * lasting / np.maximum(nominal, _TINY))
        power[tone] = on_drawn_plates(energy, felt.heard, by_target.min())
        power[tone, own] = energy[own] * by_target[:, None, None]
        harmonics[tone] *= np.float32(felt.gains[own].min() ** 2)
    return power, harmonics


def _gains_to_levels(
    contents: Contents,
    power: Float32Array,
    steady: Float32Array,
    harmonics: Float32Array,
    shares: Float32Array,
    rows: IntArray,
    weights: Complex64Array,
    owners: IntArray,
) -> tuple[FloatArray, float]:
    """Gains (K,) of contents to their levels on nine of ten plates, as `share_stroke`."""
    streams, levels = contents.streams, contents.levels.astype(float)
    alone = np.arange(len(owners))  # as if each had a frequency of its own
    gains = np.empty(len(streams))
    for j, stream in enumerate(streams):
        felt = felt_amplitudes(power, shares, alone, owners == j, stream.targets)
        if stream.duration is None:
            gains[j] = levels[j] / max(promise(felt), 1e-30)
            continue
        lasting = felt_amplitudes(steady, shares, alone, owners == j, stream.targets)
        gains[j] = levels[j] / max(felt[0], 1e-30)
        if others := contents.others(j):
            own = owners == j
            of_own = power[own], harmonics[own], rows[own]
            at = [loudest_power(*of_own, each) for each in others]
            contrast = promise(felt / np.sqrt(np.maximum(np.max(at, axis=0), _TINY)))
            allowed = _allowed_gain(levels[j], float(felt[0]), contrast)
            gains[j] = min(gains[j], max(allowed, levels[j] / max(promise(lasting), 1e-30)))
    drives = np.zeros((len(streams), weights.shape[1]))
    np.add.at(drives, owners, np.abs(weights))
    priorities = [stream.priority for stream in streams]
    return share_stroke(gains, drives, levels, priorities)


def _allowed_gain(level: float, felt: float, contrast: float) -> float:
    """Gain up to which quiet fingers allow a short stimulus: they feel half of it at most.

    Or nothing. level: of it, felt: of its drive, as amplitudes to threshold, contrast: promised.
    """
    highest = max(level * 10 ** (-MIN_RAISED_CONTRAST_DB / 20), 10 ** (IMPERCEPTIBLE_DB_SL / 20))
    return highest * contrast / max(felt, 1e-30)


def share_stroke(
    gains: FloatArray,
    weights: Complex64Array | FloatArray,
    levels: FloatArray,
    priorities: Sequence[int],
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
    shares: Float32Array,
    rows: IntArray,
    is_own: NDArray[np.bool_],
    targets: Sequence[int],
) -> Float32Array:
    """The least that a content's fingertips feel of its own tones, (d,), of power (m, k, p, d).

    shares (k, p): of the points in the mean. Tones of other contents at its frequencies, by rows
    (m,), may cancel part of it.
    """
    squares = np.zeros(power.shape[1:], dtype=power.dtype)
    for tone in np.flatnonzero(is_own).tolist():
        amplitude = np.sqrt(power[tone])
        for other in np.flatnonzero(~is_own & (rows == rows[tone])).tolist():
            amplitude = amplitude - np.sqrt(power[other])
        squares += np.maximum(amplitude, 0) ** 2
    return np.asarray(np.min([shares[t] @ np.sqrt(squares[t]) for t in targets], axis=0))


def loudest_power(
    power: Float32Array, harmonics: Float32Array, rows: IntArray, finger: int
) -> Float32Array:
    """Power (d,) of contents at the loudest point of a finger, of power (j, k, p, d).

    Of contents of one frequency, by rows (j,), the amplitudes add. With that of their second
    harmonics over the fingertip, (j, k, d), of any phase.
    """
    at = power[:, finger]
    total = np.zeros(at.shape[1:], dtype=at.dtype)
    order = np.argsort(rows, kind="stable").tolist()
    for _, same in groupby(order, key=rows.__getitem__):
        total += np.sqrt(at[list(same)]).sum(axis=0) ** 2
    return np.asarray(total.max(axis=0) + harmonics[:, finger].sum(axis=0))


def promise(values: Float32Array, percent: float = PROMISED_PERCENTILE) -> float:
    """Percentile of the drawn plates, without the first, the nominal one."""
    return float(percentile(values[1:].astype(float), percent))


def figures(ratio: Float32Array) -> tuple[float, float, float]:
    """Of ratios (1 + d,): nominal, of half of the drawn plates, of nine of ten."""
    return float(ratio[0]), promise(ratio, 50), promise(ratio)
