"""Degrees of the polynomials over the plate, chosen for a frequency."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from model.errors import InputError
from model.fem.elements.element import rigidities
from model.spectral.functions import Direction
from model.spectral.local_compliance import local_compliance
from model.structure.plate import Plate

POLYNOMIALS = "Legendre"
"""Name in files and results, in place of an element's."""

MIN_DEGREE = 4
MAX_DEGREE = 100

# Degrees beyond pi for each wavelength on a side: with so many the bending waves are resolved, and
# with so many, and one more for each halving of the accuracy below 1 %, as accurately as wanted.
_RESOLVES = 2
_ACCURATE = 6

# Times 1 / p of the lower degree: error of the response by the largest K c, the share of an ERA's
# force that the unresolved compliance under it takes up (measured on 23 plates).
_ERROR_PER_DENT = 3.0

_FINER = 2  # further degrees to compare with

MAX_POLYNOMIALS = 5000
"""Of the deflection; so many take half a minute of processor time and 1.3 GB."""

_POINTS_PER_DEGREE = 8  # of the raster that shows a field: fifty to a wavelength


@dataclass(frozen=True)
class SpectralMesh:
    """Legendre polynomials up to degrees nx along x and ny along y, over length by width [m]."""

    nx: int
    ny: int
    length: float
    width: float

    element_name: ClassVar[str] = POLYNOMIALS
    strip: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        """Refuse degrees out of range."""
        if not MIN_DEGREE <= min(self.nx, self.ny) <= max(self.nx, self.ny) <= MAX_DEGREE:
            raise InputError(
                f"mesh: degrees must be {MIN_DEGREE} to {MAX_DEGREE}, got {self.nx}x{self.ny}"
            )

    @classmethod
    def accurate(
        cls, plate: Plate, *, frequency_max: float, accuracy: float, stiffness: float
    ) -> Self | None:
        """Choose degrees for a relative L2 error of the response up to a frequency [Hz].

        accuracy: that error, 0.01 for 1 %; stiffness [N/m]: of the stiffest ERA, whose force dents
        the plate under it. None where more than MAX_POLYNOMIALS would be needed.
        """
        half = plate.bending_wavelength(frequency_max) / math.pi
        more = _ACCURATE + max(0, math.ceil(math.log2(0.01 / accuracy)))
        x, y = plate.length / 2, plate.width / 2
        places = np.array([(x, y), (x, 0), (0, y)])  # where the polynomials resolve least
        while True:
            nx, ny = (
                max(MIN_DEGREE, math.ceil(side / half) + more)
                for side in (plate.length, plate.width)
            )
            if (nx + 1) * (ny + 1) > MAX_POLYNOMIALS or max(nx, ny) > MAX_DEGREE:
                return None
            dent = np.diagonal(local_compliance(plate, (nx, ny), places, places)).max()
            if _ERROR_PER_DENT / min(nx, ny) * stiffness * dent <= accuracy:
                return cls(nx, ny, plate.length, plate.width)
            more += 1

    def to_dict(self) -> dict[str, Any]:
        """Its fields for a file, with the element's name."""
        return asdict(self) | {"element": POLYNOMIALS}

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

    def highest_frequency(self, plate: Plate) -> float:
        """The highest frequency [Hz] whose bending waves in a plate it resolves."""
        return plate.bending_frequency(self.shortest_wavelength)

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

    def directions(self, plate: Plate) -> tuple[Direction, Direction]:
        """Functions along x and y."""
        bending, shear, _ = rigidities(plate)
        decay = math.sqrt(shear / bending[2, 2])
        return Direction(self.length, self.nx, decay), Direction(self.width, self.ny, decay)
