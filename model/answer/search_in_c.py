"""Tones of contents by one call of a kernel in C, or in numpy where there is no compiler."""

from array import array
from ctypes import addressof
from typing import TypeAlias
from weakref import WeakKeyDictionary

import numpy as np

from model import drive_modes
from model.answer.fingers_on_plate import CENTRE_AND_RIM, MAX_FINGERS_BY_POINT, MAX_VARIANCE_FINE
from model.answer.search import (
    KEPT,
    MISSING,
    PROMISED_PERCENTILE,
    PRUNING_STEP,
    REACHED,
    Contents,
    Tones,
)
from model.answer.search_in_numpy import choose_by_numpy
from model.arrays import Complex64Array
from model.compiled.kernels import kernels, run
from model.compiled.structures import (
    FOUND,
    FoundTones,
    GivenQuestion,
    GivenRaster,
    PlateDraws,
    Rules,
    TouchedPlates,
    WeightSearch,
)
from model.drive_modes import LEVEL_MARGIN, UNRESTRICTED
from model.ensemble.draws import JUDGING_DRAWS, PERCENTILE, PROMISED_DRAWS
from model.ensemble.touched_by_kernel import draws_structure, plates_structure
from model.ensemble.touched_plate import RIDGE
from model.table.table import LocalizationTable, given_raster


def choose_tones(table: LocalizationTable, contents: Contents) -> Tones:
    """Choose a tone for each content, and find what it promises."""
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
    judging, promise, *stiffness = by_count.get(k) or by_count.setdefault(k, _with(table, k))
    if contents.loads.count(1.0) < len(contents.loads):
        stiffness = [*_stiffness(table, k, contents.loads)]
    # Not arrays of numpy, of which each takes as long to make and to read as all of these.
    numbers = array("i", [*starts, *targets, *quiet, *priorities, *bands])
    at = array("d", [coordinate for place in places for coordinate in place])
    background = contents.background
    given = GivenQuestion(
        *(count, len(streams[0].bands), k, len(quiet)),
        *(contents.candidates, contents.combinations),
        *(contents.apart_hz, numbers.buffer_info()[0], levels.buffer_info()[0]),
        at.buffer_info()[0],
        *(each.ctypes.data for each in stiffness),
        None if background is None else background.ctypes.data,
        *(addressof(judging), addressof(promise)),
    )
    size = 2 * n * count
    of_fingers = k * (3 + 2 + rules.sets)
    rows = array("i", bytes(4 * count))
    figures = array("f", bytes(4 * (size + count + of_fingers + 2)))
    to = FoundTones(0, rows.buffer_info()[0], figures.buffer_info()[0])
    status = run(by.library.answer, to, plates, raster, rules, given)
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


_Fingers: TypeAlias = tuple[PlateDraws, PlateDraws, Complex64Array, Complex64Array]
"""Plates that judge and those of the promise, and the stiffness of fingers that press lightly, also
at twice the frequencies."""

_Kept: TypeAlias = tuple[TouchedPlates, GivenRaster, Rules, dict[int, _Fingers]]
"""What kernels read of a table; and of so many fingers."""

_kept: WeakKeyDictionary[LocalizationTable, _Kept] = WeakKeyDictionary()


def _with(table: LocalizationTable, fingers: int) -> _Fingers:
    judging, promise = (
        draws_structure(table.on_eras, table.clocks, fingers, by)
        for by in (JUDGING_DRAWS, PROMISED_DRAWS)
    )
    return judging, promise, *_stiffness(table, fingers)


def _stiffness(
    table: LocalizationTable, fingers: int, loads: tuple[float, ...] = ()
) -> tuple[Complex64Array, Complex64Array]:
    """Stiffness of fingers at a table's frequencies, and at twice these where harmonics count."""
    stiffness = table.attached.finger_stiffness(fingers, loads)
    if not table.uncertainty.harmonic:
        return stiffness, stiffness
    return stiffness, table.at_harmonics.plate.finger_stiffness(fingers, loads)


def _kept_of(table: LocalizationTable) -> _Kept:
    """The plate, its raster, and how tones are chosen on a table, as kernels read them."""
    uncertainty, groups = table.uncertainty, table.clocks.groups
    variance = uncertainty.gain_variance
    rules = Rules(
        *(KEPT, MISSING, MAX_FINGERS_BY_POINT, PRUNING_STEP),
        *(len(CENTRE_AND_RIM), variance < MAX_VARIANCE_FINE, uncertainty.frequency > 0),
        *(variance, RIDGE, LEVEL_MARGIN, drive_modes.NEARLY_HIGHEST, REACHED),
        *(PERCENTILE, PROMISED_PERCENTILE),
        *(drive_modes.TARGET_STARTS, drive_modes.ALIGNMENTS, drive_modes.REALIGNMENTS),
        *(_method(drive_modes.ONE_FINGER), _method(drive_modes.SEVERAL)),
        (WeightSearch * 3)(*map(_method, drive_modes.WITHIN_STROKE)),
        1 + max(groups, default=0),
        len(table.threshold_sets),
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


def _method(of: drive_modes.LawsonMethod) -> WeightSearch:
    return WeightSearch(
        *(of.steps, of.is_limited, of.variance, of.gain),
        *(drive_modes.LEVEL_RESERVE, drive_modes.MAX_GROWTH, drive_modes.MAX_MULTIPLIER),
    )
