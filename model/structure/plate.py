"""The touch plate: its material, dimensions and closed-form properties."""

import math
from dataclasses import dataclass, replace

from model.errors import InputError
from model.structure.air_gap import AirGap
from model.structure.laminate import Laminate
from model.structure.material import Material

MAX_LOSS_EXPONENT = 2.0

LOSS_FREQUENCY = 150.0
"""Frequency [Hz] at which a plate has its loss factor, where that varies."""


@dataclass(frozen=True)
class Plate:
    """A rectangular plate of constant thickness with its corner at the origin.

    length [m] along x, width [m] along y, thickness [m]; loss_factor is the structural loss
    factor eta of a hysteretic stiffness (1 + i eta) K. The paper does not print it; 1 % is the
    usual order for a metal or glass panel with its bonded layers. It is the one at LOSS_FREQUENCY
    and varies as the power loss_exponent of the frequency. mode_deviations: of the lowest elastic
    modes, ascending, logarithms of eigenvalue and loss factor relative to those of the theory, as
    `era rig identify` finds them (`model.structure.modal_elasticity`).
    """

    length: float
    width: float
    thickness: float
    material: Material
    loss_factor: float = 0.01
    loss_exponent: float = 0.0
    mode_deviations: tuple[tuple[float, float], ...] = ()
    laminate: Laminate | None = None
    air_gap: AirGap | None = None

    def __post_init__(self) -> None:
        """Refuse dimensions out of range."""
        for key in ("length", "width", "thickness"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"plate: {key} must be above zero, got {value} m")
        if not (math.isfinite(self.loss_factor) and 0 <= self.loss_factor < 1):
            raise InputError(
                f"plate: loss_factor must be between 0 and 1, got {self.loss_factor} (0.01 is 1 %)"
            )
        if not abs(self.loss_exponent) <= MAX_LOSS_EXPONENT:  # False for NaN
            raise InputError(
                f"plate: loss_exponent must be between -{MAX_LOSS_EXPONENT:g} and "
                f"{MAX_LOSS_EXPONENT:g}, got {self.loss_exponent}"
            )
        # A file gives lists; only tuples can be compared and hashed with the rest.
        deviations = tuple((float(a), float(b)) for a, b in self.mode_deviations)
        object.__setattr__(self, "mode_deviations", deviations)
        if not all(abs(a) <= 0.5 and abs(b) <= 5 for a, b in deviations):
            raise InputError(
                "plate: logarithms of mode_deviations must be up to 0.5 of an eigenvalue and 5 of "
                f"a loss factor, got {deviations}"
            )

    @property
    def is_layered(self) -> bool:
        """Whether it is solved by layers and with the air behind it, in polynomials only."""
        return self.laminate is not None or self.air_gap is not None

    def scaled(self, *, modulus: float = 1.0, thickness: float = 1.0) -> "Plate":
        """The plate with its moduli and thickness, those of every layer, times a factor."""
        laminate = self.laminate
        return replace(
            self,
            material=replace(self.material, E=modulus * self.material.E),
            thickness=thickness * self.thickness,
            laminate=laminate and laminate.scaled(modulus=modulus, thickness=thickness),
        )

    @property
    def mass(self) -> float:
        """Mass of the bare plate [kg]."""
        return self.material.rho * self.thickness * self.length * self.width

    @property
    def flexural_rigidity(self) -> float:
        """Flexural rigidity D = E h³ / 12 (1 - nu²) [N m], paper Eq. 7."""
        return self.material.E * self.thickness**3 / (12 * (1 - self.material.nu**2))

    @property
    def lowest_bending_frequency(self) -> float:
        """Lowest frequency [Hz] of a strip of the plate's longer side on two simple supports.

        The order of magnitude of the plate's lowest modes for any support.
        """
        surface_density = self.material.rho * self.thickness
        side = max(self.length, self.width)
        return math.pi / 2 * math.sqrt(self.flexural_rigidity / surface_density) / side**2

    def bending_wavelength(self, frequency: float) -> float:
        """Wavelength [m] of a bending wave at a frequency [Hz] in the thin-plate limit."""
        omega = 2 * math.pi * frequency
        surface_density = self.material.rho * self.thickness
        wavenumber = (surface_density * omega**2 / self.flexural_rigidity) ** 0.25
        return float(2 * math.pi / wavenumber)

    def bending_frequency(self, wavelength: float) -> float:
        """Frequency [Hz] of a bending wave of a wavelength [m] in the thin-plate limit."""
        surface_density = self.material.rho * self.thickness
        return 2 * math.pi / wavelength**2 * math.sqrt(self.flexural_rigidity / surface_density)

    def wave_stiffness(self, frequency: float) -> float:
        """Dynamic stiffness of an infinite plate under a point force, |F / w| [N/m]."""
        surface_density = self.material.rho * self.thickness
        omega = 2 * math.pi * frequency
        return 8 * omega * math.sqrt(self.flexural_rigidity * surface_density)

    def modes_below(self, frequency: float) -> int:
        """Number of modes of the free plate up to a frequency [Hz], as an estimate.

        Area term of the mode count of a thin plate, pi S / wavelength², and a quarter more for its
        edges.
        """
        wavelength = self.bending_wavelength(frequency)
        return math.ceil(1.25 * math.pi * self.length * self.width / wavelength**2)

    def contains(self, x: float, y: float) -> bool:
        """Whether a point [m] lies on the plate, its edges included."""
        return 0 <= x <= self.length and 0 <= y <= self.width
