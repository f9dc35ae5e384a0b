"""Mesh of a plate: polynomials of two degrees, finite elements, or the modes of another program.

`SpectralMesh` chooses the degrees of Legendre polynomials over the whole plate for a highest
frequency and an accuracy. `KnownModes` takes the place of a mesh for a surface whose modes are
known. All meshes are a `model.structure.modal_elasticity.Discretization`.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self, TypeAlias

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.fem import Mesh
from model.spectral.unresolved_compliance import edge_compliance
from model.structure.modal_elasticity import Discretization
from model.structure.plate import Plate
from model.structure.surface import EDGES, LEAST_KNOWN, Surface

POLYNOMIALS = "Legendre"
"""Name in files and results, in place of an element's."""

MIN_DEGREE = 4
MAX_DEGREE = 200

MAX_POLYNOMIALS = 6000
"""Largest number of polynomials of the deflection that `SpectralMesh.accurate` chooses.

They take some seconds of processor time and 1.5 GB.
"""

_MAX_NAMED = 8000  # polynomials of a mesh that a user states: ten seconds and 2 GB

# Degrees of a side beyond pi for each of its wavelengths: so many resolve the bending waves.
_TO_RESOLVE = 2
# So many represent the waves within 1 %, with more for each further factor of ten.
_TO_ONE_PERCENT, _PER_DECADE = 4.3, 1.5
# Above this number of waves (times pi), further degrees grow with its cube root, as the turning
# point of a polynomial widens.
_MANY_WAVES = 9.0

# Relative error of the response by the unresolved compliance in the middle of an edge, at degree
# _AT_DEGREE, measured on 23 plates. It falls with the degree to the power _FALLS. One part is
# proportional to the stiffness of an ERA, and larger on a small plate by the square of the
# wavelength over the area. The other is proportional to the dynamic stiffness of an infinite plate,
# since the field of a force is wrong away from the force, too.
_PER_STIFFNESS, _ON_SMALL_PLATES, _PER_WAVE_STIFFNESS = 0.1, 2.0, 0.02
_AT_DEGREE, _FALLS = 13, 0.8
# A plate does not distinguish ERAs that are much stiffer than this multiple of its wave stiffness.
_AS_IF_RIGID = 10

_FINER = 2  # further degrees of the mesh for the discretization error

_POINTS_PER_DEGREE = 8  # of the raster that shows a field: fifty to a wavelength


@dataclass(frozen=True)
class SpectralMesh(Discretization):
    """Legendre polynomials up to degrees nx along x and ny along y, over length by width [m]."""

    element_name: ClassVar[str] = POLYNOMIALS
    strip: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        """Reject degrees out of range."""
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
        the plate under it; foot [m]: smallest contact radius, 0 for a point. None if more than
        MAX_POLYNOMIALS would be needed.
        """
        wavelength = plate.bending_wavelength(frequency_max)
        wave_stiffness = plate.wave_stiffness(frequency_max)
        smallness = wavelength**2 / (plate.length * plate.width)
        effective_stiffness = stiffness / (1 + stiffness / (_AS_IF_RIGID * wave_stiffness))
        error_per_compliance = _PER_STIFFNESS * (1 + _ON_SMALL_PLATES * smallness)
        error_per_compliance *= effective_stiffness
        error_per_compliance += _PER_WAVE_STIFFNESS * wave_stiffness
        further_degrees = _TO_ONE_PERCENT + _PER_DECADE * max(0.0, math.log10(0.01 / accuracy))
        degrees = []
        for side in (plate.length, plate.width):
            waves = math.pi * side / wavelength
            further = further_degrees * max(1, waves / _MANY_WAVES) ** (1 / 3)
            lowest = max(MIN_DEGREE, math.ceil(waves + further))
            candidates = np.arange(lowest, MAX_DEGREE + 1)
            errors = error_per_compliance * (_AT_DEGREE / candidates) ** _FALLS
            errors *= edge_compliance(plate, side, candidates, foot)
            accurate = candidates[errors <= accuracy]
            if not len(accurate):
                return None
            degrees.append(int(accurate[0]))
        nx, ny = degrees
        if (nx + 1) * (ny + 1) > MAX_POLYNOMIALS:
            return None
        return cls(nx, ny, plate.length, plate.width)

    def __str__(self) -> str:
        return f"{self.nx}x{self.ny} {POLYNOMIALS}"

    @property
    def dof(self) -> int:
        """Number of degrees of freedom: polynomials of w, and of the rotations with edge layers."""
        w = (self.nx + 1) * (self.ny + 1)
        return w + 2 * (self.nx + 3) * (self.ny + 3)

    @property
    def raster(self) -> tuple[int, int]:
        """Numbers of evenly spaced points along x and y that show all resolved details."""
        return _POINTS_PER_DEGREE * self.nx + 1, _POINTS_PER_DEGREE * self.ny + 1

    @property
    def shortest_wavelength(self) -> float:
        """The shortest bending wavelength [m] that it resolves."""
        sides = (self.length / (self.nx - _TO_RESOLVE), self.width / (self.ny - _TO_RESOLVE))
        return math.pi * max(sides)

    def finer(self) -> Self:
        """Return the mesh with which to compare for the discretization error."""
        return replace(self, nx=self.nx + _FINER, ny=self.ny + _FINER)

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """Lowest degrees that resolve a frequency [Hz]."""
        per_degree = plate.bending_wavelength(frequency) / math.pi
        nx = max(MIN_DEGREE, math.ceil(plate.length / per_degree) + _TO_RESOLVE)
        ny = max(MIN_DEGREE, math.ceil(plate.width / per_degree) + _TO_RESOLVE)
        return type(self)(nx, ny, plate.length, plate.width)


@dataclass(frozen=True)
class KnownModes(Discretization):
    """In place of a mesh: nx modes of a surface up to a frequency [Hz]; ny is 1."""

    frequency: float
    element_name: ClassVar[str] = "modes"
    strip: ClassVar[float] = 0.0

    @classmethod
    def of(cls, plate: Plate, surface: Surface) -> Self:
        """Return the modes of a surface file; plate: its equivalent plate."""
        frequency_factor = surface.frequency_factor(plate.thickness, plate.material.E)
        highest = frequency_factor * surface.frequency
        return cls(surface.count, 1, plate.length, plate.width, highest)

    def __str__(self) -> str:
        return f"{self.nx} modes up to {self.frequency:.0f} Hz"

    @property
    def dof(self) -> int:
        """Number of degrees of freedom, one for each mode."""
        return self.nx

    @property
    def raster(self) -> tuple[int, int]:
        """Numbers of evenly spaced points along x and y that show its highest mode."""
        spacing = self.shortest_wavelength / (2 * _POINTS_PER_DEGREE)
        return math.ceil(self.length / spacing) + 1, math.ceil(self.width / spacing) + 1

    @property
    def shortest_wavelength(self) -> float:
        """Bending wavelength [m] of the highest mode, estimated from the number of modes."""
        return math.sqrt(EDGES * math.pi * self.length * self.width / self.nx)

    def highest_frequency(self, plate: Plate) -> float:
        """The highest frequency [Hz] at which enough modes are known."""
        return self.frequency / LEAST_KNOWN

    def check_frequencies(self, plate: Plate, frequencies: FloatArray) -> None:
        """Raise InputError for frequencies (f,) [Hz] not above zero, or too high for the modes."""
        highest = self.highest_frequency(plate)
        for frequency in frequencies:
            if not 0 < frequency <= highest:
                raise InputError(
                    f"frequency must be above zero and at most {highest:.4g} Hz, got {frequency:g} "
                    f"Hz: the surface has {self}, {LEAST_KNOWN:g} times that; export more modes"
                )

    def finer(self) -> Self:
        """Return itself: there is no finer solution."""
        return self

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """The modes that would be enough at a frequency [Hz]."""
        needed = LEAST_KNOWN * frequency
        return replace(self, nx=math.ceil(self.nx * needed / self.frequency), frequency=needed)

    def stretched(self, plate: Plate) -> Self:
        """Return the same modes over the sides of another plate."""
        return replace(self, length=plate.length, width=plate.width)


PlateMesh: TypeAlias = Mesh | SpectralMesh | KnownModes
"""Any mesh of a plate."""
