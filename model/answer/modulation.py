"""Modulate the vibrations of an answer, by a carrier and two side bands.

At full modulation each side band has half the carrier's amplitude. With the carrier's weights, side
bands would leak 3 to 12 dB more, so each side band has separate weights, computed like those of a
content at its frequency. The carrier is chosen for all three together, near the best steady one.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from model.answer.answer import APART_HZ, MIN_CONTRAST_DB, SAME_LEVEL, Answer, Stream, Tones
from model.answer.promise import share_stroke, with_tones
from model.answer.tone_search import choose_tones
from model.arrays import NEARLY, FloatArray, best_of
from model.finger import decibels
from model.table.table import LocalizationTable

_AMPLITUDES = np.array([1.0, 0.5, 0.5])  # of carrier and side bands
_ALL_DB = 20 * math.log10(float(np.linalg.norm(_AMPLITUDES)))  # all three, above the carrier
_NEAR = 2  # carriers tried on each side of the steady one, in table frequencies
_MAX_ASYMMETRY = 0.5  # Hz; of the side bands about the carrier
_ROUNDING_DB = 1e-3  # difference of promises that counts as equal
_LEAST_LEVEL = 1e-9  # of silent contents


def with_modulation(
    table: LocalizationTable,
    steady: Answer,
    *,
    playable: tuple[float, float],
) -> Answer:
    """Modulate an answer as its fingers request, if all fingers remain served.

    playable: lowest and highest frequency [Hz] of side bands. These are equally far below and above
    the carrier, at the table's frequencies nearest to the modulation, APART_HZ from all tones of
    other contents, and not among the avoided frequencies. A shared content is steady. Levels are
    lowered to fit the stroke.
    """
    lowest = max(playable[0], table.frequencies[0])
    highest = min(playable[1], table.frequencies[-1])
    result = steady
    for number, stream in enumerate(steady.contents.streams):
        stimulus = result.asked[stream.targets[0]].stimulus
        if stimulus is None or stimulus.modulation_hz is None or len(stream.targets) > 1:
            continue
        owners = np.array(result.tones.owners)
        rows = np.array(result.tones.rows)
        other_tones = table.frequencies[rows[owners != number]]
        steady_row = int(rows[owners == number][0])
        fitting = list[list[int]]()
        for candidate in _carriers(table, steady_row, stimulus.modulation_hz):
            is_avoided = not {*candidate}.isdisjoint(result.contents.avoided)
            frequencies = table.frequencies[candidate]
            fits = _fits(
                frequencies,
                stimulus.modulation_hz,
                stimulus.band_hz,
                (lowest, highest),
                other_tones,
            )
            if fits and not is_avoided:
                fitting.append(candidate)
        if not fitting:
            continue
        modulated = _with_best_carrier(table, result, number, fitting)
        if is_served(modulated, result):
            result = modulated
    return result


def is_served(result: Answer, steady: Answer) -> bool:
    """Return whether all fingers meet their requirements, and have at least 6 dB unless they had
    less."""
    worst_db = result.promised_worst_db
    steady_worst_db = steady.promised_worst_db
    if result.lacks_contrast or result.disturbed:
        return False
    if worst_db is None or steady_worst_db is None:
        return True
    return worst_db >= min(MIN_CONTRAST_DB, steady_worst_db - _ROUNDING_DB)


def _carriers(table: LocalizationTable, steady_row: int, modulation: float) -> Iterator[list[int]]:
    """Yield rows of a carrier near a steady one, and of the side bands nearest to a modulation."""
    frequencies = table.frequencies
    first = max(steady_row - _NEAR, 0)
    end = min(steady_row + _NEAR + 1, len(frequencies))
    for carrier_row in range(first, end):
        carrier = frequencies[carrier_row]
        above_row = int(np.argmin(np.abs(frequencies - carrier - modulation)))
        mirrored = 2 * carrier - frequencies[above_row]
        below_row = int(np.argmin(np.abs(frequencies - mirrored)))
        yield [carrier_row, below_row, above_row]


def _fits(
    tones: FloatArray,
    modulation: float,
    band: tuple[float, float],
    limits: tuple[float, float],
    other_tones: FloatArray,
) -> bool:
    """Return whether carrier and side bands [Hz] are symmetric, within limits, and apart from
    others."""
    carrier, below, above = tones
    distance = above - carrier
    widest = max(distance, modulation)
    is_symmetric = distance > 0 and abs(carrier - below - distance) <= _MAX_ASYMMETRY
    is_in_band = band[0] <= carrier <= band[1]
    is_playable = limits[0] <= carrier - widest and carrier + widest <= limits[1]
    distances = np.abs(np.subtract.outer(tones, other_tones))
    is_apart = (distances >= APART_HZ).all()
    return bool(is_symmetric and is_in_band and is_playable and is_apart)


def _tone_alone(table: LocalizationTable, result: Answer, number: int, row: int) -> Tones:
    """Return a content's tone at a row of the table's frequencies, with all other fingers quiet."""
    contents = result.contents
    stream = contents.streams[number]
    (target,) = stream.targets
    level_db_sl = stream.level_db_sl
    if stream.course is not None:
        level_db_sl -= stream.course.strongest_db
    quiet = [
        finger_number
        for finger_number, finger in enumerate(result.asked)
        if finger_number != target and not finger.is_load
    ]
    background = None if quiet else table.background([contents.places[target]])
    alone = replace(
        contents,
        streams=(Stream((target,), level_db_sl, ((row, row + 1),)),),
        quiet=tuple(quiet),
        background=background,
    )
    return choose_tones(table, alone)


def _with_best_carrier(
    table: LocalizationTable, result: Answer, number: int, candidates: Sequence[Sequence[int]]
) -> Answer:
    """Give a content the carrier and side bands with the best contrast, within the stroke."""
    tone_at = cache(partial(_tone_alone, table, result, number))
    contrasts = [_contrast_db([tone_at(row) for row in rows]) for rows in candidates]
    best_rows = candidates[best_of(contrasts)]
    modulated = [tone_at(row) for row in best_rows]
    full_gains = np.array([tones.gains[0] for tones in modulated])
    gains = _AMPLITUDES * 10 ** (-_ALL_DB / 20) * full_gains

    tones = result.tones
    owners = np.array(tones.owners)
    unchanged = np.flatnonzero(owners != number)
    weights = [tones.weights[tone] for tone in unchanged.tolist()]
    weights += [tone.weights[0] for tone in modulated]
    with_side_bands = with_tones(
        table,
        result,
        np.append(np.array(tones.rows)[unchanged], best_rows),
        weights,
        np.append(owners[unchanged], [number] * len(modulated)),
        np.append(np.array(tones.gains)[unchanged], gains),
    )
    return _within_stroke(table, with_side_bands)


def _contrast_db(tones: Sequence[Tones]) -> float:
    """Return the promised contrast [dB] of a carrier and its side bands, whose leakage adds up."""
    contrasts_db = np.array([tone.worst_db for tone in tones])
    leaked_powers = _AMPLITUDES**2 * 10 ** (-contrasts_db / 10)
    leaked_powers = leaked_powers[np.isfinite(contrasts_db)]
    if not len(leaked_powers):
        return math.inf
    return _ALL_DB - float(decibels(np.sqrt(leaked_powers.sum())))


def _within_stroke(table: LocalizationTable, result: Answer) -> Answer:
    """Lower the contents of an answer until all tones together fit the stroke."""
    tones = result.tones
    streams = result.contents.streams
    rows = np.array(tones.rows)
    owners = np.array(tones.owners)
    gains = np.array(tones.gains)
    drives = np.zeros((len(streams), len(table.eras)))
    np.add.at(drives, owners, gains[:, None] * np.abs(tones.weights))
    promised_db = [
        min(tones.level_db_sl[finger][1] for finger in stream.targets) for stream in streams
    ]
    levels = np.maximum(10 ** (np.array(promised_db) / 20), _LEAST_LEVEL)
    priorities = [stream.priority for stream in streams]
    factors, least_factor = share_stroke(np.ones(len(streams)), drives, levels, priorities)
    if least_factor < 1 - NEARLY:
        result = with_tones(table, result, rows, tones.weights, owners, gains * factors[owners])
    lowered_db = float(decibels(levels * factors / result.contents.levels).min())
    stroke_factor = 1.0 if lowered_db > -SAME_LEVEL else 10 ** (lowered_db / 20)
    return replace(result, tones=replace(result.tones, stroke_factor=stroke_factor))
