"""Search for the tones of contents: a C kernel, and an equivalent in numpy.

`choose_tones` packs a query for the kernel. `choose_by_numpy` handles cases that the kernel does
not support (durations, envelopes, avoided frequencies, the drive mode `switched`) and machines
without a compiler. It must give the same result: candidates for each content by
`model.drive_modes`, evaluated on drawn plates; the promise is for the best combination.
"""

from array import array
from collections.abc import Sequence
from ctypes import addressof
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from model import drive_modes
from model.answer.answer import (
    KEPT,
    MISSING,
    PROMISED_PERCENTILE,
    PRUNING_STEP,
    REACHED,
    Contents,
    Stream,
    Tones,
)
from model.answer.fingers_on_plate import (
    CENTRE_AND_FOUR,
    CENTRE_AND_RIM,
    MAX_FINGERS_BY_POINT,
    MAX_VARIANCE_FINE,
    DriveTones,
    FingersOnPlate,
)
from model.answer.promise import promised
from model.answer.ringing import RingingUnderFingers, on_drawn_plates
from model.arrays import (
    Complex64Array,
    Float32Array,
    FloatArray,
    IntArray,
    best_few,
    best_first,
    best_of,
)
from model.compiled.kernels import (
    FOUND,
    FoundTones,
    GivenQuestion,
    GivenRaster,
    PlateDraws,
    Rules,
    TouchedPlates,
    WeightSearch,
    kernels,
    run_kernel,
)
from model.drive_modes import (
    LEVEL_MARGIN,
    NEARLY_HIGHEST,
    UNRESTRICTED,
    Forms,
    WeightedTones,
    find_switched,
    max_sensation_switched,
    search,
    search_all,
    search_to_level,
)
from model.ensemble.draws import JUDGING_DRAWS, PERCENTILE, PROMISED_DRAWS, percentile
from model.ensemble.expected_power import RIDGE
from model.ensemble.kernel_plates import draws_structure, plates_structure
from model.finger import decibels
from model.table.table import SAME_FREQUENCY, LocalizationTable, given_raster

MAX_BY_POINT = 8
"""Frequencies at which weights over a duration are also searched with the points of fingertips."""

IN_TIME = 3
"""Number of pulse candidates solved in time, the best by energy."""

_TINY, _TOO_LOUD = 1e-20, 1e12  # powers; for rejected candidates

_BATCH = 64  # candidates evaluated together


def choose_tones(table: LocalizationTable, contents: Contents) -> Tones:
    """Choose tones for each content and compute their promises."""
    streams, places, quiet, by = contents.streams, contents.places, contents.quiet, kernels()
    starts, targets, bands, priorities, levels = [0], list[int](), list[int](), [], array("f")
    is_here = contents.drive_mode == UNRESTRICTED and not contents.avoided
    for stream in streams:
        targets += stream.targets
        starts.append(len(targets))
        for band in stream.bands:
            bands += band
        priorities.append(stream.priority)
        levels.append(10 ** (stream.level_db_sl / 20))
        is_here = is_here and stream.duration is None
    if by is None or not is_here:
        return choose_by_numpy(table, contents, by_kernel=by is not None)
    count, n, k = len(streams), len(table.eras), len(places)
    kept = _kept.get(table) or _kept.setdefault(table, _kept_of(table))
    plates, raster, rules, by_count = kept
    judging, promise, *stiffness = by_count.get(k) or by_count.setdefault(
        k, _with_fingers(table, k)
    )
    if contents.loads.count(1.0) < len(contents.loads):
        stiffness = [*_stiffness(table, k, contents.loads)]
    # One array: building and reading several numpy arrays would take as long each.
    numbers = array("i", [*starts, *targets, *quiet, *priorities, *bands])
    at = array("d", [coordinate for place in places for coordinate in place])
    background = contents.background
    given = GivenQuestion(
        contents=count,
        bands=len(streams[0].bands),
        fingers=k,
        quiet_count=len(quiet),
        candidates=contents.candidates,
        combinations=contents.combinations,
        apart=contents.apart_hz,
        numbers=numbers.buffer_info()[0],
        level=levels.buffer_info()[0],
        places=at.buffer_info()[0],
        stiffness=stiffness[0].ctypes.data,
        at_harmonics=stiffness[1].ctypes.data,
        load_std=stiffness[2].ctypes.data,
        background=None if background is None else background.ctypes.data,
        judging=addressof(judging),
        promise=addressof(promise),
    )
    size = 2 * n * count
    of_fingers = k * (3 + 2 + rules.sets)
    rows = array("i", bytes(4 * count))
    figures = array("f", bytes(4 * (size + count + of_fingers + 2)))
    to = FoundTones(0, rows.buffer_info()[0], figures.buffer_info()[0])
    status = run_kernel(by.library.answer, to, plates, raster, rules, given)
    if status != FOUND:
        raise AssertionError("contents must have tones")
    found = figures.tolist()
    weights = map(complex, found[:size:2], found[1:size:2])
    contrast = size + count
    level, of_others = contrast + 3 * k, contrast + 5 * k
    worst, factor = found[-2:]
    return Tones(
        rows=rows.tolist(),
        weights=list(zip(*[weights] * n, strict=True)),
        gains=found[size:contrast],
        owners=range(count),
        contrast_db=list(zip(*[iter(found[contrast:level])] * 3, strict=True)),
        level_db_sl=list(zip(*[iter(found[level:of_others])] * 2, strict=True)),
        foreign_db_sl=list(zip(*[iter(found[of_others:-2])] * rules.sets, strict=True)),
        worst_db=worst,
        stroke_factor=factor,
        is_apart=bool(to.is_apart),
    )


_Loads: TypeAlias = tuple[Complex64Array, Complex64Array, Float32Array]
"""Stiffness of fingers, also at harmonics, and the uncertainty of their loads."""

_Fingers: TypeAlias = tuple[PlateDraws, PlateDraws, *_Loads]
"""Draws for evaluation and for promises; loads of fingers of load 1."""

_Kept: TypeAlias = tuple[TouchedPlates, GivenRaster, Rules, dict[int, _Fingers]]
"""Cached structures of a table: plate, raster, rules, and per number of fingers."""

_kept: WeakKeyDictionary[LocalizationTable, _Kept] = WeakKeyDictionary()


def _kept_of(table: LocalizationTable) -> _Kept:
    """Pack a table's plate and raster, and the selection rules, for kernels."""
    uncertainty, groups = table.uncertainty, table.clocks.groups
    variance = uncertainty.gain_variance
    rules = Rules(
        kept=KEPT,
        missing=MISSING,
        max_by_point=MAX_FINGERS_BY_POINT,
        pruning_step=PRUNING_STEP,
        rim_count=len(CENTRE_AND_RIM),
        is_deep=variance < MAX_VARIANCE_FINE,
        others=uncertainty.changes_modes,
        gain_variance=variance,
        ridge=RIDGE,
        margin=LEVEL_MARGIN,
        highest=drive_modes.NEARLY_HIGHEST,
        reached=REACHED,
        judged=PERCENTILE,
        promised=PROMISED_PERCENTILE,
        starts=drive_modes.TARGET_STARTS,
        iterations=drive_modes.ALIGNMENTS,
        again=drive_modes.REALIGNMENTS,
        one_finger=_method(drive_modes.ONE_FINGER),
        several=_method(drive_modes.SEVERAL),
        within=(WeightSearch * 3)(*map(_method, drive_modes.WITHIN_STROKE)),
        groups=1 + max(groups, default=0),
        sets=len(table.threshold_sets),
    )
    rules.point(
        rim=CENTRE_AND_RIM,
        group=np.array(groups, dtype=np.int32) if groups else None,
        threshold=table.thresholds,
        error=table.error_power,
        shares=table.power_shares,
        frequencies=table.frequencies,
        sensitivities=table.sensitivities.T,
        search_error=table.search_error_power,
        harmonic_threshold=table.compared_harmonic_thresholds,
        harmonic_sensitivities=table.harmonic_sensitivities.T,
    )
    if uncertainty.harmonic > 0:
        rules.at_harmonics = addressof(plates_structure(table.at_harmonics))
    return plates_structure(table.on_eras), given_raster(table), rules, {}


def _with_fingers(table: LocalizationTable, fingers: int) -> _Fingers:
    """Draw the plates of a table with a number of fingers, in the kernels' format."""
    judging, promise = (
        draws_structure(table.on_eras, table.clocks, fingers, by)
        for by in (JUDGING_DRAWS, PROMISED_DRAWS)
    )
    return judging, promise, *_stiffness(table, fingers)


def _stiffness(table: LocalizationTable, fingers: int, loads: tuple[float, ...] = ()) -> _Loads:
    """Return fingers' stiffness at a table's frequencies and at twice these, and standard
    deviations."""
    stiffness = table.attached.finger_stiffness(fingers, loads)
    stds = table.attached.load_stds(fingers, loads)
    if not table.uncertainty.harmonic:
        return stiffness, stiffness, stds
    return stiffness, table.at_harmonics.plate.finger_stiffness(fingers, loads), stds


def _method(of: drive_modes.LawsonMethod) -> WeightSearch:
    return WeightSearch(
        steps=of.steps,
        limited=of.is_limited,
        variance=of.variance,
        gain=of.gain,
        reserve=drive_modes.LEVEL_RESERVE,
        growth=drive_modes.MAX_GROWTH,
        most=drive_modes.MAX_MULTIPLIER,
    )


@dataclass(frozen=True, eq=False)
class Candidates:
    """m candidates of all contents."""

    streams: IntArray
    """Content of each (m,)."""
    bands: IntArray
    """Band of each candidate (m,), by number within its content."""
    scores: FloatArray
    drives: Sequence[WeightedTones]

    @property
    def rows(self) -> IntArray:
        """Row of the first tone of each candidate (m,)."""
        return np.array([drive[0][0] for drive in self.drives], dtype=int)


def choose_by_numpy(
    table: LocalizationTable, contents: Contents, *, by_kernel: bool = False
) -> Tones:
    """Choose tones for each content and compute their promises, in numpy.

    by_kernel: whether to solve the plate with fingers in C.
    """
    fingers = FingersOnPlate.of(table, contents.places, contents.loads, by_kernel=by_kernel)
    ringing, rows = RingingUnderFingers.of_streams(table, contents), contents.rows
    if contents.drive_mode == UNRESTRICTED:
        is_ranked = contents.is_ranked and not any(ringing) and not table.clocks.groups
        kept = ranked(fingers, contents) if is_ranked else rows
        found, is_limited = _candidates(fingers, contents, kept, ringing)
        if len(kept) < len(rows) and (not found.drives or is_limited):
            found, is_limited = _candidates(fingers, contents, rows, ringing)
    else:
        found = _switched_candidates(fingers, contents, ringing[0])
    least, own, loudest = _judged(fingers, contents, found, ringing)
    best, is_apart = np.zeros(1, dtype=int), True
    if len(contents.streams) > 1:
        best, is_apart = best_combination(table, contents, found, own, loudest)
    elif len(found.drives) > 1:
        quiet = loudest[:, [*contents.quiet]]
        level = float(contents.levels[0])
        best[0] = best_tone(level, found.scores, own, quiet, least)
    tones = DriveTones.of([found.drives[each] for each in best.tolist()])
    return promised(fingers, contents, tones, is_apart=is_apart, ringing=ringing)


def ranked(fingers: FingersOnPlate, contents: Contents) -> IntArray:
    """Return the most promising rows for a single target, ascending.

    Based on one form of all other fingers together.
    """
    table, tips, touched = fingers.table, fingers.tips, fingers.touched
    rows, target, others = contents.rows, contents.streams[0].targets[0], contents.others(0)
    points, weights = tips.few, tips.few_weights
    if len(others) > MAX_FINGERS_BY_POINT:
        points, weights = touched.centres[:, None], np.ones_like(weights[:, :1])
    shares = np.zeros_like(weights)
    shares[others] = weights[others] / np.float32(len(others))
    every = points.reshape(1, -1, points.shape[2])
    found = touched.forms(rows, every, shares.reshape(1, -1), table.search_error_power)
    fields = found.fields.reshape(len(rows), *points.shape[:2], -1)
    mean = (weights[target] @ fields[:, target])[None]
    level, threshold = float(contents.levels[0]), table.thresholds.take(rows)
    power = found.power.swapaxes(0, 1)
    searched = search_all(Forms(mean, power, found.power, threshold, level, 0.0))
    order = best_first(searched.bound)
    reaches = searched.score[order] > 0
    # Rows that would beat the best one if they were loud enough.
    first = int(reaches.argmax()) if reaches.any() else len(order)
    missing = order[:first][:MISSING]
    reaching = order[reaches][: KEPT - len(missing)]
    return np.asarray(rows[np.sort(np.concatenate([reaching, missing]))])


def _candidates(
    fingers: FingersOnPlate,
    contents: Contents,
    rows: IntArray,
    ringing: Sequence[RingingUnderFingers | None],
) -> tuple[Candidates, bool]:
    """Find the best tones of each content in each band, and whether a level was hard to reach.

    With all ERAs together, or with each group of ERAs on a common clock.
    """
    count, hertz = len(contents.streams), fingers.table.frequencies
    every = np.arange(len(hertz)) if any(ringing) else rows
    formed = fingers.forms(every, with_fine=True)
    apart_hz = contents.apart_hz if count > 1 else 0.0
    found: list[tuple[int, int, float, WeightedTones]] = []
    is_limited = False
    for number, stream in enumerate(contents.streams):
        others = contents.others(number)
        over = ringing[number] if others else None  # a single finger's ringing disturbs no other
        level = stream.level_db_sl + float(decibels(count))
        rest = None if contents.background is None or others else contents.background[every]
        lasting = formed.of(stream.targets, others, level, rest)
        for band, (low, end) in enumerate(stream.bands):
            here = np.flatnonzero(np.isin(every, rows) & (every >= low) & (every < end))
            here = here if over is None else over.lasting_long_enough(here)
            asked = _at(here, lasting, over)
            groups = [asked.among(each) for each in _groups(fingers.table)]
            searches = [(each, *search_to_level(each)) for each in groups]
            reaching = [each for each in searches if each[2] is each[0]]
            for own, searched, forms in reaching or searches:
                is_limited |= len(searched.level_limited) > 0 or forms is not own
                ways = [(here, searched)]
                if 1 <= len(others) <= MAX_FINGERS_BY_POINT and searched.score.any():
                    best = np.sort(best_first(searched.score)[:MAX_BY_POINT])
                    some = here if over is None else here[best]
                    tried = replace(lasting, wanted=forms.wanted, driven=forms.driven)
                    tried = replace(tried, level_margin=forms.level_margin)
                    by_point = formed.by_point(tried, others)
                    ways.append((some, search(_at(some, by_point, over))))
                for some, way in ways:
                    at = every[some]
                    for each in _apart(way.score, hertz[at], contents.candidates, apart_hz):
                        drive = [(int(at[each]), way.weights[each])]
                        found.append((number, band, float(way.score[each]), drive))
    streams, bands, scores, drives = zip(*found, strict=True) if found else ((),) * 4
    return Candidates(np.array(streams), np.array(bands), np.array(scores), drives), is_limited


def _switched_candidates(
    fingers: FingersOnPlate, contents: Contents, over: RingingUnderFingers | None
) -> Candidates:
    """Find the best patterns of the drive mode `switched` for a single content.

    Uses the ERAs of a single group at a time; near the highest level if no group reaches the
    requested level.
    """
    (stream,), quiet, rows = contents.streams, contents.quiet, contents.rows
    rows = rows if over is None or not quiet else over.lasting_long_enough(rows)
    by_point = over is None and 1 <= len(quiet) <= MAX_FINGERS_BY_POINT
    every = np.arange(len(fingers.table.frequencies))
    formed = fingers.forms(every, with_fine=by_point)
    lasting = formed.of(stream.targets, quiet, stream.level_db_sl, contents.background)
    if by_point:
        lasting = formed.by_point(lasting, quiet, CENTRE_AND_FOUR)
    forms = _at(rows, lasting, over if quiet else None)
    groups = _groups(fingers.table)
    among = [forms.among(each) for each in groups]
    searches = [find_switched(each) for each in among]
    among = [replace(each, level_margin=0.0) for each in among]
    if not any(searches):
        searches = [find_switched(each) for each in among]
    if not any(searches):
        highest = [NEARLY_HIGHEST * max_sensation_switched(each) for each in among]
        levels = zip(among, highest, strict=True)
        searches = [find_switched(replace(each, wanted=wanted)) for each, wanted in levels]
    found = [
        (score, drive)
        for group, search in zip(groups, searches, strict=True)
        for score, drive in search
        if not any(weights[~group].any() for _, weights in drive)
    ]
    found.sort(key=itemgetter(0), reverse=True)
    drives = [[(int(rows[row]), weights) for row, weights in drive] for _, drive in found]
    none = np.zeros(len(found), dtype=int)
    return Candidates(none, none, np.array([score for score, _ in found]), drives)


def _at(some: IntArray, lasting: Forms, over: RingingUnderFingers | None) -> Forms:
    """Select forms at some frequencies, by index, over the envelope if the stimulus has one."""
    return lasting.at(some) if over is None else over.forms(lasting, some)


def _groups(table: LocalizationTable) -> list[NDArray[np.bool_]]:
    """Return masks (n,) of the ERAs that can play one content together, one per group."""
    groups = np.array(table.clocks.groups or [0] * len(table.eras))
    return [groups == each for each in np.unique(groups)]


def _apart(score: Float32Array, frequencies: FloatArray, count: int, apart_hz: float) -> list[int]:
    """Return indices of the two best scores, and of the next best at separate frequencies."""
    found: list[int] = []
    for at in best_first(score).tolist():
        if score[at] <= 0 or len(found) == count:
            break
        gaps = np.abs(frequencies[found] - frequencies[at])
        if len(found) < 2 or (gaps >= apart_hz - SAME_FREQUENCY).all():
            found.append(at)
    return found


def _judged(
    fingers: FingersOnPlate,
    contents: Contents,
    found: Candidates,
    ringing: Sequence[RingingUnderFingers | None],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate m candidates on d drawn plates: level (m,) that 90 % reach, as an amplitude.

    Over a duration, the level is nominal. Also returns the amplitude (m, d) at the targets and the
    squared amplitude (m, k, d) at the loudest points, scaled to the contents' levels if there are
    several contents.
    """
    drives = [
        drive if (over := ringing[stream]) is None else over.spectrum(drive)
        for stream, drive in zip(found.streams.tolist(), found.drives, strict=True)
    ]
    parts = [
        fingers.felt(JUDGING_DRAWS, DriveTones.of(drives[first:][:_BATCH]))
        for first in range(0, len(drives), _BATCH)
    ]
    means = np.concatenate([part for part, _ in parts])
    loudest = np.concatenate([part for _, part in parts], dtype=float)
    own, least = np.empty((len(loudest), loudest.shape[2])), np.empty(len(loudest))
    for number, stream in enumerate(contents.streams):
        of, targets = np.flatnonzero(found.streams == number), [*stream.targets]
        own[of] = means[of][:, targets].min(axis=1)
        over, others = ringing[number], contents.others(number)
        if over is not None and others and not over.envelope.is_course:
            by_energy = own[of] / np.sqrt(loudest[of][:, others].max(axis=1))
            order = of[best_first(percentile(by_energy))]
            loudest[order[IN_TIME:]], some = _TOO_LOUD, order[:IN_TIME]
            tried = [found.drives[each] for each in some.tolist()]
            lasting = fingers.felt(JUDGING_DRAWS, DriveTones.of(tried))[0][:, targets, 0].min(
                axis=1
            )
            during = [over.over_drive(drive) for drive in tried]
            gains = lasting * [each.gains[targets].min() for each in during] / own[some, 0]
            heard = np.array([each.heard.max(axis=1) for each in during])
            loudest[some] = on_drawn_plates(loudest[some], heard, gains[:, None, None] ** 2)
            own[some] *= gains[:, None]
        least[of] = percentile(own[of, 1:]) if over is None else own[of, 0]
        if len(contents.streams) > 1:
            gain = contents.levels[number] / np.maximum(least[of], _TINY)
            own[of] *= gain[:, None]
            loudest[of] *= gain[:, None, None] ** 2
    return least, own[:, 1:], loudest[:, :, 1:]


def best_tone(
    wanted: float, scores: FloatArray, own: FloatArray, quiet: FloatArray, least: FloatArray
) -> int:
    """Choose the candidate of a single content: level first, then contrast.

    Without other fingers, the score counts, and equally a level that varies little among plates.
    wanted: amplitude relative to the threshold; scores (m,); own (m, d), quiet (m, q, d), least
    (m,): from `_judged`.
    """
    reaches = least >= wanted * REACHED
    if not reaches.any():
        reaches[:] = True
    if not quiet.shape[1]:
        return best_of(reaches * scores * least / percentile(own, 50))
    loud = np.sqrt(quiet.max(axis=1))
    return best_of(np.where(reaches, percentile(own / np.maximum(loud, 1e-30)), 0.0))


def best_combination(
    table: LocalizationTable,
    contents: Contents,
    found: Candidates,
    own: FloatArray,
    loudest: FloatArray,
) -> tuple[IntArray, bool]:
    """Choose a candidate for each content (K,); also return whether their frequencies are apart.

    Contents swap bands if they have several. Combinations with separate frequencies come first;
    others are used only without any.
    """
    streams, hertz = contents.streams, table.frequencies[found.rows]
    sensitivities = table.sensitivities[:, found.rows]
    for gap in (contents.apart_hz, 0.0):
        combinations = np.flatnonzero(found.streams == 0)[:, None]
        for number in range(1, len(streams)):
            own_candidates = np.flatnonzero(found.streams == number)
            before = np.repeat(combinations, len(own_candidates), axis=0)
            last = np.tile(own_candidates, len(combinations))[:, None]
            gaps = np.abs(hertz[last] - hertz[before])
            allowed = (gaps >= gap - SAME_FREQUENCY).all(axis=1)
            if len(streams[0].bands) > 1:
                allowed &= (found.bands[last] != found.bands[before]).all(axis=1)
            combinations = np.concatenate([before, last], axis=1)[allowed]
            if len(combinations) > contents.combinations:
                some = own[:, ::PRUNING_STEP], loudest[:, :, ::PRUNING_STEP]
                worst = worst_ratios(combinations, streams, contents.quiet, *some, sensitivities)
                combinations = combinations[best_few(worst, contents.combinations)]
        if len(combinations):
            worst = worst_ratios(combinations, streams, contents.quiet, own, loudest, sensitivities)
            return combinations[best_of(worst)], gap == contents.apart_hz
    raise AssertionError("contents with as many bands must have a combination")


def worst_ratios(
    combinations: IntArray,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    own: FloatArray,
    loudest: FloatArray,
    sensitivities: Float32Array,
) -> FloatArray:
    """Return the power ratio at the worst finger on 90 % of plates for combinations (c, j): (c,).

    The lowest over the threshold sets, with sensitivities (s, m). Only the first j contents play;
    own (m, d), loudest (m, k, d): from `_judged`.
    """
    least = np.full(len(combinations), np.inf)
    for factors in sensitivities.astype(float):
        power = loudest * np.square(factors)[:, None, None]
        levels = (own * factors[:, None])[combinations] ** 2
        total = power[combinations].sum(axis=1)
        worst = np.full((len(combinations), own.shape[1]), np.inf)
        for j, at in enumerate(combinations.T):
            if combinations.shape[1] > 1:
                for finger in streams[j].targets:
                    others_power = np.maximum(total[:, finger] - power[at, finger], _TINY)
                    worst = np.minimum(worst, levels[:, j] / others_power)
        for finger in quiet:
            worst = np.minimum(worst, levels.min(axis=1) / np.maximum(total[:, finger], _TINY))
        least = np.minimum(least, percentile(worst))
    return least
