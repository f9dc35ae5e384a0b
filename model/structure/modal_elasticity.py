"""Stiffness and loss of each mode of a free plate, and the scaling of a solution to other plates.

A real plate is less homogeneous than theory: laminate, seams, air and edges change the lowest modes
individually. A plate can therefore state differences of the eigenvalue and the loss factor of its
lowest elastic modes (`Plate.mode_deviations`), and a power law of its loss factor over frequency.
Shapes and higher modes follow theory. Adhesives and air change the complex eigenvalues of modes
with frequency: their dispersion.

`Discretization` is the common base of finite-element and polynomial meshes: the shortest waves that
they resolve.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.structure.plate import LOSS_FREQUENCY, Plate


@dataclass(frozen=True, eq=False)
class Dispersion:
    """Change of the eigenvalues of r modes with frequency, zero at their own frequencies.

    frequencies (k,) [Hz], ascending; values (k, r) [rad²/s²]: for the mode's own shape; a cubic
    spline of the logarithm of frequency in between, constant outside.
    """

    frequencies: FloatArray
    values: ComplexArray

    def at(self, omega: FloatArray) -> ComplexArray:
        """At omega (f,) [rad/s], (f, r) [rad²/s²]."""
        low, high = self.frequencies[[0, -1]]
        frequencies = np.clip(np.asarray(omega) / (2 * np.pi), low, high)
        return np.asarray(self._spline(np.log(frequencies)))

    def padded(self, count: int) -> "Dispersion":
        """With further modes that do not change."""
        return Dispersion(self.frequencies, np.pad(self.values, ((0, 0), (0, count))))

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline  # which homogeneous plates do not need

        return CubicSpline(np.log(self.frequencies), self.values, axis=0)


def loss_factors(plate: Plate, omega: FloatArray) -> FloatArray:
    """Loss factor of the plate at omega [rad/s], of its shape."""
    return plate.loss_factor * _powers(plate, omega)


def lowest_elastic(eigenvalues: FloatArray, count: int) -> IntArray:
    """Return the indices of the lowest elastic modes among eigenvalues (r,), ascending, at most
    `count`.

    Equal eigenvalues, for example of a square plate, keep their order.
    """
    with np.errstate(divide="ignore"):
        order = np.argsort(np.round(np.log(np.maximum(eigenvalues, 0)), 9), kind="stable")
    elastic = order[eigenvalues[order] > 0]
    return elastic[:count]


@dataclass(frozen=True, eq=False)
class ModalElasticity:
    """Eigenvalues omega² (r,) [rad²/s²] of a plate, and loss factors (r,) relative to its own.

    losses (r,) [rad²/s²]: additional losses of modes in soft layers and air; dispersion: their
    change with frequency, None without any.
    """

    plate: Plate
    eigenvalues: FloatArray
    relative_loss: FloatArray
    losses: FloatArray
    dispersion: Dispersion | None = None

    @classmethod
    def of(
        cls,
        plate: Plate,
        eigenvalues: FloatArray,
        losses: FloatArray,
        dispersion: Dispersion | None = None,
    ) -> Self:
        """Return the elasticity of a plate with these theoretical values (r,), including all lowest
        modes."""
        deviations = np.array(plate.mode_deviations, dtype=float).reshape(-1, 2)
        if not len(deviations):
            return cls(plate, eigenvalues, np.ones(len(eigenvalues)), losses, dispersion)
        factors = np.ones((2, len(eigenvalues)))
        modes = lowest_elastic(eigenvalues, len(deviations))
        factors[:, modes] = np.exp(deviations[: len(modes)].T)
        return cls(
            plate, eigenvalues * factors[0], factors[1], losses * factors.prod(axis=0), dispersion
        )

    def loss_factors(self, omega: FloatArray) -> FloatArray:
        """Loss factor of each mode at omega (f,) [rad/s], (f, r)."""
        of_modes = np.multiply.outer(_powers(self.plate, omega), self.relative_loss)
        return self.plate.loss_factor * of_modes

    def stiffness(self, omega: FloatArray) -> ComplexArray:
        """Complex stiffness (1 + i eta) lambda of each mode at omega (f,), (f, r) [rad²/s²].

        With what soft layers and air add.
        """
        lossy = (1 + 1j * self.loss_factors(omega)) * self.eigenvalues
        return lossy + self.further(omega)

    def further(self, omega: FloatArray) -> ComplexArray:
        """What soft layers and air add to it at omega (f,), (f, r) or (r,) [rad²/s²]."""
        if self.dispersion is None:
            return np.asarray(1j * self.losses, dtype=complex)
        return 1j * self.losses + self.dispersion.at(omega)


WITHOUT_PART = (
    "measuring determines them again; leave it out of the rig file, and use era rig identify to "
    "find the plate that has it"
)
"""Remedy for operations that vary thickness and modulus regardless of the rig's uncertainty."""


def check_scales(
    plate: Plate,
    *factors: FloatArray | float,
    remedy: str = "set uncertainty.thickness and uncertainty.weather to 0",
) -> None:
    """Raise InputError for factors on thickness or modulus if a part of the plate does not scale.

    A solution serves for other plates through `modal_receptance`, unless the plate has parts whose
    mass or stiffness does not scale: fields of `Plate` without the metadata `scales`. remedy: the
    end of the message.
    """
    fixed_parts = [
        part.name
        for part in fields(plate)
        if not part.metadata.get("scales") and getattr(plate, part.name) != part.default
    ]
    if fixed_parts and any(np.any(np.asarray(factor) != 1) for factor in factors):
        raise InputError(
            f"plate.{fixed_parts[0]}: thickness and modulus must be the solved ones, since "
            f"this part does not scale with them; {remedy}"
        )


def check_measurable(plate: Plate) -> None:
    """Raise InputError for a plate with a part that stays: no measurement finds such a plate."""
    check_is_plate(plate, "a fit of thickness, size and modulus")
    check_scales(plate, np.inf, remedy=WITHOUT_PART)


def check_is_plate(plate: Plate, what: str) -> None:
    """Raise InputError for a surface given by modes, for operations that need a plate."""
    if plate.surface is not None:
        raise InputError(
            f"surface: {what} requires a plate, got a surface given by modes, which has no "
            "thickness, size or modulus; give plate instead, or export other modes"
        )


def modal_receptance(
    stiffness: ComplexArray, omega: FloatArray, thickness: FloatArray | float = 1.0
) -> ComplexArray:
    """Return the receptance of modes with a complex stiffness (..., f, r) [rad²/s²], (..., f, r)
    [s²/kg].

    1 / (h (h² stiffness - omega²)) for plates with relative thickness h (...): thin ones, whose
    stiffness is proportional to h³.
    """
    h = np.asarray(thickness)[..., None, None]
    return np.asarray(1 / (h * (h**2 * stiffness - (omega**2)[:, None])), dtype=complex)


def _powers(plate: Plate, omega: FloatArray) -> FloatArray:
    ratio = np.abs(omega) / (2 * np.pi * LOSS_FREQUENCY)
    return ratio**plate.loss_exponent


@dataclass(frozen=True)
class Discretization(ABC):
    """nx by ny elements, or polynomials of degrees nx and ny, over length by width [m]."""

    nx: int
    ny: int
    length: float
    width: float

    @property
    @abstractmethod
    def shortest_wavelength(self) -> float:
        """The shortest bending wavelength [m] that it resolves."""

    @abstractmethod
    def resolving(self, plate: Plate, frequency: float) -> Self:
        """Return the coarsest of its kind that resolves a frequency [Hz]."""

    def stretched(self, plate: Plate) -> Self:
        """Return one of its kind that resolves the same on a plate of another size."""
        nx = math.ceil(self.nx * max(plate.length / self.length, 1.0))
        ny = math.ceil(self.ny * max(plate.width / self.width, 1.0))
        return replace(self, nx=nx, ny=ny, length=plate.length, width=plate.width)

    def interpolation_error(self, plate: Plate, frequency: float) -> float:
        """Largest relative error of a wave between nodes; 0 if any point can be evaluated."""
        return 0.0

    def highest_frequency(self, plate: Plate) -> float:
        """The highest frequency [Hz] whose bending waves in a plate it resolves."""
        return plate.bending_frequency(self.shortest_wavelength)

    def check_frequencies(self, plate: Plate, frequencies: FloatArray) -> None:
        """Raise InputError for frequencies (f,) [Hz] not above zero, or too high for it."""
        for frequency in frequencies:
            if not (np.isfinite(frequency) and frequency > 0):
                raise InputError(f"frequency must be above zero, got {frequency} Hz")
        highest, resolved = max(frequencies, default=0.0), self.highest_frequency(plate)
        if highest > resolved:
            raise InputError(
                f"frequency must be at most {resolved:g} Hz, which mesh {self} resolves, got "
                f"{highest:g} Hz; use mesh {self.resolving(plate, highest)} or finer, or with "
                f"mesh: auto raise the upper limits.frequency to {highest:g} Hz"
            )
