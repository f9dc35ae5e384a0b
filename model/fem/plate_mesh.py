"""Discretisation of a plate: finite elements, or polynomials over the whole plate."""

import math
from dataclasses import replace
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.plate import Plate


class PlateMesh(Protocol):
    """nx by ny elements over length by width [m], or polynomials of degrees nx and ny."""

    @property
    def nx(self) -> int:
        """Elements along x, or degree."""

    @property
    def ny(self) -> int:
        """Elements along y, or degree."""

    @property
    def length(self) -> float:
        """Length of the plate along x [m]."""

    @property
    def width(self) -> float:
        """Width of the plate along y [m]."""

    @property
    def element_name(self) -> str:
        """Name of the element or of the polynomials."""

    @property
    def strip(self) -> float:
        """Width of a row of elements along every edge [m]; 0 for none."""

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""

    @property
    def raster(self) -> tuple[int, int]:
        """Numbers of evenly spaced points along x and y that show what it resolves."""

    def highest_frequency(self, plate: Plate) -> float:
        """The highest frequency [Hz] whose bending waves in a plate it resolves."""

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """The coarsest of its kind that resolves a frequency [Hz]."""

    def interpolation_error(self, plate: Plate, frequency: float) -> float:
        """By how much it may deviate from a wave [Hz] between its points, relative to the wave."""

    def __hash__(self) -> int:
        """Meshes are keys of caches."""

    def to_dict(self) -> dict[str, Any]:
        """Its fields for a file."""


MeshT = TypeVar("MeshT", bound=PlateMesh)


def stretched(mesh: MeshT, plate: Plate) -> MeshT:
    """A mesh of its kind that resolves the same on a plate of another size."""
    nx, ny = (
        math.ceil(count * max(new / old, 1.0))
        for count, new, old in (
            (mesh.nx, plate.length, mesh.length),
            (mesh.ny, plate.width, mesh.width),
        )
    )
    values: Any = mesh  # a frozen dataclass
    resized: MeshT = replace(values, nx=nx, ny=ny, length=plate.length, width=plate.width)
    return resized


def check_frequencies(plate: Plate, mesh: PlateMesh, frequencies: FloatArray) -> None:
    """Raise InputError for frequencies (f,) [Hz] not above zero or too high for the mesh."""
    for frequency in frequencies:
        if not (np.isfinite(frequency) and frequency > 0):
            raise InputError(f"frequency must be above zero, got {frequency} Hz")
    highest = max(frequencies, default=0.0)
    if highest > mesh.highest_frequency(plate):
        raise InputError(
            f"frequency must be at most {mesh.highest_frequency(plate):g} Hz, which mesh {mesh} "
            f"resolves, got {highest:g} Hz; use mesh {mesh.resolving(plate, highest)} or finer, or "
            f"with mesh: auto raise the upper limits.frequency to {highest:g} Hz"
        )
