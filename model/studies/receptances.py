"""Receptances of a plate without ERAs between candidate positions, solved once for a study.

With them each layout is one system of equations per frequency, of the size of its number of ERAs.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from model.arrays import Complex64Array, ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.structure.dynamic_stiffness import dynamic_stiffness, full_strokes

# More than this [bytes] and the machine is likely to run out of memory.
_MAX_BYTES = 2 << 30

Buffer: TypeAlias = tuple[Complex64Array, Complex64Array]


@dataclass(frozen=True, eq=False)
class Receptances:
    """Receptances [m/N] of a plate with its point masses, without ERAs.

    frequencies (f,) [Hz]; between (f, c, c): candidate positions; to_points (f, c, p), in single
    precision like what follows from it, a thousand times as accurate as any mesh.
    """

    frequencies: FloatArray
    between: ComplexArray
    to_points: Complex64Array

    @cached_property
    def _spectra(self) -> ComplexArray:
        """Those between positions with the frequencies last, (c, c, f)."""
        return np.ascontiguousarray(self.between.transpose(1, 2, 0))

    def buffer(self, era_count: int) -> Buffer:
        """Buffer for `acceleration`, (f, eras, p) and (eras, f, p)."""
        f, p = len(self.frequencies), self.to_points.shape[2]
        first, second = (f, era_count, p), (era_count, f, p)
        return np.empty(first, dtype=np.complex64), np.empty(second, dtype=np.complex64)

    def acceleration(
        self, places: IntArray, eras: tuple[Era, ...], *, buffer: Buffer | None = None
    ) -> Complex64Array:
        """Acceleration [m/s²] for each ERA alone at full stroke: (f, eras, p).

        places (eras,): candidate position of each ERA, in place of its own. buffer: reused between
        calls, since allocating costs more than the sums; holds the result.
        """
        mounts = np.array([(era.stiffness, era.damping, era.bolt_mass) for era in eras])
        strokes = full_strokes(eras, 2 * np.pi * self.frequencies)
        (forces,) = self.forces(places[None], mounts[None], strokes)
        return self.fields(places, forces, self.buffer(len(eras)) if buffer is None else buffer)

    def forces(self, places: IntArray, mounts: FloatArray, strokes: ComplexArray) -> Complex64Array:
        """Forces on the plate for each ERA alone, times -omega² [N/s²], (n, f, eras, eras).

        places (n, eras): of n layouts; mounts (n, eras, 3): stiffness, damping and bolt mass;
        strokes (f, eras): amplitudes of the bases [m]. Driven ERAs are the first of the last two.
        """
        omega = 2 * np.pi * self.frequencies
        system, applied = [], []
        for era, place in enumerate(places.T):
            k, c, m = mounts[:, era, :, None].swapaxes(0, 1)
            reaction = dynamic_stiffness(k, c, m, omega)
            system.append([reaction * self._spectra[place, other] for other in places.T])
            system[era][era] += 1
            applied.append(dynamic_stiffness(k, c, 0.0, omega) * strokes[:, era])
        return _in_single_precision(_solve(system, applied), -(omega**2))

    def fields(self, places: IntArray, forces: Complex64Array, buffer: Buffer) -> Complex64Array:
        """Acceleration (f, eras, p) of one layout from its `forces` (f, eras, eras).

        That of each ERA is in one piece of memory.
        """
        from_places, of_eras = buffer
        np.take(self.to_points, places, axis=1, out=from_places, mode="clip")  # others copy
        acceleration: Complex64Array = of_eras.transpose(1, 0, 2)
        return np.matmul(forces, from_places, out=acceleration)


def _solve(
    system: list[list[ComplexArray]], applied: list[ComplexArray]
) -> list[list[ComplexArray]]:
    """Solve many systems of equations at once, for right sides that are diagonal.

    Entries of matrices and their inverses times the right sides are arrays of one shape, one by
    one. Without pivoting: each step attaches one more ERA to the plate, which a passive plate
    with losses always allows.
    """
    count = len(system)
    solved = [[np.zeros_like(entry) for _ in range(count)] for entry in applied]
    for number, entry in enumerate(applied):
        solved[number][number] = entry
    for pivot in range(count):
        inverse = 1 / system[pivot][pivot]
        for row in range(count):
            if row == pivot:
                continue
            share = system[row][pivot] * inverse
            for column in range(pivot + 1, count):
                system[row][column] -= share * system[pivot][column]
            for column in range(pivot + 1):
                solved[row][column] = solved[row][column] - share * solved[pivot][column]
        for column in range(pivot + 1, count):
            system[pivot][column] *= inverse
        for column in range(pivot + 1):
            solved[pivot][column] = solved[pivot][column] * inverse
    return solved


def _in_single_precision(entries: list[list[ComplexArray]], factors: FloatArray) -> Complex64Array:
    """Entries (n, f) of matrices times factors (f,), transposed: (n, f, columns, rows)."""
    shape = (*entries[0][0].shape, len(entries[0]), len(entries))
    result = np.empty(shape, dtype=np.complex64)
    for row, of_row in enumerate(entries):
        for column, entry in enumerate(of_row):
            result[:, :, column, row] = entry * factors
    return result


def solve_receptances(
    rig: Rig, positions: FloatArray, points: FloatArray, frequencies: FloatArray
) -> Receptances:
    """Solve a rig's plate without its ERAs for positions (c, 2) and points (p, 2) [m].

    Raises InputError for frequencies [Hz] too high for the mesh, a result too large for memory, and
    ERAs on feet of several sizes.
    """
    feet = {era.foot for era in rig.eras}
    if len(feet) > 1:
        raise InputError(
            f"eras: foot must be the same for all ERAs of a study, got {min(feet):g} to "
            f"{max(feet):g} m"
        )
    footprints = np.column_stack([positions, np.full(len(positions), feet.pop())])
    count = len(positions)
    size = 16 * len(frequencies) * count * (count + len(points))
    if size > _MAX_BYTES:
        raise InputError(
            f"{count} places, {len(points)} points and {len(frequencies)} frequencies take "
            f"{size / 1e9:.1f} GB; take fewer --candidates or fewer --frequencies"
        )
    free_plate = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(frequencies.max()))
    between, to_points = free_plate.receptances(footprints, points, frequencies, loads=rig.masses)
    return Receptances(frequencies, between, to_points.astype(np.complex64))
