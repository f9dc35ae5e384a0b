"""`model.ensemble.touched_plate` by kernels in C."""

import ctypes
from collections.abc import Callable
from ctypes import c_float, c_int, c_size_t, c_void_p
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array, IntArray
from model.compiled.kernels import Kernels, kernels
from model.compiled.lanes import as_given, work_space
from model.ensemble.draws import Draws
from model.ensemble.plate_on_eras import PlateOnEras
from model.ensemble.touched_plate import RIDGE, Changes, LoadedContacts, Sensed, TouchedPlate

_MAX_LANES = 16
_OF_CASES = ("receptance", "by_force", "coupling", "moved")
_OF_ROWS = ("minus_omega2", "forces", "strokes", "by_damping", "by_stiffness")


def touch(on: PlateOnEras, centres: Float32Array, loads: tuple[float, ...] = ()) -> TouchedPlate:
    """Put fingers on a plate, by kernels in C where they can be compiled.

    centres (k, r): shapes there; loads (k,): of each relative to the rig's fingertip, empty for 1.
    """
    by, stiffness = kernels(), on.plate.finger_stiffness(len(centres), loads)
    if by is None or not len(centres):
        return TouchedPlate(on, centres, stiffness)
    return TouchedByKernel(on, as_given(centres), stiffness, by)


class _Plates(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in ("n", "b", "k", "r", "t")),
        ("load_std", c_float),
        *((name, c_void_p) for name in (*_OF_CASES, *_OF_ROWS, "centres", "stiffness")),
    )
    kept: list[NDArray[Any]]  # to which it points


class _Forms(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in ("groups", "p", "fine", "others")),
        *((name, c_float) for name in ("gain_variance", "ridge")),
        *((name, c_void_p) for name in ("points", "fine_points", "weights", "error")),
        *((name, c_void_p) for name in ("fields", "fine_fields", "power", "uncertain")),
    )


class _Drawn(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in ("points", "k", "a", "tones")),
        *((name, c_int) for name in ("bases", "draws", "nodes", "width")),
        *((name, c_void_p) for name in ("sources", "by_force", "by_loss")),
        *((name, c_void_p) for name in ("loss", "damping", "own", "drives", "at_nodes", "node")),
        *((name, c_void_p) for name in ("draw_loss", "draw_damping", "draw_own", "draw_gain")),
        *((name, c_void_p) for name in ("draw_error", "error", "threshold", "weights")),
        *((name, c_void_p) for name in ("powers", "means", "loudest")),
    )


@dataclass(frozen=True, eq=False)
class TouchedByKernel(TouchedPlate):
    """A plate with fingers, all of whose arrays are as kernels read them."""

    kernels: Kernels

    def fields(
        self, rows: IntArray, nodes: IntArray, weights: Complex64Array, points: Float32Array
    ) -> Complex64Array:
        """As of `TouchedPlate`."""
        found = np.empty((len(rows), len(points)), dtype=np.complex64)
        self._run("touched_fields", rows, nodes, points, as_given(weights), found)
        return found

    def forms(
        self,
        rows: IntArray,
        points: Float32Array,
        weights: Float32Array,
        error_power: Float32Array,
        fine: Float32Array | None = None,
    ) -> LoadedContacts:
        """As of `TouchedPlate`."""
        plate, n, f, (g, p, _) = self.on.plate, self.on.plate.era_count, len(rows), points.shape
        fine_count = 0 if fine is None else fine.shape[1]
        given = [
            as_given(each)
            for each in (points, points if fine is None else fine, weights, error_power)
        ]
        sizes = ((f, g, p, n), (f, g, fine_count, n), (f, g, n, n), (f, g, n, n))
        found = [np.empty(size, dtype=np.complex64) for size in sizes]
        of = _Forms(
            *(g, p, g * fine_count, plate.thickness > 0, plate.gain_variance, RIDGE),
            *(each.ctypes.data for each in (*given, *found)),
        )
        library, on = self.kernels.library, ctypes.byref(self._plates)
        work = _work(self.kernels, library.contact_forms_space, on, ctypes.byref(of))
        at = as_indices(rows)
        for first in range(0, f, self.kernels.lanes):
            count = min(self.kernels.lanes, f - first)
            library.contact_forms(on, ctypes.byref(of), first, count, _at(at), work)
        return LoadedContacts(found[0], None if fine is None else found[1], found[2], found[3])

    def felt(
        self,
        draws: Draws,
        by_force: Complex64Array,
        sources: IntArray,
        changes: Changes,
        at_nodes: Complex64Array,
        error: Float32Array,
        threshold: Float32Array,
        weights: Float32Array,
        *,
        with_powers: bool,
    ) -> Sensed:
        """As of `TouchedPlate`."""
        (m, bases), (k, p), count = sources.shape, weights.shape, len(draws.node)
        parts = (changes.loss, changes.damping, changes.own, changes.drives, at_nodes)
        arrays = [as_indices(sources), *map(as_given, (by_force, changes.by_loss, *parts))]
        arrays += [*_padded(draws), *map(as_given, (error, threshold, weights))]
        powers = np.empty((m, k * p, 1 + count) if with_powers else 0, dtype=np.float32)
        means, loudest = (np.empty((m, k, 1 + count), dtype=np.float32) for _ in range(2))
        on = _Drawn(
            *(k * p, k, by_force.shape[2], m),
            *(bases, count, at_nodes.shape[1] - 1, count + _MAX_LANES),
            *(each.ctypes.data for each in arrays),
            powers.ctypes.data if with_powers else None,
            *(means.ctypes.data, loudest.ctypes.data),
        )
        library = self.kernels.library
        work = _work(self.kernels, library.drawn_space, ctypes.byref(on))
        library.drawn_plates(ctypes.byref(on), work)
        return Sensed(means, loudest, powers if with_powers else None)

    @cached_property
    def _plates(self) -> _Plates:
        on, plate = self.on, self.on.plate
        n, k, r = plate.era_count, len(self.centres), self.centres.shape[1]
        arrays = [getattr(on, name) for name in _OF_CASES]
        arrays += [getattr(plate, name) for name in _OF_ROWS]
        kept = [as_given(each) for each in (*arrays, self.centres, self.stiffness)]
        plates = _Plates(
            *(n, plate.stiffness.shape[1], k, r, on.thickness_count, plate.load_std),
            *(each.ctypes.data for each in kept),
        )
        plates.kept = kept
        return plates

    def _run(
        self,
        name: str,
        rows: IntArray,
        nodes: IntArray,
        points: Float32Array,
        *arrays: Complex64Array,
    ) -> None:
        """Run a kernel of cases."""
        library, on, lanes = self.kernels.library, ctypes.byref(self._plates), self.kernels.lanes
        indices, given, count = (as_indices(rows), as_indices(nodes)), as_given(points), len(rows)
        work = _work(self.kernels, library[f"{name}_space"], on, c_size_t(len(given)))
        kernel = library[name]
        cases, rest = [_at(each) for each in indices], [_at(each) for each in arrays]
        for first in range(0, count, lanes):
            some = min(lanes, count - first)
            kernel(on, first, some, *cases, len(given), _at(given), work, *rest)


def as_indices(values: IntArray) -> NDArray[np.int32]:
    """Indices as a kernel reads them."""
    return np.ascontiguousarray(values, dtype=np.int32)


def _work(by: Kernels, space: Callable[..., Any], *sizes: object) -> c_void_p:
    """Work space of as many values as a kernel says."""
    space.restype = c_size_t  # type: ignore[attr-defined]
    return work_space(by, space(*sizes))


def _at(array: NDArray[Any]) -> c_void_p:
    return c_void_p(array.ctypes.data)


@lru_cache(maxsize=64)
def _padded(draws: Draws) -> tuple[NDArray[Any], ...]:
    """Arrays of drawn plates by their names in `drawn.c`, rows longer by the widest vector."""

    def padded(values: Float32Array) -> Float32Array:
        return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, _MAX_LANES)])

    parts = [np.stack([each.real, each.imag]) for each in (draws.gains, draws.errors)]
    floats = [padded(each) for each in (draws.loss, draws.damping, draws.own, *parts)]
    return as_indices(draws.node), *floats
