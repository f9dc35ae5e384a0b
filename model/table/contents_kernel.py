"""Tones of contents by one call of a kernel in C, or in numpy where there is no compiler."""

from ctypes import addressof
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from model.compiled.kernels import run
from model.compiled.structures import FOUND, Drawn, FoundTones, GivenQuestion, Method, Rules
from model.drive_modes.coherent import ONE_FINGER, SEVERAL, WITHIN_STROKE
from model.drive_modes.forms import LEVEL_MARGIN
from model.drive_modes.phased import MAX_TARGETS, PHASED, as_structure
from model.ensemble.measures import PERCENTILE
from model.ensemble.touched_by_kernel import TouchedByKernel, draws_structure, touch
from model.ensemble.touched_plate import RIDGE
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
    Tones,
)
from model.table.contents_numpy import choose_by_numpy
from model.table.fingers_on_plate import CENTRE_AND_RIM, MAX_FINGERS_BY_POINT, MAX_VARIANCE_FINE
from model.transients.onset import TIME_COUNT

if TYPE_CHECKING:
    from model.table.table import LocalizationTable

_NEEDS_ONSETS = 2


def choose_tones(table: "LocalizationTable", contents: Contents) -> Tones | None:
    """Choose a tone for each content; None where one frequency hardly reaches a strict level."""
    touched = touch(table.on_eras, contents.tips.few[:, 0], contents.loads)
    streams = contents.streams
    has_many = False
    for stream in streams:
        has_many |= len(stream.targets) > MAX_TARGETS
    if has_many or not isinstance(touched, TouchedByKernel):
        return choose_by_numpy(table, contents)
    count, n, k = len(streams), len(table.eras), len(touched.centres)
    rules, drawn = _rules(table, k)
    given = _question(contents, drawn)
    rows = np.empty(count, dtype=np.int32)
    found = np.empty(count * (2 * n + 1) + 6 * k + 3, dtype=np.float32)
    ends = np.cumsum([2 * n * count, count, 3 * k, 2 * k, k])
    weights, *figures = np.split(found, ends)
    at = found.ctypes.data
    to = FoundTones(0, 0, rows.ctypes.data, at, *(at + 4 * ends).tolist())
    kernel, plates = touched.kernels.library.answer, touched.structure
    status = run(kernel, to, plates, rules, given)
    if status == _NEEDS_ONSETS:
        onsets = table.onsets
        given.with_onset = onsets is not None
        if onsets is not None:
            rules.point(onsets=onsets.parts)
        status = run(kernel, to, plates, rules, given)
    if status != FOUND:
        return None
    gains, contrast, level, foreign_amplitudes, of_all = figures
    worst, factor, loudest = of_all.tolist()
    return Tones(
        rows.astype(int),
        weights.view(np.complex64).reshape(count, n),
        gains.astype(float),
        contrast.astype(float).reshape(k, 3),
        level.astype(float).reshape(k, 2),
        foreign_amplitudes.astype(float),
        worst,
        factor,
        loudest,
        bool(to.is_apart),
    )


def _question(contents: Contents, drawn: tuple[Drawn, Drawn]) -> GivenQuestion:
    """Contents as kernels read them, with the plates that judge and those of the promise."""
    tips, streams, rows = contents.tips, contents.streams, contents.rows
    starts, targets, bands, priorities = [0], list[int](), list[int](), []
    for stream in streams:
        targets += stream.targets
        starts.append(len(targets))
        for band in stream.bands:
            bands += band
        priorities.append(stream.priority)
    given = GivenQuestion(
        *(len(streams), len(streams[0].bands), len(rows), len(contents.quiet)),
        *(tips.few.shape[1], tips.fine.shape[1], contents.is_ranked, contents.is_strict),
        *(contents.with_onset, contents.apart_hz),
        judging=addressof(drawn[0]),
        promise=addressof(drawn[1]),
    )
    given.point(
        row=rows,
        starts=np.array(starts),
        targets=np.array(targets),
        quiet=np.array(contents.quiet, dtype=int),
        priority=np.array(priorities),
        band=np.array(bands),
        level=contents.levels,
        few_points=tips.few,
        fine_points=tips.fine,
        few_weights=tips.few_weights,
        fine_weights=tips.fine_weights,
        background=contents.background,
    )
    return given


def _rules(table: "LocalizationTable", fingers: int) -> tuple[Rules, tuple[Drawn, Drawn]]:
    """How tones are chosen on a table, and drawn plates with so many fingers, kept with it."""
    kept = _kept.get(table)
    if kept is None:
        kept = _kept.setdefault(table, (_rules_of(table), {}))
    rules, by_count = kept
    drawn = by_count.get(fingers)
    if drawn is None:
        on = table.on_eras
        judging = draws_structure(on, fingers, JUDGING_DRAWS)
        drawn = by_count[fingers] = judging, draws_structure(on, fingers, PROMISED_DRAWS)
    return rules, drawn


def _rules_of(table: "LocalizationTable") -> Rules:
    """How tones are chosen on a table."""
    plate = table.attached
    found = Rules(
        *(KEPT, MISSING, MAX_FINGERS_BY_POINT, MIN_CANDIDATES, MAX_COMBINATIONS, PRUNING_STEP),
        *(len(CENTRE_AND_RIM), plate.gain_variance < MAX_VARIANCE_FINE, plate.thickness > 0),
        *(TIME_COUNT, plate.gain_variance, RIDGE, LEVEL_MARGIN, NEARLY_HIGHEST, REACHED),
        *(10 ** (-ONSET_MARGIN_DB / 20), ONSET_WEIGHT, PERCENTILE, PROMISED_PERCENTILE),
        *(PHASED.phases[1], PHASED.iterations, as_structure(ONE_FINGER), as_structure(SEVERAL)),
        (Method * 3)(*map(as_structure, WITHIN_STROKE)),
    )
    found.point(
        rim=CENTRE_AND_RIM,
        threshold=table.thresholds,
        error=table.error_power,
        frequencies=table.frequencies,
    )
    return found


_kept: WeakKeyDictionary["LocalizationTable", tuple[Rules, dict[int, tuple[Drawn, Drawn]]]] = (
    WeakKeyDictionary()
)
