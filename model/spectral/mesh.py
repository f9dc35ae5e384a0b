"""Degrees of the polynomials over the plate, chosen for a frequency."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self, TypeAlias

import numpy as np

from model.errors import InputError
from model.fem import Mesh
from model.spectral.local_compliance import edge_compliance
from model.structure.discretisation import Discretisation
from model.structure.plate import Plate

POLYNOMIALS = "Legendre"
"""Name in files and results, in place of an element's."""

MIN_DEGREE = 4
MAX_DEGREE = 200

# Degrees beyond pi for each wavelength on a side: with so many the bending waves are resolved, and
# with so many as accurately as 1 %, with further ones for each factor of ten below; with more than
# so many waves more in proportion to their cube root, as the turning point of a polynomial widens.
_RESOLVES = 2
_ACCURATE, _PER_DECADE, _MANY = 4.3, 1.5, 9.0

# Error of the response by the unresolved compliance at the middle of an edge (measured on 23
# plates) at degree _AT_DEGREE, and how it falls with the degree: per stiffness of an ERA, more on a
# small plate by the square of the wavelength over the area; and per dynamic stiffness of an
# infinite plate, since the field of a force is wrong elsewhere, too.
_PER_STIFFNESS, _ON_SMALL_PLATES, _PER_WAVE_STIFFNESS, _AT_DEGREE = 0.1, 2.0, 0.02, 13
_FALLS = 0.8
_AS_IF_RIGID = (
    10  # times the wave stiffness: an ERA much stiffer than that is no stiffer to a plate
)

_FINER = 2  # further degrees to compare with

MAX_POLYNOMIALS = 6000
"""Of the deflection, that are chosen; they take some seconds of processor time and 1.5 GB."""

_MAX_NAMED = 8000  # ten seconds and 2 GB

_POINTS_PER_DEGREE = 8  # of the raster that shows a field: fifty to a wavelength


@dataclass(frozen=True)
class SpectralMesh(Discretisation):
    """Legendre polynomials up to degrees nx along x and ny along y, over length by width [m]."""

    element_name: ClassVar[str] = POLYNOMIALS
    strip: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        """Refuse degrees out of range."""
        if not MIN_DEGREE <= min(self.nx, self.ny) <= max(self.nx, self.ny) <= MAX_DEGREE:
            raise InputError(
                f"mesh: degrees must be {MIN_DEGREE} to {MAX_DEGREE}, got {self.nx}x{self.ny}"
            )
        count = (self.nx + 1) * (self.ny + 1)
        if count > _MAX_NAMED:
            raise InputError(
                f"mesh: polynomials must be at most {_MAX_NAMED}, got {count}: {self.nx}x{self.ny}"
            )

    @classmethod
    def accurate(
        cls,
        plate: Plate,
        *,
        frequency_max: float,
        accuracy: float,
        stiffness: float,
        foot: float = 0.0,
    ) -> Self | None:
        """Choose degrees for a relative L2 error of the response up to a frequency [Hz].

        accuracy: that error, 0.01 for 1 %; stiffness [N/m]: of the stiffest ERA, whose force dents
        the plate under it; foot [m]: radius of the smallest, 0 for a point. None where more than
        MAX_POLYNOMIALS would be needed.
        """
        wavelength = plate.bending_wavelength(frequency_max)
        small = wavelength**2 / (plate.length * plate.width)
        wave_stiffness = plate.wave_stiffness(frequency_max)
        acting = stiffness / (1 + stiffness / (_AS_IF_RIGID * wave_stiffness))
        errors = _PER_STIFFNESS * (1 + _ON_SMALL_PLATES * small) * acting
        errors += _PER_WAVE_STIFFNESS * wave_stiffness
        more = _ACCURATE + _PER_DECADE * max(0.0, math.log10(0.01 / accuracy))
        degrees = []
        for side in (plate.length, plate.width):
            waves = math.pi * side / wavelength
            least = max(MIN_DEGREE, math.ceil(waves + more * max(1, waves / _MANY) ** (1 / 3)))
            possible = np.arange(least, MAX_DEGREE + 1)
            shares = errors * (_AT_DEGREE / possible) ** _FALLS
            accurate = shares * edge_compliance(plate, side, possible, foot) <= accuracy
            if not accurate.any():
                return None
            degrees.append(int(possible[accurate.argmax()]))
        if math.prod(degree + 1 for degree in degrees) > MAX_POLYNOMIALS:
            return None
        return cls(degrees[0], degrees[1], plate.length, plate.width)

    def __str__(self) -> str:
        return f"{self.nx}x{self.ny} {POLYNOMIALS}"

    @property
    def dof(self) -> int:
        """Number of degrees of freedom: polynomials of w, and of the rotations with edge layers."""
        w = (self.nx + 1) * (self.ny + 1)
        return w + 2 * (self.nx + 3) * (self.ny + 3)

    @property
    def raster(self) -> tuple[int, int]:
        """Numbers of evenly spaced points along x and y that show what it resolves."""
        return _POINTS_PER_DEGREE * self.nx + 1, _POINTS_PER_DEGREE * self.ny + 1

    @property
    def shortest_wavelength(self) -> float:
        """The shortest bending wavelength [m] that it resolves."""
        sides = (self.length / (self.nx - _RESOLVES), self.width / (self.ny - _RESOLVES))
        return math.pi * max(sides)

    def finer(self) -> Self:
        """Degrees to compare with, for the discretisation error."""
        return replace(self, nx=self.nx + _FINER, ny=self.ny + _FINER)

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """Lowest degrees that resolve a frequency [Hz]."""
        half = plate.bending_wavelength(frequency) / math.pi
        nx, ny = (
            max(MIN_DEGREE, math.ceil(side / half) + _RESOLVES)
            for side in (plate.length, plate.width)
        )
        return type(self)(nx, ny, plate.length, plate.width)

    def interpolation_error(self, plate: Plate, frequency: float) -> float:
        """0: its polynomials are evaluated wherever they are asked for."""
        return 0.0


PlateMesh: TypeAlias = Mesh | SpectralMesh
"""Elements, or polynomials over the whole plate: they have the same properties and methods."""


def stretched(mesh: PlateMesh, plate: Plate) -> PlateMesh:
    """A mesh of its kind that resolves the same on a plate of another size."""
    nx, ny = (
        math.ceil(count * max(new / old, 1.0))
        for count, new, old in (
            (mesh.nx, plate.length, mesh.length),
            (mesh.ny, plate.width, mesh.width),
        )
    )
    return replace(mesh, nx=nx, ny=ny, length=plate.length, width=plate.width)
