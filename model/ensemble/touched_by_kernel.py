"""`model.ensemble.touched_plate` by kernels in C."""

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
    run,
)
from model.ensemble.attached_plate import THINNER, PlateOnEras
from model.ensemble.delays import EXACT_CLOCKS, ClockErrors
from model.ensemble.draws import Drawing, Draws
from model.ensemble.touched_plate import (
    RIDGE,
    FingertipAmplitudes,
    LoadedContacts,
    TouchedPlate,
    drawn_on,
)

_MAX_LANES = 16
_OF_CASES = ("receptance", "by_force", "coupling", "moved", "by_loss")
_OF_ROWS = ("minus_omega2", "forces", "strokes", "by_damping", "by_stiffness", "shapes")


def touch(
    on: PlateOnEras,
    centres: Float32Array,
    loads: tuple[float, ...] = (),
    clocks: ClockErrors = EXACT_CLOCKS,
) -> TouchedPlate:
    """Put fingers on a plate, by kernels in C where they can be compiled.

    centres (k, r): shapes there; loads (k,): of each relative to the rig's fingertip, empty for 1;
    clocks: errors of those of the amplifiers.
    """
    by, stiffness = kernels(), on.plate.finger_stiffness(len(centres), loads)
    if by is None or not len(centres):
        return TouchedPlate(on, centres, stiffness, clocks)
    return TouchedByKernel(on, centres, stiffness, clocks, kernels=by)


@dataclass(frozen=True, eq=False)
class TouchedByKernel(TouchedPlate):
    """A plate with fingers, whose stages are kernels."""

    kernels: Kernels = field(kw_only=True)

    @cached_property
    def structure(self) -> TouchedPlates:
        """The plate as kernels read it."""
        found = TouchedPlates.from_buffer_copy(plates_structure(self.on))
        found.k = len(self.centres)
        found.point(centres=self.centres, stiffness=self.stiffness)
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
        known = plate.uncertainty
        rules = known.frequency > 0, known.gain_variance, RIDGE
        of = PointGroups(g, p, g * fine_count, *rules)
        of.point(
            points=points,
            fine_points=fine,
            weights=weights,
            error=error_power,
            shares=self.clocks.power_shares(plate.frequencies),
        )
        sizes = ((f, g, p, n), (f, g, fine_count, n), (f, g, n, n), (f, g, n, n))
        found = [np.empty(size, dtype=np.complex64) for size in sizes]
        to, at = (ctypes.c_void_p * 4)(*(each.ctypes.data for each in found)), as_given(rows)
        run(self.kernels.library.forms_stage, self.structure, of, at.ctypes, f, to)
        return LoadedContacts(found[0], None if fine is None else found[1], found[2], found[3])

    def drawn(
        self,
        by: Drawing,
        rows: IntArray,
        weights: Complex64Array,
        points: Float32Array,
        shares: Float32Array,
        error_power: Float32Array,
        threshold: Float32Array,
        *,
        with_powers: bool = False,
    ) -> FingertipAmplitudes:
        """As of `TouchedPlate`."""
        m, (k, p) = len(rows), shares.shape
        at = Sensors(k * p)
        at.point(rows=points, weights=shares, error=error_power, threshold=threshold)
        powers = np.empty((m, k * p, 1 + by.count) if with_powers else 0, dtype=np.float32)
        means, loudest = (np.empty((m, k, 1 + by.count), dtype=np.float32) for _ in range(2))
        given = as_given(rows), as_given(weights)
        to = (ctypes.c_void_p * 3)(
            powers.ctypes.data if with_powers else None, means.ctypes.data, loudest.ctypes.data
        )
        draws = draws_structure(self.on, self.clocks, k, by)
        run(
            self.kernels.library.tones_stage,
            *(self.structure, draws, at, given[0].ctypes, m, given[1].ctypes, to),
        )
        return FingertipAmplitudes(means, loudest, powers if with_powers else None)


def plates_structure(on: PlateOnEras) -> TouchedPlates:
    """A plate without fingers as kernels read it, kept with it."""
    known = _kept.get(on)
    if known is not None:
        return known
    plate = on.plate
    (b, r), (f, t, _) = plate.shapes.shape, on.receptance.shape
    kept = min(t, THINNER + 1)  # thicknesses that searches rank by
    n, off = plate.era_count, plate.by_stiffness.shape[1]
    found = TouchedPlates(n, b, 0, r, t, off, f, 0, kept, plate.uncertainty.fingertip)
    found.point(
        **{name: getattr(on, name) for name in _OF_CASES},
        **{name: getattr(plate, name) for name in _OF_ROWS},
        attached=plate.stiffness,
    )
    if (by := kernels()) is not None:
        found.lanes = by.lanes
        room = np.empty(2 * (f + by.lanes) * kept * b * r + _MAX_LANES, dtype=np.float32)
        found.arrays.append(room)
        found.of_blocks = room.ctypes.data + -room.ctypes.data % (4 * _MAX_LANES)  # whole registers
        run(by.library.blocks_stage, found)
    return _kept.setdefault(on, found)  # of threads at once all take the first one's


_kept: WeakKeyDictionary[PlateOnEras, TouchedPlates] = WeakKeyDictionary()


def draws_structure(
    on: PlateOnEras, clocks: ClockErrors, finger_count: int, by: Drawing
) -> PlateDraws:
    """Drawn plates with so many fingers as kernels read them; of other clocks in no time."""
    draws, nodes, (bases, first_base), first_node = drawn_on(on, finger_count, by)
    exact = _structure(draws, nodes, bases, first_base, first_node)
    if not clocks.errors:
        return exact
    found = PlateDraws.from_buffer_copy(exact)
    found.arrays, found.amplifiers = exact.arrays, len(clocks.errors)
    found.point(delays=_padded(clocks.delays(by)), amplifier=np.array(clocks.amplifier))
    return found


@lru_cache(maxsize=64)
def _structure(
    draws: Draws, nodes: int, bases: int, first_base: int, first_node: int
) -> PlateDraws:
    count = len(draws.node)
    found = PlateDraws(count, bases, nodes, count + _MAX_LANES, first_base, first_node)
    errors = np.stack([draws.errors.real, draws.errors.imag])
    gains = np.stack([draws.gains.real, draws.gains.imag])
    floats = {"loss": draws.loss, "damping": draws.damping, "own": draws.own}
    harmonics = np.stack([draws.harmonics.real, draws.harmonics.imag])
    floats |= {"gains": gains, "errors": errors, "harmonics": harmonics}
    found.point(node=draws.node, **{name: _padded(each) for name, each in floats.items()})
    return found


def _padded(values: Float32Array | FloatArray) -> Float32Array:
    """Values (..., d) as rows of one register more, in single precision."""
    return np.pad(as_given(values), [(0, 0)] * (values.ndim - 1) + [(0, _MAX_LANES)])
