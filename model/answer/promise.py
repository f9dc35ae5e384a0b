"""Compute the sensation of tones on the nominal plate and on drawn plates, and promise it.

From the tones of all contents, `promised` computes levels, contrasts and the gains for the
contents' levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import IMPERCEPTIBLE_DB_SL, Answer
from model.answer.envelope import shaped_gain
from model.answer.fingers_on_plate import DriveTones, FingersOnPlate
from model.answer.question import PROMISED_PERCENTILE, Contents, Tones
from model.answer.ringing import RingingUnderFingers, on_drawn_plates
from model.arrays import NEARLY, Complex64Array, Float32Array, FloatArray, IntArray
from model.drive_forms import WeightedTones
from model.ensemble.draws import PROMISED_DRAWS, percentile
from model.finger import decibels
from model.table.table import LocalizationTable

MIN_RAISED_CONTRAST_DB = 6.0
"""Minimum contrast [dB] of a short stimulus whose drive is raised: 6 dB is a factor of two."""

SIDE_BANDS = 0.02
"""Fraction of a content's power, for one ERA, in side bands at other fingers while weights change.

For n ERAs it is divided by n: their changes have no common phase, unlike their fields at their own
finger. The value is fitted to plates solved in time, so that 90 % of the promises on a path hold.
"""

# Smaller powers and amplitudes count as these, so that nothing is divided by zero.
_LEAST_POWER = 1e-20
_LEAST_AMPLITUDE = 1e-30


@dataclass(frozen=True, eq=False)
class _Powers:
    """Squared amplitudes of m tones relative to the threshold, nominal and on d drawn plates."""

    tones: Float32Array
    """At the points of fingertips (m, k, p, 1 + d)."""
    harmonics: Float32Array
    """Second harmonics, over fingertips (m, k, 1 + d)."""

    def scaled(self, tone_gains: Float32Array, harmonic_gains: Float32Array) -> "_Powers":
        """Return the powers with gains (m,) of amplitude on tones and on their harmonics."""
        return _Powers(
            self.tones * np.square(tone_gains)[:, None, None, None],
            self.harmonics * np.square(harmonic_gains)[:, None, None],
        )


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Figures of k fingers for one threshold set, as amplitude ratios; NaN if nothing to compare.

    Contrasts are nominal, the median of the drawn plates, and promised.
    """

    level: FloatArray
    """Level (k, 2): nominal and promised."""
    contrast: FloatArray
    """Contrast (k, 3)."""
    foreign_level: FloatArray
    """Foreign level (k,)."""
    worst: float
    """Promised contrast of the worst finger."""


def promised(
    fingers: FingersOnPlate,
    contents: Contents,
    tones: DriveTones,
    *,
    is_apart: bool = True,
    gains: FloatArray | None = None,
    ringing: Sequence[RingingUnderFingers | None] = (),
    path_points: Sequence[Sequence[int]] = (),
) -> Tones:
    """Compute the sensation of the tones of contents.

    gains (m,): None for the gains that give the contents' levels; ringing: per content, None for
    continuous or shaped ones; path_points: see `with_tones`.
    """
    table = fingers.table
    shares = fingers.tips.fine_weights
    steady = _Powers(
        fingers.powers(PROMISED_DRAWS, tones.rows, tones.weights),
        fingers.harmonics(PROMISED_DRAWS, tones.rows, tones.weights),
    )
    powers = steady
    if any(stream.duration is not None for stream in contents.streams):
        powers = _over_durations(fingers, contents, tones, steady, ringing)
    stroke_factor = 1.0
    if gains is None:
        wanted_gains = _gains_to_levels(contents, tones, powers, steady, shares)
        content_gains, stroke_factor = _within_stroke(contents, tones, wanted_gains)
        gains = content_gains[tones.owners]
    amplitude_gains = gains.astype(np.float32)
    powers = powers.scaled(amplitude_gains, amplitude_gains)
    if path_points:
        contents = contents.of_first(len(path_points))
        shares = shares[: len(path_points)]
        powers = _along_paths(powers, contents, tones, path_points)
    comparisons = list[_Comparison]()
    for threshold_set in range(len(table.threshold_sets)):
        tone_sensitivities = table.sensitivities[threshold_set, tones.rows]
        harmonic_sensitivities = table.harmonic_sensitivities[threshold_set, tones.rows]
        powers_of_set = powers.scaled(tone_sensitivities, harmonic_sensitivities)
        comparisons.append(_compared(contents, tones, powers_of_set, shares))

    contrast = np.array([comparison.contrast for comparison in comparisons])
    foreign_level = np.array([comparison.foreign_level for comparison in comparisons])
    worst = np.array([comparison.worst for comparison in comparisons])
    return Tones(
        rows=tones.rows.tolist(),
        weights=tones.weights.tolist(),
        gains=gains.tolist(),
        owners=tones.owners.tolist(),
        contrast_db=decibels(contrast.min(axis=0)).tolist(),
        level_db_sl=decibels(comparisons[0].level).tolist(),
        foreign_db_sl=decibels(foreign_level.T).tolist(),
        worst_db=float(decibels(worst.min())),
        stroke_factor=stroke_factor,
        is_apart=is_apart,
    )


def with_tones(
    table: LocalizationTable,
    answer: Answer,
    rows: IntArray,
    weights: Sequence[Sequence[complex]],
    owners: IntArray,
    gains: FloatArray | None,
    path_points: Sequence[Sequence[int]] = (),
) -> Answer:
    """Return the answer with other tones, and the resulting promises.

    gains: of the tones, None for the gains that give the contents' levels. path_points: for each of
    the first fingers, the numbers of the fingers that represent points on its path; the finger
    feels the mean power over these points.
    """
    contents = answer.contents
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    ringing = RingingUnderFingers.of_streams(table, contents)
    drive_tones = DriveTones(rows, np.array(weights, dtype=np.complex64), owners)
    tones = promised(
        fingers,
        contents,
        drive_tones,
        is_apart=answer.tones.is_apart,
        gains=gains,
        ringing=ringing,
        path_points=path_points,
    )
    stroke_factor = tones.stroke_factor if gains is None else answer.stroke_factor
    return replace(answer, tones=replace(tones, stroke_factor=stroke_factor))


def _along_paths(
    powers: _Powers, contents: Contents, tones: DriveTones, path_points: Sequence[Sequence[int]]
) -> _Powers:
    """Return the mean power along the path of each finger, with side bands at other fingers."""
    mean_powers = list[Float32Array]()
    mean_harmonics = list[Float32Array]()
    for points in path_points:
        mean_powers.append(powers.tones[:, [*points]].mean(axis=1))
        mean_harmonics.append(powers.harmonics[:, [*points]].mean(axis=1))
    power = np.stack(mean_powers, axis=1)
    harmonics = np.stack(mean_harmonics, axis=1)
    era_count = tones.weights.shape[1]
    for tone, owner in enumerate(tones.owners.tolist()):
        targets = [*contents.streams[owner].targets]
        others = np.setdiff1d(range(len(path_points)), targets)
        own_power = power[tone, targets].mean(axis=(0, 1))
        power[tone, others] += SIDE_BANDS / era_count * own_power
    return _Powers(power, harmonics)


def _compared(
    contents: Contents, tones: DriveTones, powers: _Powers, shares: Float32Array
) -> _Comparison:
    """Compare what fingers feel, for the threshold set to which powers are relative."""
    finger_count = len(contents.places)
    level = np.full((finger_count, 2), np.nan)
    contrast = np.full((finger_count, 3), np.nan)
    foreign_level = np.full(finger_count, np.nan)
    own_tones = dict[int, NDArray[np.bool_]]()
    felt_by_finger = dict[int, Float32Array]()
    for number, stream in enumerate(contents.streams):
        is_own = tones.owners == number
        for finger in stream.targets:
            felt = felt_amplitudes(powers.tones, shares, tones.rows, is_own, (finger,))
            own_tones[finger] = is_own
            felt_by_finger[finger] = felt
            level[finger] = felt[0], drawn_percentile(felt)
    weakest = np.min([*felt_by_finger.values()], axis=0)
    for finger in contents.quiet:
        own_tones[finger] = np.zeros(len(tones.rows), dtype=bool)
        felt_by_finger[finger] = weakest

    ratios = list[Float32Array]()
    for finger, felt in felt_by_finger.items():
        is_foreign = ~own_tones[finger]
        if not is_foreign.any():
            continue
        foreign_power = _loudest_of(powers, tones, is_foreign, finger)
        foreign_amplitude = np.sqrt(np.maximum(foreign_power, _LEAST_POWER))
        ratio = np.asarray(felt / foreign_amplitude, dtype=np.float32)
        ratios.append(ratio)
        foreign_level[finger] = drawn_percentile(foreign_amplitude, 100 - PROMISED_PERCENTILE)
        contrast[finger] = nominal_median_and_promised(ratio)
    worst_contrast = (np.nan, np.nan, np.nan)
    if ratios:
        worst_contrast = nominal_median_and_promised(np.asarray(np.min(ratios, axis=0)))
    if len(contents.streams) == 1:
        # The contrast of a single content is that at the loudest quiet finger.
        contrast[[*contents.streams[0].targets]] = worst_contrast
    return _Comparison(level, contrast, foreign_level, worst=worst_contrast[2])


def _loudest_of(
    powers: _Powers, tones: DriveTones, is_counted: NDArray[np.bool_], finger: int
) -> Float32Array:
    """Return the power (d,) of some tones (m,) at the loudest point of a finger."""
    return loudest_power(
        powers.tones[is_counted], powers.harmonics[is_counted], tones.rows[is_counted], finger
    )


def _over_durations(
    fingers: FingersOnPlate,
    contents: Contents,
    tones: DriveTones,
    steady: _Powers,
    ringing: Sequence[RingingUnderFingers | None],
) -> _Powers:
    """Return powers over the contents' durations, from the energy of the tones in the drives'
    spectra, on each plate."""
    power = steady.tones.copy()
    harmonics = steady.harmonics.copy()
    for tone, owner in enumerate(tones.owners.tolist()):
        stream = contents.streams[owner]
        if stream.duration is None:
            continue
        content_ringing = ringing[owner]
        if content_ringing is None:  # along a shaped onset
            factor = np.float32(shaped_gain(stream.duration) ** 2)
            power[tone] *= factor
            harmonics[tone] *= factor
            continue
        targets = [*stream.targets]
        drive = [(int(tones.rows[tone]), tones.weights[tone])]
        target_gains = content_ringing.over_drive(drive).gains[targets]
        power[tone] = _power_over_envelope(
            fingers, drive, steady.tones[tone], targets, content_ringing
        )
        harmonics[tone] *= np.float32(target_gains.min() ** 2)
    return _Powers(power, harmonics)


def _power_over_envelope(
    fingers: FingersOnPlate,
    drive: WeightedTones,
    steady: Float32Array,
    targets: Sequence[int],
    ringing: RingingUnderFingers,
) -> Float32Array:
    """Return the power (k, p, 1 + d) of a drive over its envelope, on each plate.

    steady (k, p, 1 + d): the power of the steady drive.
    """
    shares = fingers.tips.fine_weights
    sensation = ringing.over_drive(drive)
    spectrum = DriveTones.of([ringing.spectrum(drive)])
    spectrum_power = fingers.powers(PROMISED_DRAWS, spectrum.rows, spectrum.weights)
    energy = spectrum_power.sum(axis=0)
    steady_mean = _nominal_means(steady, shares, targets)
    energy_mean = _nominal_means(energy, shares, targets)
    target_gains = sensation.gains[targets]
    amplitude_ratios = target_gains * steady_mean / np.maximum(energy_mean, _LEAST_POWER)
    factors = np.square(amplitude_ratios)
    felt_power = on_drawn_plates(energy, sensation.heard, factors.min())
    power = np.asarray(felt_power, dtype=np.float32)
    power[targets] = energy[targets] * factors[:, None, None]
    return power


def _nominal_means(
    power: Float32Array, shares: Float32Array, targets: Sequence[int]
) -> Float32Array:
    """Return mean amplitudes over targets on the nominal plate, of power (k, p, 1 + d)."""
    amplitudes = np.sqrt(power[targets, :, 0])
    return np.asarray((shares[targets] * amplitudes).sum(axis=1))


def _gains_to_levels(
    contents: Contents,
    tones: DriveTones,
    powers: _Powers,
    steady: _Powers,
    shares: Float32Array,
) -> FloatArray:
    """Return gains (K,) that give contents their levels on 90 % of plates.

    A short stimulus reaches its level on the nominal plate. It is raised only as long as other
    fingers feel at most half its amplitude, or nothing.
    """
    levels = contents.levels.astype(float)
    different_rows = np.arange(len(tones.owners))  # as if all frequencies were different
    gains = np.empty(len(contents.streams))
    for number, stream in enumerate(contents.streams):
        is_own = tones.owners == number
        felt = felt_amplitudes(powers.tones, shares, different_rows, is_own, stream.targets)
        if stream.duration is None:
            gains[number] = levels[number] / max(drawn_percentile(felt), _LEAST_AMPLITUDE)
            continue
        nominal_amplitude = max(float(felt[0]), _LEAST_AMPLITUDE)
        gains[number] = levels[number] / nominal_amplitude
        others = contents.others(number)
        if not others:
            continue
        lasting = felt_amplitudes(steady.tones, shares, different_rows, is_own, stream.targets)
        lasting_gain = levels[number] / max(drawn_percentile(lasting), _LEAST_AMPLITUDE)
        foreign_powers = [_loudest_of(powers, tones, is_own, finger) for finger in others]
        foreign_amplitude = np.sqrt(np.maximum(np.max(foreign_powers, axis=0), _LEAST_POWER))
        contrast = drawn_percentile(felt / foreign_amplitude)
        allowed_gain = _allowed_foreign(levels[number]) * contrast / nominal_amplitude
        gains[number] = min(gains[number], max(allowed_gain, lasting_gain))
    return gains


def _allowed_foreign(level: float) -> float:
    """Return the amplitude that other fingers may feel of a raised stimulus with a level."""
    half = level * 10 ** (-MIN_RAISED_CONTRAST_DB / 20)
    imperceptible = 10 ** (IMPERCEPTIBLE_DB_SL / 20)
    return float(max(half, imperceptible))


def _within_stroke(
    contents: Contents, tones: DriveTones, gains: FloatArray
) -> tuple[FloatArray, float]:
    """Lower the gains (K,) of contents to the stroke; see `share_stroke`."""
    drives = np.zeros((len(contents.streams), tones.weights.shape[1]))
    np.add.at(drives, tones.owners, np.abs(tones.weights))
    priorities = [stream.priority for stream in contents.streams]
    return share_stroke(gains, drives, contents.levels.astype(float), priorities)


def share_stroke(
    gains: FloatArray,
    weights: Complex64Array | FloatArray,
    levels: FloatArray,
    priorities: Sequence[int],
) -> tuple[FloatArray, float]:
    """Lower gains (K,) to levels (K,) until they fit the stroke; also return the smallest factor.

    Among contents of equal priority, the louder ones are lowered first (`_max_min_factors`), until
    all fit into what higher priorities leave.
    """
    amplitudes = gains[:, None] * np.abs(weights)
    factors = np.zeros(len(gains))
    free_stroke = np.ones(amplitudes.shape[1])
    for priority in sorted({*priorities}, reverse=True):
        has_priority = np.array(priorities) == priority
        strokes = amplitudes[has_priority]
        lowering = _max_min_factors(strokes, levels[has_priority], free_stroke)
        factors[has_priority] = lowering
        used = lowering @ strokes
        is_full = used >= free_stroke * (1 - NEARLY)  # rounding leaves no stroke
        free_stroke = np.where(is_full, 0.0, free_stroke - used)
    return gains * factors, float(factors.min())


def _max_min_factors(
    strokes: FloatArray, levels: FloatArray, free_stroke: FloatArray
) -> FloatArray:
    """Return factors (K,) on strokes (K, eras) of contents, by max-min fairness.

    The level of all rises until it is a content's own, or until an ERA is full, which ends the rise
    of every content that uses it; the others go on (progressive filling: Bertsekas and Gallager,
    Data Networks, 2nd ed., section 6.5.2).
    """
    factors = np.ones(len(levels))
    is_rising = np.ones(len(levels), dtype=bool)
    for _ in levels:  # at least one content ends in each round
        settled = (factors[:, None] * strokes)[~is_rising].sum(axis=0)
        per_level = (strokes[is_rising] / levels[is_rising, None]).sum(axis=0)
        remaining = np.maximum(free_stroke - settled, 0)
        level_by_era = np.full(len(free_stroke), np.inf)  # where nothing rises
        np.divide(remaining, per_level, out=level_by_era, where=per_level > _LEAST_AMPLITUDE)
        level = level_by_era.min()
        has_ended = is_rising & (levels <= level)
        if not has_ended.any():
            is_full = level_by_era <= level * (1 + NEARLY)
            has_ended = is_rising & (strokes[:, is_full] > 0).any(axis=1)
            factors[has_ended] = level / levels[has_ended]
        is_rising &= ~has_ended
    return factors


def felt_amplitudes(
    power: Float32Array,
    shares: Float32Array,
    rows: IntArray,
    is_own: NDArray[np.bool_],
    targets: Sequence[int],
) -> Float32Array:
    """Return the lowest amplitude of a content's own tones at its targets, (d,).

    power (m, k, p, d): of all tones; shares (k, p): weights of the points in the mean over a
    fingertip. Tones of other contents at the same row (m,) can partly cancel the content.
    """
    squares = np.zeros(power.shape[1:], dtype=power.dtype)
    for tone in np.flatnonzero(is_own).tolist():
        amplitude = np.sqrt(power[tone])
        is_cancelling = ~is_own & (rows == rows[tone])
        for cancelling_tone in np.flatnonzero(is_cancelling).tolist():
            amplitude = amplitude - np.sqrt(power[cancelling_tone])
        squares += np.maximum(amplitude, 0) ** 2
    means = [shares[target] @ np.sqrt(squares[target]) for target in targets]
    return np.asarray(np.min(means, axis=0))


def loudest_power(
    power: Float32Array, harmonics: Float32Array, rows: IntArray, finger: int
) -> Float32Array:
    """Return the power (d,) of j tones at the loudest point of a finger.

    power (j, k, p, d): amplitudes of tones at the same row (j,) add; harmonics (j, k, d): power of
    second harmonics over each fingertip, at any phase.
    """
    finger_power = power[:, finger]
    total = np.zeros(finger_power.shape[1:], dtype=finger_power.dtype)
    order = np.argsort(rows, kind="stable").tolist()
    for _, same_row in groupby(order, key=rows.__getitem__):
        amplitudes = np.sqrt(finger_power[list(same_row)])
        total += amplitudes.sum(axis=0) ** 2
    return np.asarray(total.max(axis=0) + harmonics[:, finger].sum(axis=0))


def drawn_percentile(values: Float32Array, percent: float = PROMISED_PERCENTILE) -> float:
    """Return a percentile over the drawn plates of values (1 + d,), by default the promised one.

    The first value is nominal.
    """
    return float(percentile(values[1:].astype(float), percent))


def nominal_median_and_promised(ratio: Float32Array) -> tuple[float, float, float]:
    """Return the nominal value of ratios (1 + d,), and over the drawn plates the median and the
    promised percentile."""
    return float(ratio[0]), drawn_percentile(ratio, 50), drawn_percentile(ratio)
