"""A map of the plate: peak acceleration on a regular raster, for any drive."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from model.arrays import ComplexArray, FloatArray, lattice
from model.counting import counted
from model.errors import InputError
from model.files.csv_file import as_frame
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig
from model.vibration.excitation import Excitation, find_nulls, peak_acceleration, tone_fields

MAX_POINTS = 1_000_000
"""More would be finer than any screen, at some hundred bytes of memory each."""

_AT_ONCE = 10_000  # points that are solved together, at some kilobytes each


@dataclass(frozen=True)
class PlateMap:
    """Peak acceleration [m/s²] at raster points x (nx,), y (ny,) [m]: peak (ny, nx), and its nulls.

    nulls: positions [m] (n, 2); frequencies (f,) [Hz] and field (f, ny, nx): the complex
    acceleration [m/s²] at each, of which the peak is the sum of magnitudes. Phases are those of
    exp(+i omega t), as a tone's.
    """

    x: FloatArray
    y: FloatArray
    peak: FloatArray
    nulls: FloatArray
    frequencies: FloatArray
    field: ComplexArray

    def to_frame(self) -> Any:
        """Points and peak acceleration as a pandas DataFrame, a row a point; needs pandas."""
        x, y = np.meshgrid(self.x, self.y)
        return as_frame({"x_m": x.ravel(), "y_m": y.ravel(), "peak_m_s2": self.peak.ravel()})

    def __repr__(self) -> str:
        return (
            f"<PlateMap of {len(self.x)} x {len(self.y)} points, "
            f"at most {self.peak.max():.3g} m/s², {counted(len(self.nulls), 'null')}>"
        )


def plate_map(
    rig: Rig,
    *excitations: Excitation,
    raster: tuple[int, int] | None = None,
    free: FreePlate | None = None,
) -> PlateMap:
    """Solve the rig's plate for excitations at once; the raster defaults to that of the mesh.

    free: the same plate where it has been solved before. Raises InputError for a raster below 2x2
    or of millions of points, or a frequency that the mesh cannot carry.
    """
    mesh = rig.mesh
    columns, rows = raster or mesh.raster
    if columns < 2 or rows < 2:
        raise InputError(f"map: points must be 2x2 or more, got {columns}x{rows}")
    if columns * rows > MAX_POINTS:
        raise InputError(
            f"map: points must be at most {MAX_POINTS}, got {columns}x{rows}; take a coarser one"
        )
    x = np.linspace(0, rig.plate.length, columns)
    y = np.linspace(0, rig.plate.width, rows)
    points = lattice(x, y)

    def respond(driven: FloatArray) -> ComplexArray:
        highest = max(rig.limits.frequency_max, float(driven.max()))
        solved = free or solve_free_plate(rig.plate, mesh, frequency_max=highest)
        parts = np.array_split(points, 1 + len(points) // _AT_ONCE)
        found = [solved.acceleration(rig.eras, driven, part, loads=rig.masses) for part in parts]
        return np.concatenate(found, axis=2)

    frequencies, field = tone_fields(excitations[0], rig.eras, respond, *excitations[1:])
    peak = peak_acceleration(np.abs(field)).reshape(rows, columns)
    nulls = find_nulls(x, y, peak)
    return PlateMap(x, y, peak, nulls, frequencies, field.reshape(-1, rows, columns))
