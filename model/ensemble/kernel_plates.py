"""Touched plates computed by C kernels, and the arrays that the kernels read.

`touch` puts fingers on a plate, with kernels if they can be used and in numpy otherwise.
"""

import ctypes
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from weakref import WeakKeyDictionary

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.compiled.kernels import (
    Kernels,
    PlateDraws,
    PointGroups,
    Sensors,
    TouchedPlates,
    as_given,
    kernels,
    run_kernel,
)
from model.ensemble.attached_plate import THINNER, PlateOnEras
from model.ensemble.draws import EXACT_CLOCKS, ClockErrors, Drawing
from model.ensemble.expected_power import RIDGE
from model.ensemble.touched_plate import (
    DrawnPlates,
    FingertipAmplitudes,
    LoadedContacts,
    TouchedPlate,
)
from model.finger import FINE_POINTS

_MAX_LANES = 16  # single-precision numbers in the widest register
_ARRAYS_OF_CASES = ("receptance", "by_force", "coupling", "moved", "by_loss")
_ARRAYS_OF_ROWS = ("minus_omega2", "forces", "strokes", "by_damping", "by_stiffness", "shapes")


@dataclass(frozen=True, eq=False)
class TouchedByKernel(TouchedPlate):
    """A plate with fingers, computed by kernels in C."""

    kernels: Kernels = field(kw_only=True)

    @cached_property
    def structure(self) -> TouchedPlates:
        """The plate as kernels read it."""
        structure = TouchedPlates.from_buffer_copy(plates_structure(self.plate_on_eras))
        structure.k = len(self.centers)
        structure.point(centers=self.centers, stiffness=self.stiffness, load_std=self.load_std)
        return structure

    def forms(
        self,
        rows: IntArray,
        points: Float32Array,
        weights: Float32Array,
        error_power: Float32Array,
        fine: Float32Array | None = None,
        touch_steps: Float32Array | None = None,
    ) -> LoadedContacts:
        """As `TouchedPlate.forms`."""
        plate = self.plate_on_eras.plate
        era_count = plate.era_count
        group_count, point_count, _ = points.shape
        fine_count = 0 if fine is None else fine.shape[1]
        groups = PointGroups(
            groups=group_count,
            p=point_count,
            fine=group_count * fine_count,
            others=plate.uncertainty.changes_modes,
            gain_variance=plate.uncertainty.gain_variance(era_count),
            ridge=RIDGE,
        )
        groups.point(
            points=points,
            fine_points=fine,
            weights=weights,
            error=error_power,
            shares=self.clocks.power_shares(plate.frequencies),
            touch_steps=touch_steps,
        )
        by_group = (len(rows), group_count)
        fields = np.empty((*by_group, point_count, era_count), dtype=np.complex64)
        fine_fields = np.empty((*by_group, fine_count, era_count), dtype=np.complex64)
        power = np.empty((*by_group, era_count, era_count), dtype=np.complex64)
        uncertain = np.empty_like(power)
        results = _addresses(fields, fine_fields, power, uncertain)
        row_numbers = as_given(rows)
        stage = self.kernels.library.forms_stage
        run_kernel(stage, self.structure, groups, row_numbers.ctypes, len(rows), results)
        return LoadedContacts(fields, None if fine is None else fine_fields, power, uncertain)

    def drawn(
        self,
        drawing: Drawing,
        rows: IntArray,
        weights: Complex64Array,
        points: Float32Array,
        shares: Float32Array,
        error_power: Float32Array,
        threshold: Float32Array,
        *,
        touch_steps: Float32Array | None = None,
        with_powers: bool = False,
    ) -> FingertipAmplitudes:
        """As `TouchedPlate.drawn`."""
        tone_count = len(rows)
        finger_count, point_count = shares.shape
        plate_count = 1 + drawing.count
        sensors = Sensors(finger_count * point_count)
        sensors.point(
            rows=points,
            weights=shares,
            error=error_power,
            threshold=threshold,
            touch_steps=touch_steps,
            disc=FINE_POINTS.points,
        )
        means = np.empty((tone_count, finger_count, plate_count), dtype=np.float32)
        loudest = np.empty_like(means)
        powers = None
        if with_powers:
            by_point = (tone_count, finger_count * point_count, plate_count)
            powers = np.empty(by_point, dtype=np.float32)
        results = _addresses(powers, means, loudest)
        draws = draws_structure(self.plate_on_eras, self.clocks, finger_count, drawing)
        row_numbers = as_given(rows)
        era_weights = as_given(weights)
        stage = self.kernels.library.tones_stage
        run_kernel(
            stage,
            self.structure,
            draws,
            sensors,
            row_numbers.ctypes,
            tone_count,
            era_weights.ctypes,
            results,
        )
        return FingertipAmplitudes(means, loudest, powers)


def touch(
    plate_on_eras: PlateOnEras,
    centers: Float32Array,
    loads: tuple[float, ...] = (),
    clocks: ClockErrors = EXACT_CLOCKS,
) -> TouchedPlate:
    """Put fingers on a plate, using C kernels if they can be compiled.

    centers (k, r): shapes there; loads (k,): relative to the rig's fingertip, empty for 1 each;
    clocks: errors of the amplifiers' clocks.
    """
    library = kernels()
    plate = plate_on_eras.plate
    finger_count = len(centers)
    stiffness = plate.finger_stiffness(finger_count, loads)
    load_std = plate.load_stds(finger_count, loads)
    if library is None or not finger_count:
        return TouchedPlate(plate_on_eras, centers, stiffness, load_std, clocks)
    return TouchedByKernel(plate_on_eras, centers, stiffness, load_std, clocks, kernels=library)


def plates_structure(plate_on_eras: PlateOnEras) -> TouchedPlates:
    """Pack a plate without fingers for kernels; kept with it."""
    packed = _packed_plates.get(plate_on_eras)
    if packed is not None:
        return packed
    plate = plate_on_eras.plate
    mount_count, coordinate_count = plate.shapes.shape
    row_count, thickness_count, _ = plate_on_eras.receptance.shape
    searched_count = min(thickness_count, THINNER + 1)  # thicknesses that searches rank by
    structure = TouchedPlates(
        n=plate.era_count,
        b=mount_count,
        r=coordinate_count,
        t=thickness_count,
        off=plate.by_stiffness.shape[1],
        rows=row_count,
        kept=searched_count,
    )
    of_cases = {name: getattr(plate_on_eras, name) for name in _ARRAYS_OF_CASES}
    of_rows = {name: getattr(plate, name) for name in _ARRAYS_OF_ROWS}
    structure.point(**of_cases, **of_rows, attached=plate.stiffness)
    library = kernels()
    if library is not None:
        structure.lanes = library.lanes
        number_count = 2 * (row_count + library.lanes) * searched_count
        number_count *= mount_count * coordinate_count
        blocks = np.empty(number_count + _MAX_LANES, dtype=np.float32)
        structure.arrays.append(blocks)
        unaligned = -blocks.ctypes.data % (4 * _MAX_LANES)
        structure.of_blocks = blocks.ctypes.data + unaligned  # whole registers
        run_kernel(library.library.blocks_stage, structure)
    return _packed_plates.setdefault(plate_on_eras, structure)  # one for concurrent threads


_packed_plates: WeakKeyDictionary[PlateOnEras, TouchedPlates] = WeakKeyDictionary()


def draws_structure(
    plate_on_eras: PlateOnEras, clocks: ClockErrors, finger_count: int, drawing: Drawing
) -> PlateDraws:
    """Pack drawn plates with a number of fingers for kernels."""
    exact: PlateDraws = _packed_draws(DrawnPlates.of(plate_on_eras, finger_count, drawing))
    if not clocks.errors:
        return exact
    structure = PlateDraws.from_buffer_copy(exact)
    structure.arrays = exact.arrays
    structure.amplifiers = len(clocks.errors)
    delays = _padded(clocks.delays(drawing))
    structure.point(delays=delays, amplifier=np.array(clocks.amplifier))
    return structure


@lru_cache(maxsize=64)
def _packed_draws(plates: DrawnPlates) -> PlateDraws:
    """Pack drawn plates whose amplifiers have exact clocks."""
    draws = plates.draws
    plate_count = len(draws.node)
    structure = PlateDraws(
        count=plate_count,
        bases=plates.base_count,
        nodes=plates.thickness_count,
        width=plate_count + _MAX_LANES,
        first_base=plates.first_base,
        first_node=plates.first_thickness,
    )
    structure.point(
        node=draws.node,
        loss=_padded(draws.loss),
        damping=_padded(draws.damping),
        own=_padded(draws.own),
        gains=_padded_parts(draws.gains),
        errors=_padded_parts(draws.errors),
        harmonics=_padded_parts(draws.harmonics),
        touches=_padded(draws.touches),
    )
    return structure


def _padded_parts(values: Complex64Array) -> Float32Array:
    """Return real and imaginary parts (2, ..., d) of values, padded by one register."""
    return _padded(np.stack([values.real, values.imag]))


def _padded(values: Float32Array | FloatArray) -> Float32Array:
    """Return values (..., d) in single precision, padded by one register."""
    padding = [(0, 0)] * (values.ndim - 1)
    return np.pad(as_given(values), [*padding, (0, _MAX_LANES)])


def _addresses(*arrays: np.ndarray | None) -> ctypes.Array[ctypes.c_void_p]:
    """Return the addresses of arrays, null for None."""
    addresses = [None if array is None else array.ctypes.data for array in arrays]
    return (ctypes.c_void_p * len(arrays))(*addresses)
