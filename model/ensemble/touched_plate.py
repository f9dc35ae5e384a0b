"""Fingers on plates with eliminated ERAs, and felt vibration on drawn plates, in numpy and in C.

k fingers of dynamic stiffness D at centres c change fields X of a plate on its ERAs to

    X - G D P X_c,  P = (1 + G_cc D)^-1,

where G is the displacement due to a force at each finger without the others. With the others, the
acceleration is -w² G P^T. Symbols are as in `attached_plate`; a case is a frequency and a
thickness. The expected power of weights w at a fingertip is w^H R w to first order,

    R = mean_p { h* h^T + dh* dh^T + dc* dc^T + sum_j |s_j t_pj|² r_j* r_j^T + sigma² diag |h|² },

with h the field of each ERA, t_pj the acceleration due to a force at attachment j, and r_j the
deformation of that attachment due to each ERA at full stroke. Each change d is for one standard
deviation; s_j is the standard deviation of the stiffness. The ERAs' damping c changes for all
together; the stiffness of each ERA and foot and the load of each finger j change on their own, as
do gains, by sigma. These are exact derivatives of the loaded plate, except for the local deflection
under a finger. The thickness counts by half the sum of dh* dh^T of the plates thicker and thinner
by one standard deviation, solved exactly; the modulus is included there (`attached_plate`). The
effect of the loss factor is negligible.

`TouchedPlate` is in numpy, `TouchedByKernel` the same in C; `touch` uses the faster one available.
"""

import ctypes
import math
from collections.abc import Sequence
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
from model.ensemble.attached_plate import MODELLED, THICKER, THINNER, PlateOnEras
from model.ensemble.draws import (
    EXACT_CLOCKS,
    ClockErrors,
    Drawing,
    Draws,
    delayed,
    draw,
    over_fingertips,
)

RIDGE = 1e-6
"""Share of a form's mean diagonal that is added to it, which keeps it definite."""

_MAX_LANES = 16
_OF_CASES = ("receptance", "by_force", "coupling", "moved", "by_loss")
_OF_ROWS = ("minus_omega2", "forces", "strokes", "by_damping", "by_stiffness", "shapes")


@dataclass(frozen=True, eq=False)
class LoadedContacts:
    """Fields and expected powers at g fingertips, or other groups of points, and f frequencies."""

    fields: Complex64Array
    """h (f, g, p, n) at points [m/s²]."""
    fine_fields: Complex64Array | None
    """h (f, g, fine, n) at fine points, None unless wanted."""
    power: Complex64Array
    """R (f, g, n, n)."""
    uncertain: Complex64Array
    """R without h* h^T (f, g, n, n)."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Forces at attachments `a` in c cases, per standard deviation of uncertain parameters."""

    loss: Complex64Array
    """By the loss factor (c, a)."""
    damping: Complex64Array
    """By all dampers (c, a)."""
    own: Complex64Array
    """By the attachment's own stiffness (c, a)."""
    drives: Complex64Array
    """Force of each ERA as it plays (c, a), which an error of its gain multiplies."""
    by_loss: Complex64Array
    """Additional acceleration (c, p) at points per standard deviation of the loss factor."""


@dataclass(frozen=True, eq=False)
class FingertipAmplitudes:
    """Amplitudes to threshold of m tones at k fingertips, nominal and on d drawn plates."""

    means: Float32Array
    """Mean amplitude over each fingertip (m, k, 1 + d)."""
    loudest: Float32Array
    """Squared amplitude at its loudest point (m, k, 1 + d)."""
    powers: Float32Array | None
    """Squared amplitude at all points (m, k p, 1 + d), None unless wanted."""


@dataclass(frozen=True, eq=False)
class TouchedPlate:
    """A plate of every thickness with k fingers on it."""

    on: PlateOnEras
    centres: Float32Array
    """Mode shapes (k, r) at the fingers."""
    stiffness: Complex64Array
    """Dynamic stiffness (f, k) of the fingers [N/m]."""
    load_std: Float32Array
    """Standard deviation (k,) of the logarithm of their loads."""
    clocks: ClockErrors = EXACT_CLOCKS
    """Errors of the amplifiers' clocks."""

    def sources(
        self, rows: IntArray, nodes: IntArray, points: Float32Array
    ) -> tuple[Complex64Array, Complex64Array]:
        """Return responses to forces and ERAs, in cases of rows (c,) and nodes (c,).

        Acceleration [m/s²/N] at points with shapes (p, r) for a force at each attachment and then
        each finger, (c, p, b + k); displacement of attachments and fingers for each ERA at full
        stroke [m], (c, b + k, n).
        """
        on, plate, n = self.on, self.on.plate, self.on.plate.era_count
        w2 = plate.minus_omega2[rows, None, None]
        at, G, P = self._fingers(rows, nodes)
        coordinates, resting = self._with_fingers(rows, on.by_force[rows, nodes], at, G, P)
        coordinates = np.concatenate([coordinates, w2 * (P @ G)], axis=1)
        fingers = resting[:, :, :n] * plate.forces[rows, None] / w2
        held = at.swapaxes(1, 2) @ (self.stiffness[rows, :, None] * fingers) / w2
        moved = np.concatenate([on.moved[rows, nodes] - held, fingers], axis=1)
        return points @ coordinates.swapaxes(1, 2), moved

    def fields(
        self, rows: IntArray, nodes: IntArray, weights: Complex64Array, points: Float32Array
    ) -> Complex64Array:
        """Accelerations (c, p) at points of shapes (p, r) by weights (c, n) of the ERAs."""
        forces = self.on.plate.forces[rows] * weights
        by_force = self.on.by_force[rows, nodes, : forces.shape[1]]
        driven = np.asarray(forces[:, None] @ by_force, dtype=np.complex64)
        _, G, P = self._fingers(rows, nodes)
        found, _ = self._with_fingers(rows, driven, self.centres @ driven.swapaxes(1, 2), G, P)
        return (points @ found.swapaxes(1, 2))[:, :, 0]

    def coordinates(self) -> Complex64Array:
        """Reduced coordinates by each ERA at full stroke at all frequencies, (f, n, r)."""
        driven, rows = self.on.fields, np.arange(len(self.stiffness))
        _, G, P = self._fingers(rows, np.full(len(rows), MODELLED))
        found, _ = self._with_fingers(rows, driven, self.centres @ driven.swapaxes(1, 2), G, P)
        return found

    def forms(
        self,
        rows: IntArray,
        points: Float32Array,
        weights: Float32Array,
        error_power: Float32Array,
        fine: Float32Array | None = None,
    ) -> LoadedContacts:
        """Compute fields and expected powers at frequencies, by row (f,).

        points (g, p, r), fine (g, fine, r): shapes at groups of points, as under each finger;
        weights (g, p): of a group's points, sum 1; error_power (all, n): mean square of the
        discretisation error of each ERA's field at all frequencies of the plate.
        """
        plate, n, f, (g, p, r) = self.on.plate, self.on.plate.era_count, len(rows), points.shape
        forces, every = plate.forces[rows, None], points.reshape(-1, r)
        modelled = np.full(f, MODELLED)
        by_force, moved = self.sources(rows, modelled, every)
        h = by_force[:, :, :n] * forces
        stretched = -moved
        stretched.reshape(f, -1)[:, : n * n : n + 1] += plate.strokes[rows]
        changes = [h, by_force[:, :, :n] @ (plate.by_damping[rows, :, None] * stretched[:, :n])]
        if plate.uncertainty.changes_modes:
            for node in (THICKER, THINNER):
                other, _ = self.sources(rows, np.full(f, node), every)
                changes.append((other[:, :, :n] * forces - h) * np.float32(math.sqrt(0.5)))
        a, k, s = moved.shape[1], len(self.centres), plate.by_stiffness.shape[1]
        uncertain = np.concatenate([np.arange(s), np.arange(a - k, a)])
        load = self.load_std * self.stiffness[rows]
        by_one = np.concatenate([plate.by_stiffness[rows], load], axis=1)
        deformed = stretched[:, uncertain] * by_one[:, :, None]
        reach = power_of(by_force[:, :, uncertain]).reshape(f, g, p, -1)
        own = np.sqrt(weights[:, None] @ reach).swapaxes(2, 3) * deformed[:, None]
        found, *changed = (each.reshape(f, g, p, n) for each in changes)
        power = expected_power(
            [found, *changed],
            own,
            weights,
            gain_variance=plate.uncertainty.gain_variance,
            error_power=error_power[rows, None],
            shares=self.clocks.power_shares(plate.frequencies[rows]),
        )
        uncertain = power - gram(found * np.sqrt(weights)[:, :, None])
        if fine is None:
            return LoadedContacts(found, None, power, uncertain)
        by_fine, _ = self.sources(rows, modelled, fine.reshape(-1, r))
        at_fine = (by_fine[:, :, :n] * forces).reshape(f, g, -1, n)
        return LoadedContacts(found, at_fine, power, uncertain)

    def changes(
        self,
        rows: IntArray,
        nodes: IntArray,
        weights: Complex64Array,
        moved: Complex64Array,
        points: Float32Array,
    ) -> Changes:
        """Compute changes of forces, for weights (c, n) and the resulting motion (c, b + k) [m]."""
        plate, n = self.on.plate, weights.shape[1]
        shapes = np.concatenate([plate.shapes, self.centres])
        stiffness = np.concatenate([plate.stiffness[rows], self.stiffness[rows]], axis=1)
        damping, own, drives = (np.zeros_like(moved) for _ in range(3))
        drives[:, :n] = plate.forces[rows] * weights
        stretched = -moved
        stretched[:, :n] += plate.strokes[rows] * weights
        damping[:, :n] = plate.by_damping[rows] * stretched[:, :n]
        b, s = plate.stiffness.shape[1], plate.by_stiffness.shape[1]
        own[:, :s] = plate.by_stiffness[rows] * stretched[:, :s]
        by_load = self.load_std * self.stiffness[rows]
        own[:, b:] = by_load * stretched[:, b:]
        held = np.asarray(drives - stiffness * moved, dtype=np.complex64)
        by_loss = self.on.by_loss[rows, nodes]
        lost = np.asarray(by_loss * (held @ shapes), dtype=np.complex64)
        at_points = plate.minus_omega2[rows, None] * (lost @ points.T)
        loss = -stiffness * (lost @ shapes.T)
        return Changes(loss, damping, own, drives, at_points)

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
        """Compute amplitudes on the nominal plate and on drawn ones, of tones at rows (m,).

        weights (m, n): of the ERAs; points (k p, r): shapes; shares (k, p): of the points in the
        mean over a fingertip. At all frequencies of the plate: error_power (f, n), mean square of
        the discretisation error of each ERA's field; threshold (f,) [m/s²].
        """
        m, (k, p), d, clocks = len(rows), shares.shape, by.count, self.clocks
        draws, nodes, (t, first_base), first = drawn_on(self.on, k, by)
        cases = np.array([MODELLED, *range(first, first + nodes)])
        at_nodes = self.fields(
            rows.repeat(1 + nodes), np.tile(cases, m), weights.repeat(1 + nodes, axis=0), points
        ).reshape(m, 1 + nodes, -1)
        bases = first_base + np.tile(np.arange(t), m)
        at, of_base = rows.repeat(t), weights.repeat(t, axis=0)
        gains = draws.gains
        if clocks.errors:
            gains = delayed(gains, clocks, by, self.on.plate.omega[at])
        by_force, moved = self.sources(at, bases, points)
        changes = self.changes(at, bases, of_base, np.matvec(moved, of_base), points)
        parts = [
            each[:, :, None] * numbers
            for each, numbers in (
                (changes.loss, draws.loss),
                (changes.damping, draws.damping),
                (changes.own, draws.own),
                (changes.drives, gains),
            )
        ]
        forces = np.add.reduce(parts).reshape(m, t, -1, t, d // t)
        by_loss = changes.by_loss.reshape(m, t, -1, 1) * draws.loss.reshape(t, 1, -1)
        own = np.arange(t)
        by_force = by_force.reshape(m, t, *by_force.shape[1:])
        changed = by_force @ forces[:, own, :, own].swapaxes(0, 1) + by_loss
        found = at_nodes[:, 1 + draws.node].swapaxes(1, 2)
        found = found + changed.swapaxes(1, 2).reshape(m, k * p, d)
        error = np.sqrt((error_power[rows] * power_of(weights)).sum(axis=1))
        found.reshape(m, k, p, d)[:] += (error[:, None, None] * draws.errors)[:, :, None]
        every = np.concatenate([at_nodes[:, 0, :, None], found], axis=2)
        powers = power_of(every) / (threshold[rows] ** 2)[:, None, None]
        return FingertipAmplitudes(
            *over_fingertips(powers, shares), powers if with_powers else None
        )

    def harmonics(
        self,
        by: Drawing,
        rows: IntArray,
        weights: Complex64Array,
        points: Float32Array,
        shares: Float32Array,
    ) -> Float32Array:
        """Mean square of second harmonics over k fingertips [m²/s⁴], (m, k, 1 + d).

        For a plate at twice the frequencies (`at_harmonics`). points (k, p, r): shapes; other
        arguments: see `drawn`. The nominal plate has none.
        """
        (k, p), d, n = shares.shape, by.count, self.on.plate.era_count
        draws, _, (t, first_base), _ = drawn_on(self.on, k, by)
        at, bases = rows.repeat(t), first_base + np.tile(np.arange(t), len(rows))
        by_force, _ = self.sources(at, bases, points.reshape(k * p, -1))
        driven = self.on.plate.forces[at] * weights.repeat(t, axis=0)
        fields = (by_force[:, :, :n] * driven[:, None]).reshape(len(rows), t, k * p, n)
        drawn = fields @ draws.harmonics.reshape(n, t, d // t).swapaxes(0, 1)
        power = power_of(drawn).swapaxes(1, 2).reshape(len(rows), k, p, d)
        found = (shares[:, None] @ power)[:, :, 0]
        return np.asarray(np.pad(found, ((0, 0), (0, 0), (1, 0))), dtype=np.float32)

    def _fingers(
        self, rows: IntArray, nodes: IntArray
    ) -> tuple[Complex64Array, Complex64Array, Complex64Array]:
        """Return T at the centres (c, k, b), G (c, k, r) and P (c, k, k)."""
        on, by_force = self.on, self.on.by_force[rows, nodes]
        at = self.centres @ by_force.swapaxes(1, 2)
        free = on.receptance[rows, nodes][:, None] * self.centres
        G = np.asarray(free + (at @ on.coupling[rows, nodes]) @ by_force, dtype=np.complex64)
        system = (self.centres @ G.swapaxes(1, 2)) * self.stiffness[rows, None]
        k = len(self.centres)
        system.reshape(len(rows), -1)[:, :: k + 1] += 1
        return at, G, np.asarray(np.linalg.inv(system))

    def _with_fingers(
        self,
        rows: IntArray,
        free: Complex64Array,
        at: Complex64Array,
        G: Complex64Array,
        P: Complex64Array,
    ) -> tuple[Complex64Array, Complex64Array]:
        """Return coordinates (c, q, r) with the fingers, and the field (c, k, q) at these.

        free (c, q, r): coordinates without fingers; at (c, k, q): their field at the fingers.
        """
        resting = np.asarray(P @ at)
        held = self.stiffness[rows, :, None] * resting
        return np.asarray(free - held.swapaxes(1, 2) @ G), resting


@dataclass(frozen=True, eq=False)
class TouchedByKernel(TouchedPlate):
    """A plate with fingers, computed by kernels in C."""

    kernels: Kernels = field(kw_only=True)

    @cached_property
    def structure(self) -> TouchedPlates:
        """The plate as kernels read it."""
        found = TouchedPlates.from_buffer_copy(plates_structure(self.on))
        found.k = len(self.centres)
        found.point(centres=self.centres, stiffness=self.stiffness, load_std=self.load_std)
        return found

    def forms(
        self,
        rows: IntArray,
        points: Float32Array,
        weights: Float32Array,
        error_power: Float32Array,
        fine: Float32Array | None = None,
    ) -> LoadedContacts:
        """As `TouchedPlate.forms`."""
        plate, n, f, (g, p, _) = self.on.plate, self.on.plate.era_count, len(rows), points.shape
        fine_count = 0 if fine is None else fine.shape[1]
        of = PointGroups(
            groups=g,
            p=p,
            fine=g * fine_count,
            others=plate.uncertainty.changes_modes,
            gain_variance=plate.uncertainty.gain_variance,
            ridge=RIDGE,
        )
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
        run_kernel(self.kernels.library.forms_stage, self.structure, of, at.ctypes, f, to)
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
        """As `TouchedPlate.drawn`."""
        m, (k, p) = len(rows), shares.shape
        at = Sensors(k * p)
        at.point(rows=points, weights=shares, error=error_power, threshold=threshold)
        powers = np.empty((m, k * p, 1 + by.count) if with_powers else 0, dtype=np.float32)
        means, loudest = (np.empty((m, k, 1 + by.count), dtype=np.float32) for _ in range(2))
        at_rows, of_weights = as_given(rows), as_given(weights)
        to = (ctypes.c_void_p * 3)(
            powers.ctypes.data if with_powers else None, means.ctypes.data, loudest.ctypes.data
        )
        draws = draws_structure(self.on, self.clocks, k, by)
        stage = self.kernels.library.tones_stage
        run_kernel(stage, self.structure, draws, at, at_rows.ctypes, m, of_weights.ctypes, to)
        return FingertipAmplitudes(means, loudest, powers if with_powers else None)


def touch(
    on: PlateOnEras,
    centres: Float32Array,
    loads: tuple[float, ...] = (),
    clocks: ClockErrors = EXACT_CLOCKS,
) -> TouchedPlate:
    """Put fingers on a plate, using C kernels if they can be compiled.

    centres (k, r): shapes there; loads (k,): relative to the rig's fingertip, empty for 1 each;
    clocks: errors of the amplifiers' clocks.
    """
    by, plate, count = kernels(), on.plate, len(centres)
    stiffness, stds = plate.finger_stiffness(count, loads), plate.load_stds(count, loads)
    if by is None or not count:
        return TouchedPlate(on, centres, stiffness, stds, clocks)
    return TouchedByKernel(on, centres, stiffness, stds, clocks, kernels=by)


def drawn_on(
    on: PlateOnEras, finger_count: int, by: Drawing
) -> tuple[Draws, int, tuple[int, int], int]:
    """Draw plates for a number of fingers.

    Returns the draws; the number of their thicknesses; the number of thicknesses for changes and
    the index of the first one; and the index of the first thickness of the draws. If the thickness
    is certain, only the nominal one exists.
    """
    plate = on.plate
    first = on.first.get(by.thicknesses, MODELLED)
    nodes = by.thicknesses if first else 1
    draws = draw(
        plate.era_count,
        finger_count,
        masses=plate.stiffness.shape[1] - plate.era_count,
        to_feet=plate.by_stiffness.shape[1] - plate.era_count,
        count=by.count,
        seed=by.seed,
        gain=plate.uncertainty.gain,
        phase=math.radians(plate.uncertainty.phase_deg),
        common_gain=plate.uncertainty.common_gain,
        harmonic=plate.uncertainty.harmonic,
        thicknesses=nodes,
    )
    first_base = on.first.get(by.bases, MODELLED)
    return draws, nodes, (by.bases if first_base else 1, first_base), first


def expected_power(
    fields: Sequence[Complex64Array],
    own: Complex64Array,
    weights: Float32Array,
    *,
    gain_variance: float,
    error_power: Float32Array,
    shares: Float32Array | None = None,
) -> Complex64Array:
    """Compute expected powers R (f, g, n, n) at g groups of points.

    fields: h and each of its changes (f, g, p, n); own (f, g, j, n): RMS changes over the points
    due to the stiffness of each attachment and the load of each finger; weights (g, p): of the
    points; error_power (f, ..., n): mean square error of each ERA's field; shares (f, n, n): by
    which delays of amplifiers increase the power of h.
    """
    f, g, _, n = own.shape
    root = np.sqrt(weights)[..., None]
    power = gram(np.concatenate([*(each * root for each in fields), own], axis=2))
    if shares is not None:
        power += shares[:, None] * gram(fields[0] * root)
    size = (weights[:, None] @ power_of(fields[0]))[:, :, 0]
    diagonal = power.reshape(f, g, -1)[..., :: n + 1]
    values = diagonal.real + np.float32(gain_variance) * size + error_power
    diagonal[:] = values + np.float32(RIDGE / n) * values.sum(axis=-1, keepdims=True)
    return power


def gram(rows: Complex64Array) -> Complex64Array:
    """Return the forms (..., n, n) of sums over rows (..., rows, n)."""
    return np.asarray(rows.conj().swapaxes(-1, -2) @ rows)


def outer(rows: Complex64Array) -> Complex64Array:
    """Return the forms conj(h) h^T (..., n, n) of rows h (..., n)."""
    return np.asarray(rows.conj()[..., :, None] * rows[..., None, :])


def power_of(values: Complex64Array) -> Float32Array:
    """Return squared magnitudes."""
    return np.asarray(values.real * values.real + values.imag * values.imag)


def plates_structure(on: PlateOnEras) -> TouchedPlates:
    """Pack a plate without fingers for kernels; kept with it."""
    known = _kept.get(on)
    if known is not None:
        return known
    plate = on.plate
    (b, r), (f, t, _) = plate.shapes.shape, on.receptance.shape
    kept = min(t, THINNER + 1)  # thicknesses that searches rank by
    found = TouchedPlates(
        n=plate.era_count,
        b=b,
        r=r,
        t=t,
        off=plate.by_stiffness.shape[1],
        rows=f,
        kept=kept,
    )
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
        run_kernel(by.library.blocks_stage, found)
    return _kept.setdefault(on, found)  # concurrent threads all take the first one


_kept: WeakKeyDictionary[PlateOnEras, TouchedPlates] = WeakKeyDictionary()


def draws_structure(
    on: PlateOnEras, clocks: ClockErrors, finger_count: int, by: Drawing
) -> PlateDraws:
    """Pack drawn plates with a number of fingers for kernels."""
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
    found = PlateDraws(
        count=count,
        bases=bases,
        nodes=nodes,
        width=count + _MAX_LANES,
        first_base=first_base,
        first_node=first_node,
    )
    found.point(
        node=draws.node,
        loss=_padded(draws.loss),
        damping=_padded(draws.damping),
        own=_padded(draws.own),
        gains=_padded(np.stack([draws.gains.real, draws.gains.imag])),
        errors=_padded(np.stack([draws.errors.real, draws.errors.imag])),
        harmonics=_padded(np.stack([draws.harmonics.real, draws.harmonics.imag])),
    )
    return found


def _padded(values: Float32Array | FloatArray) -> Float32Array:
    """Return values (..., d) in single precision, padded by one register."""
    return np.pad(as_given(values), [(0, 0)] * (values.ndim - 1) + [(0, _MAX_LANES)])
