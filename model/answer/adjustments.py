"""Adjust a solved answer: modulation, levels that quiet fingers allow, and amplifiers' limits.

Modulation is a carrier with two side bands. At full modulation each side band has half the
carrier's amplitude. With the carrier's weights, side bands would leak 3 to 12 dB more, so each side
band has separate weights, computed as for a content at its frequency. The carrier is chosen for all
three together, near the best steady one.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from model.answer.answer import (
    APART_HZ,
    IMPERCEPTIBLE_DB_SL,
    MIN_CONTRAST_DB,
    SAME_LEVEL,
    Answer,
    Limits,
    amplitudes_of,
)
from model.answer.promise import share_stroke, with_tones
from model.answer.question import Stream, Tones
from model.answer.tone_search import choose_tones
from model.arrays import NEARLY, FloatArray, best_of
from model.finger import decibels
from model.table.table import LocalizationTable

_SILENT_DB = -60.0  # gain at which a content is not felt
_AMPLITUDES = np.array([1.0, 0.5, 0.5])  # of carrier and side bands
_ALL_DB = 20 * math.log10(float(np.linalg.norm(_AMPLITUDES)))  # of all, relative to the carrier
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
        candidates = _fitting_carriers(
            table,
            result,
            number,
            stimulus.modulation_hz,
            band=stimulus.band_hz,
            limits=(lowest, highest),
        )
        if not candidates:
            continue
        modulated = _with_best_carrier(table, result, number, candidates)
        if is_served(modulated, result):
            result = modulated
    return result


def _fitting_carriers(
    table: LocalizationTable,
    result: Answer,
    number: int,
    modulation: float,
    *,
    band: tuple[float, float],
    limits: tuple[float, float],
) -> list[list[int]]:
    """Return the rows of all carriers and side bands with which a content can be modulated."""
    owners = np.array(result.tones.owners)
    rows = np.array(result.tones.rows)
    steady_row = int(rows[owners == number][0])
    other_tones = table.frequencies[rows[owners != number]]
    fitting = list[list[int]]()
    for candidate in _carriers(table, steady_row, modulation):
        is_avoided = not {*candidate}.isdisjoint(result.contents.avoided)
        fits = _fits(table.frequencies[candidate], modulation, band, limits, other_tones)
        if fits and not is_avoided:
            fitting.append(candidate)
    return fitting


def is_served(result: Answer, steady: Answer) -> bool:
    """Return whether all fingers meet their requirements, with a contrast of at least 6 dB, or of
    the steady answer if that is lower."""
    worst_db = result.promised_worst_db
    steady_worst_db = steady.promised_worst_db
    if result.lacks_contrast or result.disturbed:
        return False
    if worst_db is None or steady_worst_db is None:
        return True
    return worst_db >= min(MIN_CONTRAST_DB, steady_worst_db - _ROUNDING_DB)


def _carriers(table: LocalizationTable, steady_row: int, modulation: float) -> Iterator[list[int]]:
    """Yield the rows of possible carriers near a steady one, each with rows of its side bands."""
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
    quiet = list[int]()
    for index, finger in enumerate(result.asked):
        if index != target and not finger.is_load:
            quiet.append(index)
    background = None if quiet else table.background([contents.places[target]])
    alone = replace(
        contents,
        streams=(Stream(targets=(target,), level_db_sl=level_db_sl, bands=((row, row + 1),)),),
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


def as_quiet_fingers_allow(table: LocalizationTable, result: Answer) -> Answer:
    """Set the levels of stimuli with `is_limit` to the highest that the other fingers allow.

    Together they reach at most IMPERCEPTIBLE_DB_SL at quiet fingers, relative to the rig's own
    thresholds, on 90 % of plates. For fingers with their own vibration, none is raised above that
    level, but none is lowered either.
    """
    contents = result.contents
    streams = contents.streams
    tones = result.tones
    limited = [n for n, stream in enumerate(streams) if stream.limit_db_sl is not None]
    foreign_db_sl = tones.foreign_db_sl
    if len(limited) < len(streams):
        limited_alone_db = np.full(len(streams), _SILENT_DB)
        limited_alone_db[limited] = 0.0
        foreign_db_sl = with_gains(table, result, limited_alone_db).tones.foreign_db_sl
    highest_db_sl = IMPERCEPTIBLE_DB_SL - float(decibels(math.sqrt(len(limited))))
    gains_db = np.zeros(len(streams))
    for number in limited:
        stream = streams[number]
        level = min(tones.level_db_sl[finger][0] for finger in stream.targets)
        allowed = highest_db_sl - _loudest_db_sl(foreign_db_sl, contents.quiet)
        raised = highest_db_sl - _loudest_db_sl(foreign_db_sl, contents.others(number))
        gains_db[number] = min((stream.limit_db_sl or 0.0) - level, allowed, max(raised, 0.0))
    return with_gains(table, result, gains_db)


def _loudest_db_sl(foreign_db_sl: Sequence[Sequence[float]], fingers: Sequence[int]) -> float:
    """Return the highest foreign level at some fingers, relative to the rig's own thresholds.

    -inf without fingers.
    """
    return max([foreign_db_sl[finger][0] for finger in fingers], default=-math.inf)


def as_ramps_allow(table: LocalizationTable, result: Answer, limits: Limits) -> Answer:
    """Lengthen the ramps of short stimuli to respect the amplifiers' slew limit.

    Levels are raised in return, except for stimuli with `is_limit`, whose level other fingers set.
    """
    contents = result.contents
    tones = result.tones
    full_levels = table.full_levels
    if contents.is_shaped or all(stream.duration is None for stream in contents.streams):
        return result
    levels = [amplitude / full_levels[name] for name, amplitude in result.amplitudes.items()]
    ramp = max(levels) / limits.slew
    if ramp <= min([layer.ramp for layer in result.layers]):
        return result
    longer = replace(result, contents=replace(contents, least_ramp=ramp))
    rows = np.array(tones.rows, dtype=int)
    owners = np.array(tones.owners, dtype=int)
    may_rise = all(stream.limit_db_sl is None for stream in contents.streams)
    gains = None if may_rise else np.array(tones.gains)
    return with_tones(table, longer, rows, tones.weights, owners, gains)


def gains_within(table: LocalizationTable, result: Answer, limits: Limits) -> FloatArray:
    """Compute gains [dB] on the layers of an answer that bring them within the amplifiers' limits.

    Limits are shared like the stroke: lower priorities are reduced first, and louder layers first
    among equal priorities. Layers share the allowed power in proportion to their own.
    """
    full_levels = table.full_levels
    highest = limits.amplitudes or full_levels
    amplitudes = np.zeros((len(result.layers), len(full_levels)))
    excursions = np.zeros(len(result.layers))
    for number, layer in enumerate(result.layers):
        era_amplitudes = amplitudes_of(layer.excitations)
        amplitudes[number] = [era_amplitudes[era] for era in full_levels]
        excursions[number] = table.excursion_of(layer.drives)
    levels = amplitudes / [*full_levels.values()]
    layer_norms = np.linalg.norm(levels, axis=1)
    total_norm = np.linalg.norm(levels.sum(axis=0))
    power_shares = layer_norms * total_norm / layer_norms.sum()
    used_shares = np.column_stack(
        [
            amplitudes / [highest[era] for era in full_levels],
            power_shares / math.sqrt(limits.power),
            excursions / limits.excursion,
        ]
    )
    promised_db_sl = np.zeros(len(result.layers))
    priorities = []
    for number, stream in enumerate(result.contents.streams):
        sensation = result.fingers[stream.targets[0]]
        promised_db_sl[number] = sensation.promised_level_db_sl
        priorities.append(sensation.finger.priority)
    factors, _ = share_stroke(
        np.ones(len(priorities)),
        used_shares.astype(np.complex64),
        10 ** (promised_db_sl / 20),
        priorities,
    )
    return np.maximum(decibels(np.maximum(factors, 1e-9)), _SILENT_DB)


def with_gains(table: LocalizationTable, result: Answer, gains_db: FloatArray) -> Answer:
    """Apply a gain [dB] to each layer of an answer, within the stroke."""
    tones = result.tones
    owners = np.array(tones.owners, dtype=int)
    content_gains = 10 ** (gains_db / 20)
    tone_gains = content_gains[owners] * tones.gains
    era_amplitudes = tone_gains[:, None] * np.abs(np.array(tones.weights))
    stroke = float(era_amplitudes.sum(axis=0).max(initial=0))
    rows = np.array(tones.rows, dtype=int)
    return with_tones(table, result, rows, tones.weights, owners, tone_gains / max(stroke, 1.0))


def scaled(result: Answer, gain_db: float) -> Answer:
    """Apply one gain [dB] to a whole answer; contrasts do not change."""
    tones = result.tones
    factor = 10 ** (gain_db / 20)
    scaled_tones = replace(
        tones,
        gains=[factor * gain for gain in tones.gains],
        level_db_sl=_raised(tones.level_db_sl, gain_db),
        foreign_db_sl=_raised(tones.foreign_db_sl, gain_db),
        stroke_factor=tones.stroke_factor * factor,
    )
    return replace(result, tones=scaled_tones)


def _raised(levels_db: Sequence[Sequence[float]], gain_db: float) -> list[list[float]]:
    """Return levels (k, ...) of k fingers with a gain [dB]."""
    return [[level_db + gain_db for level_db in by_finger] for by_finger in levels_db]
