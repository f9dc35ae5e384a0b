"""Tones of contents by one call of a kernel in C, or in numpy where there is no compiler."""

from ctypes import addressof
from itertools import chain
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from model.compiled.kernels import run
from model.compiled.structures import FOUND, FoundTones, GivenQuestion, Method, Rules
from model.drive_modes.coherent import ONE_FINGER, SEVERAL, WITHIN_STROKE
from model.drive_modes.forms import LEVEL_MARGIN
from model.drive_modes.phased import MAX_TARGETS, PHASED
from model.drive_modes.phased_kernel import given as as_method
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
    target_count = max(len(stream.targets) for stream in contents.streams)
    if not isinstance(touched, TouchedByKernel) or target_count > MAX_TARGETS:
        return choose_by_numpy(table, contents)
    count, n, k = len(contents.streams), len(table.eras), len(touched.centres)
    given = _question(contents)
    # Kept here until the kernel has ended: another thread may take their place in the cache.
    drawn = [draws_structure(table.on_eras, k, by) for by in (JUDGING_DRAWS, PROMISED_DRAWS)]
    given.judging, given.promise = map(addressof, drawn)
    rows = np.empty(count, dtype=np.int32)
    found = np.empty(count * (2 * n + 1) + 6 * k + 3, dtype=np.float32)
    sizes = np.cumsum([2 * n * count, count, 3 * k, 2 * k, k]) * 4
    at = found.ctypes.data
    to = FoundTones(0, 0, rows.ctypes.data, at, *(at + each for each in sizes.tolist()))
    rules = _rules(table)
    kernel = touched.kernels.library.answer
    status = run(kernel, to, touched.structure, rules, given)
    if status == _NEEDS_ONSETS:
        onsets = table.onsets
        given.with_onset = onsets is not None
        if onsets is not None:
            rules.point(onsets=onsets.parts)
        status = run(kernel, to, touched.structure, rules, given)
    if status != FOUND:
        return None
    weights, *figures = np.split(found, sizes // 4)
    gains, contrast, level, foreign_amplitudes, (worst, factor, loudest) = (
        e.astype(float) for e in figures
    )
    return Tones(
        rows.astype(int),
        weights.view(np.complex64).reshape(count, n),
        gains,
        contrast.reshape(k, 3),
        level.reshape(k, 2),
        foreign_amplitudes,
        float(worst),
        float(factor),
        float(loudest),
        bool(to.is_apart),
    )


def _question(contents: Contents) -> GivenQuestion:
    """Contents as kernels read them."""
    tips, streams, rows = contents.tips, contents.streams, contents.rows
    whole: dict[str, list[int]] = {"row": rows.tolist(), "quiet": [*contents.quiet]}
    whole |= {"starts": [0], "targets": [], "band": []}
    for stream in streams:
        whole["targets"] += stream.targets
        whole["starts"].append(len(whole["targets"]))
        whole["band"] += chain.from_iterable(stream.bands)
    whole["priority"] = [stream.priority for stream in streams]
    given = GivenQuestion(
        *(len(streams), len(streams[0].bands), len(rows), len(contents.quiet)),
        *(tips.few.shape[1], tips.fine.shape[1], contents.is_ranked, contents.is_strict),
        *(contents.with_onset, contents.apart_hz),
    )
    given.point(
        row=np.array([*chain.from_iterable(whole.values())]),
        level=contents.levels,
        few_points=tips.few,
        fine_points=tips.fine,
        few_weights=tips.few_weights,
        fine_weights=tips.fine_weights,
        background=contents.background,
    )
    at = given.row
    for name, values in whole.items():
        setattr(given, name, at)
        at += 4 * len(values)
    return given


def _rules(table: "LocalizationTable") -> Rules:
    """How tones are chosen on a table, kept with it."""
    found = _kept.get(table)
    if found is None:
        plate = table.attached
        found = Rules(
            *(KEPT, MISSING, MAX_FINGERS_BY_POINT, MIN_CANDIDATES, MAX_COMBINATIONS, PRUNING_STEP),
            *(len(CENTRE_AND_RIM), plate.gain_variance < MAX_VARIANCE_FINE, plate.thickness > 0),
            *(TIME_COUNT, plate.gain_variance, RIDGE, LEVEL_MARGIN, NEARLY_HIGHEST, REACHED),
            *(10 ** (-ONSET_MARGIN_DB / 20), ONSET_WEIGHT, PERCENTILE, PROMISED_PERCENTILE),
            *(PHASED.phases[1], PHASED.iterations, as_method(ONE_FINGER), as_method(SEVERAL)),
            (Method * 3)(*map(as_method, WITHIN_STROKE)),
        )
        found.point(
            rim=CENTRE_AND_RIM,
            threshold=table.thresholds,
            error=table.error_power,
            frequencies=table.frequencies,
        )
        _kept[table] = found
    return found


_kept: WeakKeyDictionary["LocalizationTable", Rules] = WeakKeyDictionary()
