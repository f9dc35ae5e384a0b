"""Fingers on plates whose ERAs are eliminated, and what is felt of drawn ones, in numpy.

k fingers of dynamic stiffness D at centres c change fields X of a plate on its ERAs to

    X - G D P X_c,  P = (1 + G_cc D)^-1,

where G is the displacement by a force at each finger without the others; with them -w² G P^T is the
acceleration by it. Symbols are those of `attached_plate`; cases are those of a frequency and of a
thickness each. The expected power of weights w at a fingertip is w^H R w to first order,

    R = mean_p { h* h^T + dh* dh^T + dc* dc^T + sum_j |s_j t_pj|² r_j* r_j^T + sigma² diag |h|² },

with h the field of each ERA, t_pj the acceleration by a force at attachment j, and r_j by how much
each ERA at full stroke deforms it. Each change d is one by a standard deviation, s_j that of the
stiffness: the ERAs' damping c together, stiffness of each ERA and foot and load of each finger j on
their own, gains as sigma: exact derivatives of the loaded plate, but for what a finger deflects
locally. For the thickness, half the sum of dh* dh^T of the plates thicker and thinner by it,
exactly; the modulus counts along with it (`attached_plate`). The loss factor changes next to
nothing.

`model.ensemble.touched_plate` runs the same in C.

`model.ensemble.touched_plate` by kernels in C.
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
    run,
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
"""Share of a form's trace that is added to its diagonal: keeps it definite."""


@dataclass(frozen=True, eq=False)
class LoadedContacts:
    """What g fingertips, or other groups of points, have of the ERAs at f frequencies.

    fields: (f, g, p, n) h [m/s²] at points; fine_fields: (f, g, fine, n) at others, None unless
    wanted; power: (f, g, n, n) R; uncertain: (f, g, n, n) R without h* h^T.
    """

    fields: Complex64Array
    fine_fields: Complex64Array | None
    power: Complex64Array
    uncertain: Complex64Array


@dataclass(frozen=True, eq=False)
class Changes:
    """Forces at attachments a in c cases, by one standard deviation of what is uncertain.

    loss, damping, own (c, a): of the loss factor, of all dampers, and of the attachment's own
    stiffness; drives (c, a): of each ERA as it plays, which its gain multiplies; by_loss (c, p):
    acceleration at points by the loss factor beside those forces.
    """

    loss: Complex64Array
    damping: Complex64Array
    own: Complex64Array
    drives: Complex64Array
    by_loss: Complex64Array


@dataclass(frozen=True, eq=False)
class FingertipAmplitudes:
    """Amplitudes to threshold of m tones at k fingertips, nominal and on d drawn plates.

    means: (m, k, 1 + d) mean amplitude over each fingertip; loudest: (m, k, 1 + d) squared
    amplitude at its loudest point; powers: (m, k p, 1 + d) at all points, None unless wanted.
    """

    means: Float32Array
    loudest: Float32Array
    powers: Float32Array | None


@dataclass(frozen=True, eq=False)
class TouchedPlate:
    """Plates with k fingers at centres of shapes (k, r), of dynamic stiffness (f, k) [N/m].

    clocks: errors of those of the amplifiers.
    """

    on: PlateOnEras
    centres: Float32Array
    stiffness: Complex64Array
    clocks: ClockErrors = EXACT_CLOCKS

    def sources(
        self, rows: IntArray, nodes: IntArray, points: Float32Array
    ) -> tuple[Complex64Array, Complex64Array]:
        """Accelerations by forces, and motion by ERAs, in cases of rows (c,) and nodes (c,).

        Accelerations [m/s²/N] at points of shapes (p, r) by a force at each attachment and then
        each finger, (c, p, b + k); displacement of these by each ERA at full stroke, (c, b + k, n).
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
        """Fields and expected powers at frequencies, by row (f,).

        points (g, p, r), fine (g, fine, r): shapes at groups of points, as under each finger;
        weights (g, p): of its points, sum 1; error_power: mean square of the discretisation error
        of each ERA's field, at all frequencies of the plate, (all, n).
        """
        plate, n, f, (g, p, r) = self.on.plate, self.on.plate.era_count, len(rows), points.shape
        forces, every = plate.forces[rows, None], points.reshape(-1, r)
        modelled = np.full(f, MODELLED)
        by_force, moved = self.sources(rows, modelled, every)
        h = by_force[:, :, :n] * forces
        stretched = -moved
        stretched.reshape(f, -1)[:, : n * n : n + 1] += plate.strokes[rows]
        changes = [h, by_force[:, :, :n] @ (plate.by_damping[rows, :, None] * stretched[:, :n])]
        if plate.uncertainty.frequency > 0:
            for node in (THICKER, THINNER):
                other, _ = self.sources(rows, np.full(f, node), every)
                changes.append((other[:, :, :n] * forces - h) * np.float32(math.sqrt(0.5)))
        a, k, s = moved.shape[1], len(self.centres), plate.by_stiffness.shape[1]
        uncertain = np.concatenate([np.arange(s), np.arange(a - k, a)])
        load = np.float32(plate.uncertainty.fingertip) * self.stiffness[rows]
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
        """What changes forces, of weights (c, n) and their motions moved (c, b + k) [m]."""
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
        by_load = np.float32(plate.uncertainty.fingertip) * self.stiffness[rows]
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
        """What is felt on the nominal plate and on drawn ones of tones at rows (m,).

        weights (m, n): of the ERAs; points (k p, r): shapes; shares (k, p): of the points in the
        mean over fingertips; error_power (f, n): mean square of the discretisation error of each
        ERA's field; threshold (f,) [m/s²]; both at all frequencies of the plate.
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

        Of a plate at twice the frequencies (`at_harmonics`). points (k, p, r): shapes; the rest as
        of `drawn`. None of the nominal plate.
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
        """T at the centres (c, k, b), G (c, k, r) and P (c, k, k)."""
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
        """Coordinates (c, q, r) with the fingers, of those without; and the field at these.

        at (c, k, q): of those without.
        """
        resting = np.asarray(P @ at)
        held = self.stiffness[rows, :, None] * resting
        return np.asarray(free - held.swapaxes(1, 2) @ G), resting


def drawn_on(
    on: PlateOnEras, finger_count: int, by: Drawing
) -> tuple[Draws, int, tuple[int, int], int]:
    """Drawn plates; how many thicknesses they have; for changes how many, and the first's index.

    And that of the first of the plates' own. One, the nominal one, where it is certain.
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
    """Expected powers R at g groups of points, (f, g, n, n).

    fields: h and each of its changes (f, g, p, n); own (f, g, j, n): changes by the stiffness of
    each attachment and the load of each finger, root mean square over the points; weights (g, p) of
    the points; error_power (f, ..., n): mean square of the error of each ERA's field; shares (f, n,
    n): by which the power of h grows, as the clocks of amplifiers are off.
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
    """Forms of the sum over rows (..., rows, n): (..., n, n)."""
    return np.asarray(rows.conj().swapaxes(-1, -2) @ rows)


def outer(rows: Complex64Array) -> Complex64Array:
    """Forms conj(h) h^T of rows h (..., n): (..., n, n)."""
    return np.asarray(rows.conj()[..., :, None] * rows[..., None, :])


def power_of(values: Complex64Array) -> Float32Array:
    """Squared magnitude."""
    return np.asarray(values.real * values.real + values.imag * values.imag)


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
