"""Pack a question for the C kernel, and read its tones.

The numpy reference has the same question and result (`model.answer.question`).
"""

from array import array
from collections.abc import Iterable
from ctypes import addressof
from dataclasses import dataclass
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from model import phased_weights
from model.answer.fingers_on_plate import (
    CENTER_AND_RIM,
    MAX_FINGERS_BY_POINT,
    MAX_VARIANCE_FINE,
)
from model.answer.question import (
    KEPT,
    MISSING,
    PROMISED_PERCENTILE,
    PRUNING_STEP,
    REACHED,
    Contents,
    Tones,
)
from model.arrays import Complex64Array, Float32Array
from model.compiled.kernels import (
    FOUND,
    FoundTones,
    GivenQuestion,
    GivenRaster,
    Kernels,
    PlateDraws,
    Rules,
    TouchedPlates,
    WeightSearch,
    run_kernel,
)
from model.drive_forms import LEVEL_MARGIN
from model.drive_modes import UNRESTRICTED
from model.ensemble.draws import JUDGING_DRAWS, PERCENTILE, PROMISED_DRAWS
from model.ensemble.expected_power import RIDGE
from model.ensemble.kernel_plates import draws_structure, plates_structure
from model.table.fingertip_shapes import given_raster
from model.table.table import LocalizationTable

_T = TypeVar("_T")

_SIZE = 4  # bytes of an integer or a number in single precision


@dataclass(frozen=True, eq=False)
class _FingerLoads:
    """Loads of k fingers at f frequencies."""

    stiffness: Complex64Array
    """Dynamic stiffness (f, k) [N/m]."""
    harmonic_stiffness: Complex64Array
    """The same at twice the frequencies; the same array without harmonics."""
    load_std: Float32Array
    """Standard deviation (k,) of the logarithm of the loads."""

    @classmethod
    def of(
        cls, table: LocalizationTable, finger_count: int, loads: tuple[float, ...] = ()
    ) -> "_FingerLoads":
        """Compute the loads of a number of fingers, relative to the rig's; empty for 1 each."""
        stiffness = table.attached.finger_stiffness(finger_count, loads)
        harmonic_stiffness = stiffness
        if table.uncertainty.harmonic:
            harmonic_stiffness = table.at_harmonics.plate.finger_stiffness(finger_count, loads)
        return cls(stiffness, harmonic_stiffness, table.attached.load_stds(finger_count, loads))


@dataclass(frozen=True, eq=False)
class _Fingers:
    """Data that depends only on the number of fingers."""

    judging: PlateDraws
    """Draws on which candidates are evaluated."""
    promise: PlateDraws
    """Draws of the promise."""
    equal_loads: _FingerLoads
    """Fingers of load 1."""

    @classmethod
    def of(cls, table: LocalizationTable, finger_count: int) -> "_Fingers":
        """Draw the plates of a table with a number of fingers."""
        on_eras = table.on_eras
        return cls(
            draws_structure(on_eras, table.clocks, finger_count, JUDGING_DRAWS),
            draws_structure(on_eras, table.clocks, finger_count, PROMISED_DRAWS),
            _FingerLoads.of(table, finger_count),
        )


@dataclass(frozen=True, eq=False)
class _PackedTable:
    """A table as the kernel reads it; kept with the table."""

    plates: TouchedPlates
    raster: GivenRaster
    rules: Rules
    fingers: dict[int, _Fingers]
    """By number of fingers."""

    @classmethod
    def of(cls, table: LocalizationTable) -> "_PackedTable":
        """Pack a table's plate and raster, and the rules of the search."""
        plates = plates_structure(table.on_eras)
        return cls(plates, given_raster(table), _packed_rules(table), {})


_packed_tables: WeakKeyDictionary[LocalizationTable, _PackedTable] = WeakKeyDictionary()


def is_for_kernel(contents: Contents) -> bool:
    """Whether the kernel supports a question."""
    if contents.drive_mode != UNRESTRICTED or contents.avoided:
        return False
    return all(stream.duration is None for stream in contents.streams)


def ask_kernel(library: Kernels, table: LocalizationTable, contents: Contents) -> Tones:
    """Choose tones for each content and compute their promises."""
    streams = contents.streams
    places = contents.places
    finger_count = len(places)
    era_count = len(table.eras)
    packed = _packed_tables.get(table)
    if packed is None:
        packed = _packed_tables.setdefault(table, _PackedTable.of(table))
    fingers = packed.fingers.get(finger_count)
    if fingers is None:
        fingers = packed.fingers.setdefault(finger_count, _Fingers.of(table, finger_count))
    loads = fingers.equal_loads
    if contents.loads.count(1.0) < len(contents.loads):
        loads = _FingerLoads.of(table, finger_count, contents.loads)

    # The arrays live until the kernel has returned. Arrays of the standard library are faster to
    # build and to read here than numpy's.
    numbers = _packed_numbers(contents)
    levels = array("f", [10 ** (stream.level_db_sl / 20) for stream in streams])
    coordinates = array("d", [coordinate for place in places for coordinate in place])
    background = contents.background
    question = GivenQuestion(
        contents=len(streams),
        bands=len(streams[0].bands),
        fingers=finger_count,
        quiet_count=len(contents.quiet),
        candidates=contents.candidates,
        combinations=contents.combinations,
        apart=contents.apart_hz,
        numbers=numbers.buffer_info()[0],
        level=levels.buffer_info()[0],
        places=coordinates.buffer_info()[0],
        stiffness=loads.stiffness.ctypes.data,
        at_harmonics=loads.harmonic_stiffness.ctypes.data,
        load_std=loads.load_std.ctypes.data,
        background=None if background is None else background.ctypes.data,
        judging=addressof(fingers.judging),
        promise=addressof(fingers.promise),
    )
    set_count = packed.rules.sets
    figure_count = (2 * era_count + 1) * len(streams) + (3 + 2 + set_count) * finger_count + 2
    rows = array("i", bytes(_SIZE * len(streams)))
    figures = array("f", bytes(_SIZE * figure_count))
    result = FoundTones(0, rows.buffer_info()[0], figures.buffer_info()[0])
    status = run_kernel(
        library.library.answer, result, packed.plates, packed.raster, packed.rules, question
    )
    if status != FOUND:
        raise AssertionError("contents must have tones")
    return _read_tones(
        rows.tolist(),
        figures.tolist(),
        era_count=era_count,
        finger_count=finger_count,
        set_count=set_count,
        is_apart=bool(result.is_apart),
    )


def _packed_numbers(contents: Contents) -> "array[int]":
    """Return the integers of a question: starts of targets, targets, quiet fingers, priorities,
    bands."""
    starts = [0]
    targets = list[int]()
    bands = list[int]()
    for stream in contents.streams:
        targets += stream.targets
        starts.append(len(targets))
        for band in stream.bands:
            bands += band
    priorities = [stream.priority for stream in contents.streams]
    return array("i", [*starts, *targets, *contents.quiet, *priorities, *bands])


def _read_tones(
    rows: list[int],
    figures: list[float],
    *,
    era_count: int,
    finger_count: int,
    set_count: int,
    is_apart: bool,
) -> Tones:
    """Return the tones of rows and figures, which are in the order of `found` in C."""
    content_count = len(rows)
    gains_start = 2 * era_count * content_count
    contrast_start = gains_start + content_count
    level_start = contrast_start + 3 * finger_count
    foreign_start = level_start + 2 * finger_count
    worst_db, stroke_factor = figures[-2:]
    weights = map(complex, figures[:gains_start:2], figures[1:gains_start:2])
    return Tones(
        rows=rows,
        weights=_grouped(weights, era_count),
        gains=figures[gains_start:contrast_start],
        owners=range(content_count),
        contrast_db=_grouped(figures[contrast_start:level_start], 3),
        level_db_sl=_grouped(figures[level_start:foreign_start], 2),
        foreign_db_sl=_grouped(figures[foreign_start:-2], set_count),
        worst_db=worst_db,
        stroke_factor=stroke_factor,
        is_apart=is_apart,
    )


def _grouped(values: Iterable[_T], size: int) -> list[tuple[_T, ...]]:
    """Return values in groups of a size."""
    iterator = iter(values)
    return list(zip(*[iterator] * size, strict=True))


def _packed_rules(table: LocalizationTable) -> Rules:
    """Pack the rules for choosing tones, and the table's figures."""
    uncertainty = table.uncertainty
    groups = table.clocks.groups
    gain_variance = uncertainty.gain_variance(len(table.eras))
    rules = Rules(
        kept=KEPT,
        missing=MISSING,
        max_by_point=MAX_FINGERS_BY_POINT,
        pruning_step=PRUNING_STEP,
        rim_count=len(CENTER_AND_RIM),
        is_deep=gain_variance < MAX_VARIANCE_FINE,
        others=uncertainty.changes_modes,
        gain_variance=gain_variance,
        touch_offset=uncertainty.touch_offset,
        ridge=RIDGE,
        margin=LEVEL_MARGIN,
        highest=phased_weights.NEARLY_HIGHEST,
        reached=REACHED,
        judged=PERCENTILE,
        promised=PROMISED_PERCENTILE,
        starts=phased_weights.TARGET_STARTS,
        iterations=phased_weights.ALIGNMENTS,
        again=phased_weights.REALIGNMENTS,
        one_finger=_packed_method(phased_weights.ONE_FINGER),
        several=_packed_method(phased_weights.SEVERAL),
        within=(WeightSearch * 3)(*map(_packed_method, phased_weights.WITHIN_STROKE)),
        groups=1 + max(groups, default=0),
        sets=len(table.threshold_sets),
    )
    rules.point(
        rim=CENTER_AND_RIM,
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
    return rules


def _packed_method(method: phased_weights.LawsonMethod) -> WeightSearch:
    """Pack the parameters of the search for weights."""
    return WeightSearch(
        steps=method.steps,
        limited=method.is_limited,
        variance=method.variance,
        gain=method.gain,
        reserve=phased_weights.LEVEL_RESERVE,
        growth=phased_weights.MAX_GROWTH,
        most=phased_weights.MAX_MULTIPLIER,
    )
