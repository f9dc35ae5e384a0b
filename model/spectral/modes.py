"""Modes of one symmetry class of a plate, of one layer or several, with the air behind it.

Displacements along the plate follow the deflection (`stiffness.follow`): what vibrates is the
deflection, and the air. Moduli that depend on the frequency or lose energy, and the friction of
air, are taken for every mode at its own natural frequency: the complex mode is solved for in the
space of the lowest modes of three real plates, whose moduli span those of the frequencies in
question. Its imaginary eigenvalue is its loss; at other frequencies the mode keeps its shape, and
has another eigenvalue. Modes beyond them are those of the plate at the middle frequency.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray
from model.spectral.functions import EdgedFunctions, edge_decays
from model.spectral.stiffness import (
    AirMotion,
    ClassFunctions,
    air_motion,
    along_mass,
    class_stiffness,
    follow,
)
from model.structure.laminate_section import (
    interface_mass,
    opposite_motions,
    section_of,
    shear_corrections,
)
from model.structure.plate import LaminateLayer, Plate

NODES = 12
"""Frequencies of a band at which modes state their stiffness."""

_SPAN = 1.5  # of the moduli of the three plates where only losses matter
_DEPENDENT = 1e-10  # share of the largest below which directions of the space are left out
_STEPS = 12  # of the iteration for a complex mode, which takes three or four


_functions = lru_cache(maxsize=16)(EdgedFunctions)


@dataclass(frozen=True, eq=False)
class SpectralClass:
    """Modes of a symmetry class of m polynomials of the deflection.

    eigenvalues omega² (r,) and losses (r,) [rad²/s²], the imaginary part beyond the plate's loss
    factor times omega²; below zero of air that vibrates by itself, which has less; dispersion (k,
    r): what is to be added to them at the frequencies of the band; truncated (t,): eigenvalues of
    the other modes; shapes (m, r + t): polynomials of the deflection, of all.
    """

    eigenvalues: FloatArray
    losses: FloatArray
    dispersion: ComplexArray
    truncated: FloatArray
    shapes: FloatArray


@dataclass(frozen=True, eq=False)
class Band:
    """Frequencies [Hz] at which moduli and air are taken: lowest, middle and highest."""

    low: float
    high: float

    @property
    def frequencies(self) -> FloatArray:
        """Evenly spaced in the logarithm, from a third of the lowest to the highest."""
        return np.geomspace(self.low / 3, self.high, NODES)

    @property
    def middle(self) -> float:
        """The geometric mean."""
        return math.sqrt(self.low * self.high)

    def within(self, eigenvalue: float) -> float:
        """The frequency of an eigenvalue omega² [rad²/s²], limited to the band."""
        frequency = math.sqrt(max(eigenvalue, 0.0)) / (2 * math.pi)
        return min(max(frequency, self.low), self.high)


def layers_of(plate: Plate) -> tuple[LaminateLayer, ...]:
    """The layers of a plate; of a homogeneous one itself."""
    if plate.laminate is not None:
        return plate.laminate.layers
    return (LaminateLayer(plate.material, plate.thickness),)


class SpectralPlate:
    """A plate in polynomials up to degrees along x and y, class by class."""

    def __init__(self, plate: Plate, degrees: tuple[int, int], middle: float) -> None:
        self._plate = plate
        self._layers = layers_of(plate)
        self._corrections = shear_corrections(self._layers)
        self._opposite = opposite_motions(self._layers)
        self._mass = self._opposite.T @ interface_mass(self._layers) @ self._opposite
        moduli = [layer.modulus(middle) for layer in self._layers]
        section = section_of(self._layers, moduli, self._corrections)
        nx, ny = degrees
        self._x = _functions(plate.length, nx, edge_decays(section, 0))
        # A degree of 0 is a strip of an infinite width: nothing varies along y.
        self._y = _functions(plate.width, ny, edge_decays(section, 1) if ny else ())

    def functions(self, parity: tuple[int, int]) -> ClassFunctions:
        """Functions of a symmetry class."""
        return ClassFunctions(self._x, self._y, parity, len(self._mass))

    def modes(
        self, parity: tuple[int, int], *, shift: float, cut: float, band: Band
    ) -> SpectralClass:
        """Solve a class for all modes, and for those below the cut [rad²/s²] with their losses.

        shift [rad²/s²]: of the order of the lowest ones.
        """
        of, gap = self.functions(parity), self._plate.air_gap
        air = None if gap is None else air_motion(of, gap)
        middle = [layer.modulus(band.middle).real for layer in self._layers]
        K, M, _ = self._condensed(of, air, middle, band.middle, shift)
        eigenvalues, q = linalg.eigh(K, M, check_finite=False)
        eigenvalues[np.abs(eigenvalues) < 1e-6 * shift] = 0.0
        count = int(np.searchsorted(eigenvalues, cut))
        kept, losses = eigenvalues[:count].copy(), np.zeros(count)
        dispersion, own = np.zeros((NODES, count), dtype=complex), 1 + 1j * self._plate.loss_factor
        shapes = q[: of.deflections].copy()
        if count and (air is not None or not all(layer.is_elastic for layer in self._layers)):
            space = _Space(self, of, air, band, shift, count)
            for number in range(count):
                value, shape, elsewhere = space.mode(number, float(eigenvalues[number]))
                value = complex(value.real if eigenvalues[number] else 0.0, value.imag)
                kept[number] = value.real
                losses[number] = max(value.imag, 0.0) - self._plate.loss_factor * value.real
                dispersion[:, number] = elsewhere - kept[number] * own - 1j * losses[number]
                shapes[:, number] = shape
        return SpectralClass(kept, losses, dispersion, eigenvalues[count:], shapes)

    def _inertia(self, of: ClassFunctions) -> FloatArray:
        """Mass between the polynomials of the deflection, (m, m)."""
        return sum(layer.surface_density for layer in self._layers) * np.eye(of.deflections)

    def _stiffness(self, of: ClassFunctions, moduli: Sequence[float]) -> FloatArray:
        section = section_of(self._layers, moduli, self._corrections)
        return class_stiffness(of, section.in_motions(self._opposite))

    def _condensed(
        self,
        of: ClassFunctions,
        air: AirMotion | None,
        moduli: Sequence[float],
        frequency: float,
        shift: float,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Stiffness and mass in deflection and flows, and what follows the deflection."""
        m = of.deflections
        K = self._stiffness(of, moduli)
        follows = follow(of, K, self._mass, shift)
        rotary = follows.T @ along_mass(of, self._mass, follows)
        stiffness = K[:m, :m] + K[:m, m:] @ follows - shift * rotary
        mass = self._inertia(of) + rotary
        gap = self._plate.air_gap
        if air is not None and gap is not None:
            own, mass_of_w = stiffness, mass
            stiffness = gap.bulk_modulus(frequency).real * air.stiffness
            stiffness[:m, :m] += own
            mass = np.diag(gap.inertia(frequency).real * air.inertia)
            mass[:m, :m] = mass_of_w
        return (stiffness + stiffness.T) / 2, (mass + mass.T) / 2, follows


class _Space:
    """Space of the lowest modes of real plates in which complex ones are solved for."""

    def __init__(
        self,
        plate: SpectralPlate,
        of: ClassFunctions,
        air: AirMotion | None,
        band: Band,
        shift: float,
        count: int,
    ) -> None:
        self._band, self._gap = band, plate._plate.air_gap
        self._loss_factor = plate._plate.loss_factor
        layers, m = plate._layers, of.deflections
        deflections, alongs, flows = [], [], []
        for frequency, factor in ((band.middle, 1), (band.low, 1 / _SPAN), (band.high, _SPAN)):
            moduli = [
                layer.modulus(frequency).real * (1 if layer.is_elastic else factor)
                for layer in layers
            ]
            K, M, follows = plate._condensed(of, air, moduli, frequency, shift)
            last = min(count + 1, len(K)) - 1
            _, q = linalg.eigh(K, M, subset_by_index=[0, last], check_finite=False)
            deflections.append(q[:m])
            alongs.append(follows @ q[:m])
            flows.append(q[m:])
        w, u, a = (np.hstack(each) for each in (deflections, alongs, flows))
        along = np.vstack([w, u])
        heavy = w.T @ plate._inertia(of) @ w + u.T @ along_mass(of, plate._mass, u)
        if air is not None and self._gap is not None:
            moving = np.vstack([w, a])
            self._air_mass = moving.T @ (air.inertia[:, None] * moving)
            self._air_stiffness = moving.T @ air.stiffness @ moving
            whole = heavy + self._gap.inertia(band.middle).real * self._air_mass
        else:
            self._air_mass = self._air_stiffness = np.zeros_like(heavy)
            whole = heavy
        sizes, directions = linalg.eigh((whole + whole.T) / 2)
        chosen = sizes > _DEPENDENT * sizes[-1]
        basis = directions[:, chosen] / np.sqrt(sizes[chosen])
        self._soft = [layer for layer in layers if not layer.is_elastic]
        fixed = [layer.material.E if layer.is_elastic else 0.0 for layer in layers]
        unit = [[float(each is soft) for each in layers] for soft in self._soft]
        self._fixed, *self._by_layer = (
            basis.T @ (along.T @ (plate._stiffness(of, moduli) @ along)) @ basis
            for moduli in (fixed, *unit)
        )
        self._mass = basis.T @ heavy @ basis
        self._air_mass, self._air_stiffness = (
            basis.T @ each @ basis for each in (self._air_mass, self._air_stiffness)
        )
        self._deflections = w @ basis
        self._starts = basis.T @ whole[:, : last + 1]

    def mode(self, number: int, eigenvalue: float) -> tuple[complex, FloatArray, ComplexArray]:
        """Complex eigenvalue [rad²/s²] of a mode near a real one, and its deflection (m,).

        And what it is at the frequencies of the band, in its own shape, (k,).
        """
        value, start = complex(eigenvalue), self._starts[:, number].astype(complex)
        mode = start
        for _ in range(_STEPS):
            A, B = self._matrices(self._band.within(value.real))
            before, value = value, (mode @ A @ mode) / (mode @ B @ mode)
            if abs(value - before) <= 1e-10 * (abs(value) + 1.0):
                break
            mode = np.linalg.solve(A - value * (1 + 1e-12) * B, B @ mode)
            mode /= np.linalg.norm(mode)
        if not _is_alike(mode, start):
            values, modes = np.linalg.eig(np.linalg.solve(B, A))
            nearest = int(np.argmax(np.abs(start @ self._mass @ modes)))
            value, mode = complex(values[nearest]), modes[:, nearest]
        mode = mode / np.sqrt(mode @ B @ mode)
        elsewhere = [
            mode @ A @ mode + (2 * math.pi * frequency) ** 2 * (1 - mode @ B @ mode)
            for frequency, (A, B) in zip(self._band.frequencies, self._at_nodes, strict=True)
        ]
        return value, self._deflections @ mode.real, np.array(elsewhere)

    @cached_property
    def _at_nodes(self) -> list[tuple[ComplexArray, FloatArray]]:
        return [self._matrices(frequency) for frequency in self._band.frequencies]

    def _matrices(self, frequency: float) -> tuple[ComplexArray, FloatArray]:
        """Stiffness with all losses, and mass, at a frequency [Hz]."""
        stiffness = self._fixed * (1 + 1j * self._loss_factor)
        for layer, own in zip(self._soft, self._by_layer, strict=True):
            modulus = layer.modulus(frequency)
            stiffness += (modulus + 1j * self._loss_factor * modulus.real) * own
        mass = self._mass
        if self._gap is not None:
            inertia, omega = self._gap.inertia(frequency), 2 * math.pi * frequency
            stiffness += self._gap.bulk_modulus(frequency) * self._air_stiffness
            stiffness -= 1j * omega**2 * inertia.imag * self._air_mass
            mass = mass + inertia.real * self._air_mass
        return stiffness, mass


def _is_alike(mode: ComplexArray, start: ComplexArray) -> bool:
    """Whether a mode (n,) is still mostly the one that it was solved from."""
    norms = np.vdot(mode, mode) * np.vdot(start, start)
    return bool(abs(np.vdot(mode, start)) ** 2 > 0.5 * norms.real)
