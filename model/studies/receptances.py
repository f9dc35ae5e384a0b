"""Receptances of a plate without ERAs between candidate positions, solved once for a study.

With them each layout is one system of equations per frequency, of the size of its number of ERAs.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.structure.dynamic_stiffness import dynamic_stiffness, full_strokes
from model.structure.low_rank import coupled_forces, on_diagonal

# More than this [bytes] and the machine is likely to run out of memory.
_MAX_BYTES = 2 << 30


@dataclass(frozen=True, eq=False)
class Receptances:
    """Receptances [m/N] of a plate with its point masses, without ERAs.

    frequencies (f,) [Hz]; between (f, c, c): candidate positions; to_points (f, c, p).
    """

    frequencies: FloatArray
    between: ComplexArray
    to_points: ComplexArray

    def buffer(self, era_count: int) -> ComplexArray:
        """Buffer for `acceleration`, (2, f, eras, p)."""
        shape = (2, len(self.frequencies), era_count, self.to_points.shape[2])
        return np.empty(shape, dtype=complex)

    def acceleration(
        self, places: IntArray, eras: tuple[Era, ...], *, buffer: ComplexArray | None = None
    ) -> ComplexArray:
        """Acceleration [m/s²] for each ERA alone at full stroke: (f, eras, p).

        places (eras,): candidate position of each ERA, in place of its own. buffer: reused between
        calls, since allocating costs more than the sums; holds the result.
        """
        mounts = np.array([(era.stiffness, era.damping, era.bolt_mass) for era in eras])
        strokes = full_strokes(eras, 2 * np.pi * self.frequencies)
        (forces,) = self.forces(places[None], mounts[None], strokes)
        return self.fields(places, forces, self.buffer(len(eras)) if buffer is None else buffer)

    def forces(self, places: IntArray, mounts: FloatArray, strokes: ComplexArray) -> ComplexArray:
        """Forces on the plate for each ERA alone, times -omega² [N/s²], (n, f, eras, eras).

        places (n, eras): of n layouts; mounts (n, eras, 3): stiffness, damping and bolt mass;
        strokes (f, eras): amplitudes of the bases [m]. Driven ERAs are the first of the last two.
        """
        omega = 2 * np.pi * self.frequencies
        k, c, m = (mounts[:, None, :, number] for number in range(3))
        at_eras = self.between.transpose(1, 2, 0)[places[:, :, None], places[:, None]]
        base = dynamic_stiffness(k, c, 0.0, omega[:, None])
        applied = on_diagonal(base * strokes, rows=places.shape[1])
        forces = coupled_forces(
            at_eras.transpose(0, 3, 1, 2), dynamic_stiffness(k, c, m, omega[:, None]), applied
        )
        return np.asarray(-(omega**2)[:, None, None] * forces.swapaxes(-1, -2))

    def fields(self, places: IntArray, forces: ComplexArray, buffer: ComplexArray) -> ComplexArray:
        """Acceleration (f, eras, p) of one layout from its `forces` (f, eras, eras)."""
        np.take(self.to_points, places, axis=1, out=buffer[0], mode="clip")  # others copy
        acceleration: ComplexArray = np.matmul(forces, buffer[0], out=buffer[1])
        return acceleration


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
    return Receptances(frequencies, between, to_points)
