"""Natural modes of a plate in Legendre polynomials, one symmetry class at a time.

The plate has one layer or several, with the air around and behind it. Displacements along the plate
follow the deflection (`model.spectral.polynomials.follow`): only the deflection and the air
vibrate.

Moduli that depend on the frequency or lose energy, and the friction of air, make modes complex.
They are evaluated for every mode at its own natural frequency: the complex mode is solved in the
space of the lowest modes of three real plates, whose moduli span the frequency range. The imaginary
part of its eigenvalue is its loss. At other frequencies the mode keeps its shape and has another
eigenvalue. Higher modes belong to the plate at the middle frequency.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.spectral.polynomials import (
    AirMotion,
    ClassFunctions,
    EdgedFunctions,
    air_motion,
    along_mass,
    class_stiffness,
    edge_decays,
    follow,
)
from model.spectral.surrounding_air import added_mass
from model.structure.laminate_bending import (
    interface_mass,
    opposite_motions,
    section_of,
    shear_corrections,
)
from model.structure.plate import LaminateLayer, Plate

NODES = 12
"""Frequencies of a band at which modes state their stiffness."""

_SPAN = 1.5  # of the moduli of the three plates if only losses matter
_RIGID = 1e-6  # times the shift: eigenvalues below are rounding of rigid motions
_DEPENDENT = 1e-10  # share of the largest below which directions of the space are dropped
_STEPS = 12  # of the iteration for a complex mode, which takes three or four
_TOLERANCE = 1e-10  # relative change of an eigenvalue in the last step

_functions = lru_cache(maxsize=16)(EdgedFunctions)


@dataclass(frozen=True, eq=False)
class SpectralClass:
    """Modes of a symmetry class of m polynomials of the deflection.

    eigenvalues omega² (r,) and losses (r,) [rad²/s²]: losses are the imaginary part beyond the
    plate's loss factor times omega²; negative for vibration of the air itself, which has smaller
    losses. dispersion (k, r): change of both at the frequencies of the band. truncated (t,):
    eigenvalues of the other modes. shapes (m, r + t): polynomials of the deflection of all modes.
    """

    eigenvalues: FloatArray
    losses: FloatArray
    dispersion: ComplexArray
    truncated: FloatArray
    shapes: FloatArray


@dataclass(frozen=True, eq=False)
class MaterialBand:
    """Frequencies [Hz] at which moduli and air are evaluated: lowest, middle and highest."""

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
        return min(max(_frequency_of(eigenvalue), self.low), self.high)


def _frequency_of(eigenvalue: float) -> float:
    """The frequency [Hz] of an eigenvalue omega² [rad²/s²]."""
    return math.sqrt(max(eigenvalue, 0.0)) / (2 * math.pi)


def layers_of(plate: Plate) -> tuple[LaminateLayer, ...]:
    """The layers of a laminate; a homogeneous plate has one."""
    if plate.laminate is not None:
        return plate.laminate.layers
    return (LaminateLayer(plate.material, plate.thickness),)


class SpectralPlate:
    """Matrices and modes of a plate in polynomials up to degrees along x and y, by class.

    middle [Hz]: frequency of the moduli that decide the boundary layers at the edges.
    """

    def __init__(self, plate: Plate, degrees: tuple[int, int], middle: float) -> None:
        self.plate = plate
        self.layers = layers_of(plate)
        self._corrections = shear_corrections(self.layers)
        self._motions = opposite_motions(self.layers)
        self.interface_mass = self._motions.T @ interface_mass(self.layers) @ self._motions
        moduli = [layer.modulus(middle) for layer in self.layers]
        section = section_of(self.layers, moduli, self._corrections)
        nx, ny = degrees
        self._x = _functions(plate.length, nx, edge_decays(section, 0))
        # A degree of 0 is a strip of an infinite width: nothing varies along y.
        self._y = _functions(plate.width, ny, edge_decays(section, 1) if ny else ())

    def functions(self, parity: tuple[int, int]) -> ClassFunctions:
        """Functions of a symmetry class."""
        return ClassFunctions(self._x, self._y, parity, len(self.interface_mass))

    def modes(
        self, parity: tuple[int, int], *, shift: float, cut: float, band: MaterialBand
    ) -> SpectralClass:
        """Solve a class for all modes, and for those below the cut [rad²/s²] with their losses.

        shift [rad²/s²]: of the order of the lowest ones.
        """
        functions = self.functions(parity)
        gap = self.plate.air_gap
        air = None if gap is None else air_motion(functions, gap)
        moduli = [layer.modulus(band.middle).real for layer in self.layers]
        K, M, _ = self.condensed(functions, air, moduli, band.middle, shift)
        eigenvalues, vectors = linalg.eigh(K, M, check_finite=False)
        eigenvalues[np.abs(eigenvalues) < _RIGID * shift] = 0.0
        count = int(np.searchsorted(eigenvalues, cut))
        real_modes = SpectralClass(
            eigenvalues=eigenvalues[:count],
            losses=np.zeros(count),
            dispersion=np.zeros((NODES, count), dtype=complex),
            truncated=eigenvalues[count:],
            shapes=vectors[: functions.deflections].copy(),
        )
        is_lossy = air is not None or not all(layer.is_elastic for layer in self.layers)
        if not count or not is_lossy:
            return real_modes
        space = _ModalSpace(self, functions, air, band, shift, count)
        return self._complex_modes(real_modes, space)

    def _complex_modes(self, modes: SpectralClass, space: "_ModalSpace") -> SpectralClass:
        """Replace real modes by the complex ones near them, with losses and dispersion."""
        loss_factor = self.plate.loss_factor
        values = modes.eigenvalues.copy()
        losses = modes.losses.copy()
        dispersion = modes.dispersion.copy()
        shapes = modes.shapes.copy()
        for number, real_value in enumerate(modes.eigenvalues.tolist()):
            complex_value, shape, values_in_band = space.mode(number, real_value)
            value = complex_value.real if real_value else 0.0
            loss = max(complex_value.imag, 0.0) - loss_factor * value
            values[number] = value
            losses[number] = loss
            dispersion[:, number] = values_in_band - value * (1 + 1j * loss_factor) - 1j * loss
            shapes[:, number] = shape
        return replace(
            modes, eigenvalues=values, losses=losses, dispersion=dispersion, shapes=shapes
        )

    def deflection_mass(self, functions: ClassFunctions) -> FloatArray:
        """Mass of plate and open air between the polynomials of the deflection, (m, m)."""
        density = sum(layer.surface_density for layer in self.layers)
        mass = density * np.eye(functions.deflections)
        if self.plate.air is not None:
            x, y = functions.x, functions.y
            sides, degrees = (x.length, y.length), (x.degree, y.degree)
            mass += added_mass(self.plate.air, sides, degrees, functions.parity)
        return mass

    def stiffness(self, functions: ClassFunctions, moduli: Sequence[float]) -> FloatArray:
        """Return the stiffness matrix of a parity class; moduli: Young's modulus of each layer."""
        section = section_of(self.layers, moduli, self._corrections)
        return class_stiffness(functions, section.in_motions(self._motions))

    def condensed(
        self,
        functions: ClassFunctions,
        air: AirMotion | None,
        moduli: Sequence[float],
        frequency: float,
        shift: float,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return stiffness and mass in deflection and flows of air, for real moduli.

        Also returns the displacements along the plate that follow unit deflections.
        """
        w = slice(0, functions.deflections)
        along = slice(functions.deflections, None)
        K = self.stiffness(functions, moduli)
        follows = follow(functions, K, self.interface_mass, shift)
        rotary = follows.T @ along_mass(functions, self.interface_mass, follows)
        stiffness = K[w, w] + K[w, along] @ follows - shift * rotary
        mass = self.deflection_mass(functions) + rotary
        gap = self.plate.air_gap
        if air is not None and gap is not None:
            plate_stiffness = stiffness
            plate_mass = mass
            stiffness = gap.bulk_modulus(frequency).real * air.stiffness
            stiffness[w, w] += plate_stiffness
            mass = np.diag(gap.inertia(frequency).real * air.inertia)
            mass[w, w] = plate_mass
        return (stiffness + stiffness.T) / 2, (mass + mass.T) / 2, follows


class _ModalSpace:
    """Space of the lowest modes of three real plates, for solving complex modes."""

    def __init__(
        self,
        plate: SpectralPlate,
        functions: ClassFunctions,
        air: AirMotion | None,
        band: MaterialBand,
        shift: float,
        count: int,
    ) -> None:
        self._band = band
        self._gap = plate.plate.air_gap
        self._loss_factor = plate.plate.loss_factor
        w, u, a, start_count = self._real_modes(plate, functions, air, shift, count)
        modes = np.vstack([w, u])
        along = along_mass(functions, plate.interface_mass, u)
        plate_mass = w.T @ plate.deflection_mass(functions) @ w + u.T @ along
        air_mass = np.zeros_like(plate_mass)
        air_stiffness = air_mass
        mass = plate_mass
        if air is not None and self._gap is not None:
            moving = np.vstack([w, a])
            air_mass = moving.T @ (air.inertia[:, None] * moving)
            air_stiffness = moving.T @ air.stiffness @ moving
            mass = plate_mass + self._gap.inertia(band.middle).real * air_mass
        basis = _orthonormal(mass)

        def stiffness(moduli: Sequence[float]) -> FloatArray:
            """Return the stiffness in the basis; moduli: Young's modulus of each layer."""
            in_modes = modes.T @ (plate.stiffness(functions, moduli) @ modes)
            return basis.T @ in_modes @ basis

        layers = plate.layers
        self._soft = [layer for layer in layers if not layer.is_elastic]
        self._fixed = stiffness([layer.material.E if layer.is_elastic else 0.0 for layer in layers])
        self._by_layer = list[FloatArray]()
        for soft in self._soft:
            self._by_layer.append(stiffness([float(layer is soft) for layer in layers]))
        self._mass = basis.T @ plate_mass @ basis
        self._air_mass = basis.T @ air_mass @ basis
        self._air_stiffness = basis.T @ air_stiffness @ basis
        self._deflections = w @ basis
        self._starts = basis.T @ mass[:, :start_count]

    def _real_modes(
        self,
        plate: SpectralPlate,
        functions: ClassFunctions,
        air: AirMotion | None,
        shift: float,
        count: int,
    ) -> tuple[FloatArray, FloatArray, FloatArray, int]:
        """Return deflections, displacements along the plate, and flows of three plates' modes.

        Each column is a mode. Also returns how many modes each plate has.
        """
        band = self._band
        deflections = list[FloatArray]()
        alongs = list[FloatArray]()
        flows = list[FloatArray]()
        for frequency, factor in ((band.middle, 1), (band.low, 1 / _SPAN), (band.high, _SPAN)):
            moduli = list[float]()
            for layer in plate.layers:
                scale = 1 if layer.is_elastic else factor
                moduli.append(layer.modulus(frequency).real * scale)
            K, M, follows = plate.condensed(functions, air, moduli, frequency, shift)
            last = min(count + 1, len(K)) - 1
            _, vectors = linalg.eigh(K, M, subset_by_index=[0, last], check_finite=False)
            deflection = vectors[: functions.deflections]
            deflections.append(deflection)
            alongs.append(follows @ deflection)
            flows.append(vectors[functions.deflections :])
        return np.hstack(deflections), np.hstack(alongs), np.hstack(flows), last + 1

    def mode(self, number: int, eigenvalue: float) -> tuple[complex, FloatArray, ComplexArray]:
        """Return the complex mode near a real one: its eigenvalue [rad²/s²] and deflection (m,).

        Also its eigenvalues at the frequencies of the band, for the same shape, (k,). Rayleigh
        quotient iteration, with the matrices at the frequency of the last quotient. If it ends at a
        mode of another shape, the eigenvector most similar to the start takes its place, with the
        matrices of the last step. Raises InputError if the iteration does not converge.
        """
        value = complex(eigenvalue)
        start = self._starts[:, number].astype(complex)
        mode = start
        for _ in range(_STEPS):
            A, B = self._matrices(self._band.within(value.real))
            quotient = (mode @ A @ mode) / (mode @ B @ mode)
            change = abs(quotient - value)
            value = quotient
            is_converged = change <= _TOLERANCE * (abs(value) + 1.0)
            if is_converged:
                break
            mode = np.linalg.solve(A - value * (1 + 1e-12) * B, B @ mode)
            mode /= np.linalg.norm(mode)
        norms = np.vdot(mode, mode) * np.vdot(start, start)
        if not abs(np.vdot(mode, start)) ** 2 > 0.5 * norms.real:  # another mode, or NaN
            values, modes = np.linalg.eig(np.linalg.solve(B, A))
            nearest = int(np.argmax(np.abs(start @ self._mass @ modes)))
            value = complex(values[nearest])
            mode = modes[:, nearest]
        elif not is_converged:
            frequency = _frequency_of(eigenvalue)
            raise InputError(
                f"plate: its mode near {frequency:.4g} Hz must converge in {_STEPS} steps, got "
                f"{change:.2g} rad²/s² in the last one; check the loss factors of its layers"
            )
        mode = mode / np.sqrt(mode @ B @ mode)
        values_in_band = list[complex]()
        for frequency, (A, B) in zip(self._band.frequencies, self._at_nodes, strict=True):
            omega2 = (2 * math.pi * frequency) ** 2
            values_in_band.append(mode @ A @ mode + omega2 * (1 - mode @ B @ mode))
        return value, self._deflections @ mode.real, np.array(values_in_band)

    @cached_property
    def _at_nodes(self) -> list[tuple[ComplexArray, FloatArray]]:
        return [self._matrices(frequency) for frequency in self._band.frequencies]

    def _matrices(self, frequency: float) -> tuple[ComplexArray, FloatArray]:
        """Stiffness with all losses, and mass, at a frequency [Hz]."""
        stiffness: ComplexArray = np.asarray(self._fixed * (1 + 1j * self._loss_factor))
        for layer, by_modulus in zip(self._soft, self._by_layer, strict=True):
            modulus = layer.modulus(frequency)
            stiffness += (modulus + 1j * self._loss_factor * modulus.real) * by_modulus
        mass = self._mass
        if self._gap is not None:
            omega = 2 * math.pi * frequency
            inertia = self._gap.inertia(frequency)
            stiffness += self._gap.bulk_modulus(frequency) * self._air_stiffness
            stiffness -= 1j * omega**2 * inertia.imag * self._air_mass
            mass = mass + inertia.real * self._air_mass
        return stiffness, mass


def _orthonormal(mass: FloatArray) -> FloatArray:
    """Return independent combinations (n, k) of modes that are orthonormal in a mass (n, n)."""
    sizes, directions = linalg.eigh((mass + mass.T) / 2)
    is_independent = sizes > _DEPENDENT * sizes[-1]
    return np.asarray(directions[:, is_independent] / np.sqrt(sizes[is_independent]))
