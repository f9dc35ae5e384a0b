"""Contents whose strength beats 10 to 30 times a second: a carrier and two side bands.

Of a full modulation each side band has half the amplitude of the carrier. At the carrier's weights
side bands leak 3 to 12 dB more: each has weights of its own, found like those of a content of its
frequency. The carrier is chosen for all three together, near the best steady one.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from model.answer.answer import MIN_CONTRAST_DB, SAME_LEVEL, Answer
from model.answer.promised import share_stroke, with_tones
from model.answer.search import APART_HZ, Stream, Tones
from model.answer.search_in_c import choose_tones
from model.arrays import NEARLY, FloatArray, best_of
from model.finger import decibels
from model.table.table import LocalizationTable

_SHARES = np.array([1.0, 0.5, 0.5])  # amplitudes of carrier and side bands
_ALL_DB = 20 * math.log10(float(np.linalg.norm(_SHARES)))  # of all three above the carrier
_NEAR = 2  # carriers tried on each side of the steady one, by frequencies of the table
_SAME = 0.5  # Hz; by which both side bands may differ in distance from the carrier
_ROUNDING_DB = 1e-3  # of a promise that stays the same


def with_modulation(
    table: LocalizationTable,
    found: Answer,
    *,
    playable: tuple[float, float],
) -> Answer:
    """Return an answer modulated as its fingers ask, where that leaves all fingers served.

    playable: lowest and highest frequency [Hz] of side bands. These are as far below as above the
    carrier, where the table has a frequency nearest to the modulation, and APART_HZ from all tones
    of other contents. A shared content is steady. Levels are lowered to what the stroke allows.
    """
    for number, stream in enumerate(found.contents.streams):
        stimulus, tones = found.asked[stream.targets[0]].stimulus, found.tones
        modulation = None if stimulus is None else stimulus.modulation_hz
        if stimulus is None or modulation is None or len(stream.targets) > 1:
            continue
        alone = cache(_alone_at(table, found, number))
        limits = max(playable[0], table.frequencies[0]), min(playable[1], table.frequencies[-1])
        owners, rows = np.array(tones.owners), np.array(tones.rows)
        taken = table.frequencies[rows[owners != number]]
        tried = [
            each
            for each in _carriers(table, int(rows[owners == number][0]), modulation)
            if _fits(table.frequencies[each], modulation, stimulus.band_hz, limits, taken)
        ]
        if not tried:
            continue
        best = tried[best_of([_contrast_db([alone(row) for row in each]) for each in tried])]
        own, kept = [alone(row) for row in best], np.flatnonzero(owners != number)
        shares = _SHARES * 10 ** (-_ALL_DB / 20) * [each.gains[0] for each in own]
        modulated = with_tones(
            table,
            found,
            np.append(rows[kept], best),
            [*(tones.weights[each] for each in kept.tolist()), *(each.weights[0] for each in own)],
            np.append(owners[kept], [number] * len(own)),
            np.append(np.array(tones.gains)[kept], shares),
        )
        modulated = _within_stroke(table, modulated)
        if is_served(modulated, found):
            found = modulated
    return found


def is_served(found: Answer, steady: Answer) -> bool:
    """Whether all fingers have what they require, and no less than 6 dB unless they had less."""
    worst, before = found.promised_worst_db, steady.promised_worst_db
    if (
        worst is not None
        and before is not None
        and worst < min(MIN_CONTRAST_DB, before - _ROUNDING_DB)
    ):
        return False
    return not (found.lacks_contrast or found.disturbed)


def _carriers(table: LocalizationTable, steady: int, modulation: float) -> Iterator[list[int]]:
    """Rows of carriers near a steady one, and of the side bands nearest to a modulation [Hz]."""
    frequencies = table.frequencies
    for carrier in range(max(steady - _NEAR, 0), min(steady + _NEAR + 1, len(frequencies))):
        f = frequencies[carrier]
        above = int(np.argmin(np.abs(frequencies - f - modulation)))
        yield [carrier, int(np.argmin(np.abs(frequencies - 2 * f + frequencies[above]))), above]


def _fits(
    tones: FloatArray,
    modulation: float,
    band: tuple[float, float],
    limits: tuple[float, float],
    taken: FloatArray,
) -> bool:
    """Whether carrier and side bands [Hz] are even, within the limits, and apart from others."""
    f, below, above = tones
    gap, reach = above - f, max(above - f, modulation)
    is_even = gap > 0 and abs(f - below - gap) <= _SAME
    is_within = band[0] <= f <= band[1] and limits[0] <= f - reach and f + reach <= limits[1]
    is_apart = all(abs(tone - other) >= APART_HZ for tone in tones for other in taken)
    return bool(is_even and is_within and is_apart)


def _alone_at(table: LocalizationTable, found: Answer, number: int) -> Callable[[int], Tones]:
    """Finds a content's tone at a row of the table's frequencies, all other fingers quiet."""
    stream, contents = found.contents.streams[number], found.contents
    (finger,), course = stream.targets, stream.course
    level_db_sl = stream.level_db_sl - (0.0 if course is None else course.strongest_db)
    others = tuple(n for n in range(len(contents.places)) if n != finger)
    background = None if others else table.background([contents.places[finger]])

    def alone(row: int) -> Tones:
        one = Stream((finger,), level_db_sl, ((row, row + 1),))
        asked = replace(contents, streams=(one,), quiet=others, background=background)
        return choose_tones(table, asked)

    return alone


def _contrast_db(tones: Sequence[Tones]) -> float:
    """Promised contrast of a carrier and side bands [dB]: what leaks adds up."""
    own = np.array([each.worst_db for each in tones])
    leaks = (_SHARES**2 * 10 ** (-own / 10))[np.isfinite(own)]
    return _ALL_DB - float(decibels(np.sqrt(leaks.sum()))) if len(leaks) else math.inf


def _within_stroke(table: LocalizationTable, found: Answer) -> Answer:
    """The answer with contents lowered to what the stroke allows of all tones together."""
    tones, streams = found.tones, found.contents.streams
    rows, owners, gains = (np.array(each) for each in (tones.rows, tones.owners, tones.gains))
    drives = np.zeros((len(streams), len(table.eras)))
    np.add.at(drives, owners, gains[:, None] * np.abs(tones.weights))
    reached = [min(tones.level_db_sl[finger][1] for finger in each.targets) for each in streams]
    levels = np.maximum(10 ** (np.array(reached) / 20), 1e-9)  # silent ones
    priorities = [each.priority for each in streams]
    factors, factor = share_stroke(np.ones(len(streams)), drives, levels, priorities)
    if factor < 1 - NEARLY:
        found = with_tones(table, found, rows, tones.weights, owners, gains * factors[owners])
    least_db = float(decibels(levels * factors / found.contents.levels).min())
    of_all = 1.0 if least_db > -SAME_LEVEL else 10 ** (least_db / 20)
    return replace(found, tones=replace(found.tones, stroke_factor=of_all))
