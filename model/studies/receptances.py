"""The free plate seen from all places where ERAs may stand: what a study of layouts solves once.

With the receptance between these places, and from them to the points that are looked at, every
layout is a system of equations as small as its number of ERAs for each frequency.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.reduction.low_rank import coupled_forces, on_diagonal
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.structure.dynamic_stiffness import attached_stiffness, drive_forces

# More than this [bytes] and the machine is likely to run out of memory.
_MAX_BYTES = 2 << 30


@dataclass(frozen=True, eq=False)
class Receptances:
    """Receptance [m/N] of a plate without ERAs, with the point masses that it carries.

    frequencies (f,) [Hz]; between (f, c, c), from place to place; to_points (f, c, p).
    """

    frequencies: FloatArray
    between: ComplexArray
    to_points: ComplexArray

    def room(self, era_count: int) -> ComplexArray:
        """Room for `acceleration` to work in, (2, f, eras, p)."""
        shape = (2, len(self.frequencies), era_count, self.to_points.shape[2])
        return np.empty(shape, dtype=complex)

    def acceleration(
        self, places: IntArray, eras: tuple[Era, ...], *, room: ComplexArray | None = None
    ) -> ComplexArray:
        """Acceleration [m/s²] of each ERA alone at full stroke, the others holding: (f, eras, p).

        places: at which of the c places each ERA stands; its own position is not looked at. room:
        used again from call to call, for memory fresh from the system costs more than the sums;
        the answer lies in it.
        """
        if room is None:
            room = self.room(len(eras))
        omega = 2 * np.pi * self.frequencies
        at_eras = self.between[:, places[:, None], places]
        applied = on_diagonal(drive_forces(eras, omega), rows=len(eras))
        forces = coupled_forces(at_eras, attached_stiffness(eras, (), omega), applied)
        scaled = -(omega**2)[:, None, None] * forces.transpose(0, 2, 1)
        np.take(self.to_points, places, axis=1, out=room[0], mode="clip")  # else it is buffered
        acceleration: ComplexArray = np.matmul(scaled, room[0], out=room[1])
        return acceleration


def solve_receptances(
    rig: Rig, positions: FloatArray, points: FloatArray, frequencies: FloatArray
) -> Receptances:
    """Solve a rig's plate, without its ERAs, for places (c, 2) and points (p, 2) [m].

    Raises InputError for frequencies [Hz] that the mesh cannot carry, and where the result would
    not fit into memory.
    """
    count = len(positions)
    size = 16 * len(frequencies) * count * (count + len(points))
    if size > _MAX_BYTES:
        raise InputError(
            f"{count} places, {len(points)} points and {len(frequencies)} frequencies take "
            f"{size / 1e9:.1f} GB; take fewer --candidates or fewer --frequencies"
        )
    free_plate = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(frequencies.max()))
    between, to_points = free_plate.receptances(positions, points, frequencies, loads=rig.loads)
    return Receptances(frequencies, between, to_points)
