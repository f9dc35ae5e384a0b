"""A map of the plate: peak acceleration on a regular raster, for any drive."""

from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.assembly import assemble
from model.errors import InputError
from model.excitation import Excitation
from model.harmonic import direct_acceleration
from model.rig import Rig
from model.vibration import find_nulls, peak_acceleration, tone_amplitudes

# Fewer elements a wavelength than this and the answer is not worth having.
LEAST_ELEMENTS_PER_WAVELENGTH = 6


@dataclass(frozen=True)
class PlateMap:
    """Peak acceleration [m/s²] at raster points x (nx,), y (ny,) [m]: peak (ny, nx), and its nulls.

    nulls: positions [m] (n, 2).
    """

    x: FloatArray
    y: FloatArray
    peak: FloatArray
    nulls: FloatArray


def plate_map(
    rig: Rig, excitation: Excitation, *, raster: tuple[int, int] | None = None
) -> PlateMap:
    """Solve the rig's plate for an excitation; the raster defaults to the nodes of the mesh.

    Raises InputError for a raster below 2x2 or a frequency that the mesh cannot carry.
    """
    for tone in excitation.values():
        _check_resolution(rig, tone.frequency)
    mesh = rig.mesh
    columns, rows = raster or (mesh.nx + 1, mesh.ny + 1)
    if columns < 2 or rows < 2:
        raise InputError(f"a map of {columns}x{rows} points is none; 2x2 is the least")
    x = np.linspace(0, rig.plate.length, columns)
    y = np.linspace(0, rig.plate.width, rows)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    matrices = assemble(rig.plate, mesh)
    _, amplitudes = tone_amplitudes(
        excitation, rig.eras, lambda f: direct_acceleration(matrices, rig.eras, f, points)
    )
    peak = peak_acceleration(amplitudes).reshape(rows, columns)
    return PlateMap(x, y, peak, find_nulls(x, y, peak))


def _check_resolution(rig: Rig, frequency: float) -> None:
    if not (np.isfinite(frequency) and frequency > 0):
        raise InputError(f"frequency is {frequency} Hz, must be above zero")
    size = max(rig.mesh.element_size)
    wavelength = rig.plate.bending_wavelength(frequency)
    if wavelength < LEAST_ELEMENTS_PER_WAVELENGTH * size:
        need = LEAST_ELEMENTS_PER_WAVELENGTH / wavelength
        raise InputError(
            f"the {rig.mesh} mesh has {wavelength / size:.1f} elements in a bending wavelength at "
            f"{frequency:g} Hz, too few to answer; use --mesh {int(rig.plate.length * need) + 1}x"
            f"{int(rig.plate.width * need) + 1} or finer"
        )
