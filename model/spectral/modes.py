"""Modes of a plate in Legendre polynomials, and the unresolved compliance.

The plate has one layer or several, with the air behind it, and is solved one symmetry class at a
time. Displacements along the plate follow the deflection (`model.spectral.polynomials.follow`):
only the deflection and the air vibrate. Moduli that depend on the frequency or lose energy, and the
friction of air, are evaluated for every mode at its own natural frequency: the complex mode is
solved in the space of the lowest modes of three real plates, whose moduli span the frequency range.
Its imaginary eigenvalue is its loss; at other frequencies the mode keeps its shape and has another
eigenvalue. Higher modes belong to the plate at the middle frequency. `SpectralMesh` chooses the
degrees of the polynomials for a frequency.

At a point, Legendre polynomials up to degree p resolve waves along x up to the wavenumber a = 2 (p
- 0.9) / (L s), s = sqrt(1 - (2 x / L - 1)²), and b along y. The compliance missing under a point
force is the infinite plate's in all shorter waves, the mean over all directions phi of

    1 / (4 pi D k²) + ln(k_max / k) / (2 pi S),    k = min(a / |cos phi|, b / |sin phi|),

with flexural rigidity D (for a board, in direction phi) and shear rigidity S. The square of a
Legendre polynomial oscillates along the plate, and so does the compliance missing in all higher
ones: at x = L (1 - cos t) / 2 it is 1 + o times as large in all waves that end at a, so a is
divided by sqrt(1 + o),

    o = cos(2 (p - 1) t) / ((p - 1) sin t).

It follows from P_n(cos t)² ~ (1 + sin((2 n + 1) t)) / (pi n sin t) for large n, summed with the
weight n^-3 over n > p - 2, since the curvature of a polynomial of degree p has degree p - 2.

At a free edge the compliance is larger. A wave that runs along the edge with wavenumber k, for a
force at a distance d from it, has the closed form of a half-plane,

    1 + exp(-2 q) (F - 1 + G (q + q²)),    q = k d,
    F = 8 / ((1 - nu) (3 + nu)),    G = 2 (1 - nu) / (3 + nu),

times the infinite plate's compliance, averaged here over all k above a or b. The shear part, which
has no limit, is cut for a point at k_max = 1 / h: plate theory does not hold on a shorter scale. A
disc limits it by itself.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar, Self, TypeAlias

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy import linalg, special

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.fem import Mesh
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
from model.structure.attachments import as_footprints, mean_over
from model.structure.modal_elasticity import Discretization
from model.structure.plate import (
    LaminateLayer,
    Plate,
    interface_mass,
    opposite_motions,
    section_of,
    shear_corrections,
)
from model.structure.surface import EDGES, LEAST_KNOWN, Surface

NODES = 12
"""Frequencies of a band at which modes state their stiffness."""

_SPAN = 1.5  # of the moduli of the three plates if only losses matter
_RIGID = 1e-6  # times the shift: eigenvalues below are rounding of rigid motions
_DEPENDENT = 1e-10  # share of the largest below which directions of the space are left out
_STEPS = 12  # of the iteration for a complex mode, which takes three or four

_functions = lru_cache(maxsize=16)(EdgedFunctions)


@dataclass(frozen=True, eq=False)
class SpectralClass:
    """Modes of a symmetry class of m polynomials of the deflection.

    eigenvalues omega² (r,) and losses (r,) [rad²/s²], the imaginary part beyond the plate's loss
    factor times omega²; negative for vibration of the air itself, which has smaller losses;
    dispersion (k, r): change of both at the frequencies of the band; truncated (t,): eigenvalues of
    the other modes; shapes (m, r + t): polynomials of the deflection, of all.
    """

    eigenvalues: FloatArray
    losses: FloatArray
    dispersion: ComplexArray
    truncated: FloatArray
    shapes: FloatArray


@dataclass(frozen=True, eq=False)
class MaterialBand:
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
        self, parity: tuple[int, int], *, shift: float, cut: float, band: MaterialBand
    ) -> SpectralClass:
        """Solve a class for all modes, and for those below the cut [rad²/s²] with their losses.

        shift [rad²/s²]: of the order of the lowest ones.
        """
        functions = self.functions(parity)
        gap = self._plate.air_gap
        air = None if gap is None else air_motion(functions, gap)
        moduli = [layer.modulus(band.middle).real for layer in self._layers]
        K, M, _ = self._condensed(functions, air, moduli, band.middle, shift)
        eigenvalues, vectors = linalg.eigh(K, M, check_finite=False)
        eigenvalues[np.abs(eigenvalues) < _RIGID * shift] = 0.0
        count = int(np.searchsorted(eigenvalues, cut))
        modes = SpectralClass(
            eigenvalues=eigenvalues[:count].copy(),
            losses=np.zeros(count),
            dispersion=np.zeros((NODES, count), dtype=complex),
            truncated=eigenvalues[count:],
            shapes=vectors[: functions.deflections].copy(),
        )
        is_lossy = air is not None or not all(layer.is_elastic for layer in self._layers)
        if count and is_lossy:
            space = _Space(self, functions, air, band, shift, count)
            for number in range(count):
                self._replace_by_complex_mode(modes, number, space)
        return modes

    def _replace_by_complex_mode(self, modes: SpectralClass, number: int, space: "_Space") -> None:
        """Replace a real mode by the complex one near it, with its losses and dispersion."""
        loss_factor = self._plate.loss_factor
        real_value = float(modes.eigenvalues[number])
        complex_value, shape, values_in_band = space.mode(number, real_value)
        value = complex_value.real if real_value else 0.0
        loss = max(complex_value.imag, 0.0) - loss_factor * value
        modes.eigenvalues[number] = value
        modes.losses[number] = loss
        modes.dispersion[:, number] = values_in_band - value * (1 + 1j * loss_factor) - 1j * loss
        modes.shapes[:, number] = shape

    def _inertia(self, of: ClassFunctions) -> FloatArray:
        """Mass between the polynomials of the deflection, (m, m)."""
        return sum(layer.surface_density for layer in self._layers) * np.eye(of.deflections)

    def stiffness(self, of: ClassFunctions, moduli: Sequence[float]) -> FloatArray:
        """Return the stiffness matrix of a parity class; moduli: Young's modulus of each layer."""
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
        w = slice(0, of.deflections)
        along = slice(of.deflections, None)
        K = self.stiffness(of, moduli)
        follows = follow(of, K, self._mass, shift)
        rotary = follows.T @ along_mass(of, self._mass, follows)
        stiffness = K[w, w] + K[w, along] @ follows - shift * rotary
        mass = self._inertia(of) + rotary
        gap = self._plate.air_gap
        if air is not None and gap is not None:
            plate_stiffness = stiffness
            plate_mass = mass
            stiffness = gap.bulk_modulus(frequency).real * air.stiffness
            stiffness[w, w] += plate_stiffness
            mass = np.diag(gap.inertia(frequency).real * air.inertia)
            mass[w, w] = plate_mass
        return (stiffness + stiffness.T) / 2, (mass + mass.T) / 2, follows


class _Space:
    """Space of the lowest modes of real plates in which complex ones are solved for."""

    def __init__(
        self,
        plate: SpectralPlate,
        of: ClassFunctions,
        air: AirMotion | None,
        band: MaterialBand,
        shift: float,
        count: int,
    ) -> None:
        self._band = band
        self._gap = plate._plate.air_gap
        self._loss_factor = plate._plate.loss_factor
        layers = plate._layers
        w, u, a, start_count = self._real_modes(plate, of, air, shift, count)
        along = np.vstack([w, u])
        plate_mass = w.T @ plate._inertia(of) @ w + u.T @ along_mass(of, plate._mass, u)
        air_mass = np.zeros_like(plate_mass)
        air_stiffness = air_mass
        mass = plate_mass
        if air is not None and self._gap is not None:
            moving = np.vstack([w, a])
            air_mass = moving.T @ (air.inertia[:, None] * moving)
            air_stiffness = moving.T @ air.stiffness @ moving
            mass = plate_mass + self._gap.inertia(band.middle).real * air_mass
        sizes, directions = linalg.eigh((mass + mass.T) / 2)
        is_independent = sizes > _DEPENDENT * sizes[-1]
        basis = directions[:, is_independent] / np.sqrt(sizes[is_independent])

        def stiffness(moduli: Sequence[float]) -> FloatArray:
            """Return the stiffness in the basis; moduli: Young's modulus of each layer."""
            in_modes = along.T @ (plate.stiffness(of, moduli) @ along)
            return np.asarray(basis.T @ in_modes @ basis)

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
        of: ClassFunctions,
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
            for layer in plate._layers:
                scale = 1 if layer.is_elastic else factor
                moduli.append(layer.modulus(frequency).real * scale)
            K, M, follows = plate._condensed(of, air, moduli, frequency, shift)
            last = min(count + 1, len(K)) - 1
            _, vectors = linalg.eigh(K, M, subset_by_index=[0, last], check_finite=False)
            deflection = vectors[: of.deflections]
            deflections.append(deflection)
            alongs.append(follows @ deflection)
            flows.append(vectors[of.deflections :])
        return np.hstack(deflections), np.hstack(alongs), np.hstack(flows), last + 1

    def mode(self, number: int, eigenvalue: float) -> tuple[complex, FloatArray, ComplexArray]:
        """Return the complex eigenvalue [rad²/s²] of a mode near a real one, and its deflection
        (m,).

        Also its eigenvalue at the frequencies of the band, for the same shape, (k,). Raises
        InputError if the iteration does not converge.
        """
        value = complex(eigenvalue)
        start = self._starts[:, number].astype(complex)
        mode = start
        is_converged = False
        for _ in range(_STEPS):
            A, B = self._matrices(self._band.within(value.real))
            last_value = value
            value = (mode @ A @ mode) / (mode @ B @ mode)
            is_converged = abs(value - last_value) <= 1e-10 * (abs(value) + 1.0)
            if is_converged:
                break
            mode = np.linalg.solve(A - value * (1 + 1e-12) * B, B @ mode)
            mode /= np.linalg.norm(mode)
        norms = np.vdot(mode, mode) * np.vdot(start, start)
        if not abs(np.vdot(mode, start)) ** 2 > 0.5 * norms.real:  # mostly another mode, or NaN
            values, modes = np.linalg.eig(np.linalg.solve(B, A))
            nearest = int(np.argmax(np.abs(start @ self._mass @ modes)))
            value = complex(values[nearest])
            mode = modes[:, nearest]
        elif not is_converged:
            frequency = math.sqrt(max(eigenvalue, 0.0)) / (2 * math.pi)
            raise InputError(
                f"plate: its mode near {frequency:.4g} Hz must converge in {_STEPS} steps, got "
                f"{abs(value - last_value):.2g} rad²/s² in the last one; check the loss factors of "
                "its layers"
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


# How far below its degree a polynomial resolves, against 1/2 for a string of free ends: fitted to
# the compliance of polynomials of degree 72 at 40 places of the paper's plate, within 10 %.
_UNRESOLVED = 0.9
_CURVATURE = 1  # the missing compliance oscillates as a polynomial this many degrees lower

_CORNER = 4.0  # bending at a corner, times the infinite plate's
_TO_CENTROID = 0.5  # where a disc that is cut by an edge acts, between its center and its centroid
_LEAST_SINE = 1.5  # times 1 / p: nearest to its end that a polynomial resolves ever finer
_DIRECTIONS = (np.arange(32) + 0.5) * np.pi / 64
_COS2, _SIN2 = np.cos(_DIRECTIONS) ** 2, np.sin(_DIRECTIONS) ** 2
_UNCERTAIN = 0.2  # relative; twice the error of the estimate
_ON_FOOT = 0.5  # least share of a point's that is taken for a disc, which an edge may cut
# k d beyond which forces share no unresolved wave: the fourth zero of `_decay`. The shared
# compliance fades toward it, since a field with a step or a kink cannot be interpolated.
_FAR = 13.603179753989906

# Gauss points of ln t, t = 1 to 100, for integrals over dt / t: footprints leave little beyond.
_POINTS, _WEIGHTS = leggauss(48)
_LOG_T = math.log(100) / 2 * (1 + _POINTS)
_LOG_WEIGHTS = math.log(100) / 2 * _WEIGHTS


def local_compliance(
    plate: Plate, degrees: tuple[int, int], places: FloatArray, others: FloatArray
) -> FloatArray:
    """Unresolved compliance [m/N] between footprints [m] (n, 3) and others (m, 3), (n, m).

    Also of points (n, 2). Between two points it falls with their distance d as 2 ∫ J0(k d t) / t³
    dt from t = 1 on; a footprint of radius a multiplies the integrand by 2 J1(k a t) / (k a t).
    """
    own, other = (unresolved_at(plate, degrees, each) for each in (places, others))
    return compliance_between(plate, own, other)


@dataclass(frozen=True, eq=False)
class UnresolvedCompliance:
    """At n footprints [m] (n, 3): compliance of a point force in bending and in shear [m/N] (n,).

    wavenumber [1/m] (n,): lower limit of unresolved waves; decade [m/N] (n,): shear compliance of
    ten times shorter waves.
    """

    footprints: FloatArray
    bending: FloatArray
    shear: FloatArray
    wavenumber: FloatArray
    decade: FloatArray


def compliance_between(
    plate: Plate, own: UnresolvedCompliance, other: UnresolvedCompliance
) -> FloatArray:
    """Unresolved compliance [m/N] (n, m); see `local_compliance`."""
    places = own.footprints
    others = other.footprints
    distance = np.hypot(*(places[:, None, :2] - others[:, :2]).transpose(2, 0, 1))
    wavenumber = np.sqrt(np.multiply.outer(own.wavenumber, other.wavenumber))
    result = np.zeros(distance.shape)
    i, j = np.nonzero(distance * wavenumber < _FAR)
    k = wavenumber[i, j]
    d = distance[i, j]
    bending = np.sqrt(own.bending[i] * other.bending[j])
    shear = np.sqrt(own.shear[i] * other.shear[j])
    radius = places[i, 2]
    other_radius = others[j, 2]
    on_discs = (radius > 0) | (other_radius > 0)
    result[i, j] = (bending + shear) * _decay(k * d)
    if on_discs.any():
        share, decades = _on_discs(
            k[on_discs], d[on_discs], radius[on_discs], other_radius[on_discs]
        )
        decade = np.sqrt(own.decade[i] * other.decade[j])[on_discs]
        result[i[on_discs], j[on_discs]] = bending[on_discs] * share + decade * decades
    result[i, j] *= 1 - (k * d / _FAR) ** 4
    return result


def edge_compliance(plate: Plate, side: float, degrees: IntArray, foot: float) -> FloatArray:
    """Unresolved compliance [m/N] in the middle of a free edge of a length, by degree, (n,).

    side [m]; degrees (n,): along it, odd and even ones alike; foot [m]: radius of a disc there.
    """
    D, nu = plate.flexural_rigidity, plate.material.nu
    resolved = 2 * (degrees - _UNRESOLVED) / side  # of directions phi, over |cos phi|
    bending = 1 / ((1 - nu) * (3 + nu) * np.pi * D * resolved**2)
    decade = math.log(10) / (np.pi * plate.shear_rigidity)
    decades = np.log10(np.maximum(1, 1 / (2 * plate.thickness * resolved)))
    at_point = bending + decade * decades
    if not foot:
        return at_point
    radii = np.full(len(degrees), foot)
    share, decades = _on_discs(
        np.asarray(math.sqrt(2) * resolved), np.zeros(len(degrees)), radii, radii
    )
    return np.maximum(bending * share + decade * decades, _ON_FOOT * at_point)


def uncertain_compliance(
    plate: Plate, own: UnresolvedCompliance, other: UnresolvedCompliance
) -> FloatArray:
    """Return the possible error of the unresolved compliance [m/N] (n, m).

    A fraction of the compliance. For a point (unlimited in shear), ten times shorter waves as well.
    """
    same = (own.footprints[:, None] == other.footprints).all(axis=2)
    points = same & (own.footprints[:, 2] == 0)[:, None]
    decade = np.where(points, np.sqrt(np.multiply.outer(own.decade, other.decade)), 0.0)
    return _UNCERTAIN * compliance_between(plate, own, other) + decade


def unresolved_at(
    plate: Plate, degrees: tuple[int, int], places: FloatArray
) -> UnresolvedCompliance:
    """Return the compliance that polynomials of the given degrees leave unresolved at footprints or
    points.

    places: footprints (n, 3) or points (n, 2).
    """
    places = as_footprints(places)
    points = places[:, :2]
    if places[:, 2].any():
        centroids = mean_over(np.asarray, places, length=plate.length, width=plate.width)
        points = points + _TO_CENTROID * (centroids - points)
    D = plate.flexural_rigidity
    nu = plate.material.nu
    sides = np.array([plate.length, plate.width])
    p = np.array(degrees)
    cosine = np.clip(1 - 2 * points / sides, -1, 1)
    sine = np.sqrt(np.maximum(1 - cosine**2, (_LEAST_SINE / p) ** 2))
    resolved = 2 * (p - _UNRESOLVED) / (sides * sine)
    wave = p - _CURVATURE
    excess = 1 + np.cos(2 * wave * np.arccos(cosine)) / (wave * sine)
    missing = excess / resolved**2
    inverse_wavenumbers2 = np.maximum(_COS2 * missing[:, :1], _SIN2 * missing[:, 1:])
    # Of waves along the edge x = 0, whose distance is along x.
    to_edge = np.maximum(np.minimum(points, sides - points), 0)
    q = 2 * to_edge * resolved[:, ::-1]
    F_less_1 = 8 / ((1 - nu) * (3 + nu)) - 1
    G = 2 * (1 - nu) / (3 + nu)
    edge = _edge_excess(q, F_less_1, G)
    at_corner = edge.prod(axis=1) / F_less_1**2
    bending = 1 + edge.sum(axis=1) + (_CORNER - 1 - 2 * F_less_1) * at_corner
    softness = D / plate.rigidity_towards(_COS2)  # 1 for isotropic materials
    mean_bending = (inverse_wavenumbers2 * softness).mean(axis=1)
    logarithm = np.log(np.maximum(1, inverse_wavenumbers2 / plate.thickness**2)).mean(axis=1) / 2
    images = (1 + edge / F_less_1).prod(axis=1)
    return UnresolvedCompliance(
        footprints=places,
        bending=bending * mean_bending / (4 * np.pi * D),
        shear=images * logarithm / (2 * np.pi * plate.shear_rigidity),
        wavenumber=inverse_wavenumbers2.mean(axis=1) ** -0.5,
        decade=images * math.log(10) / (2 * np.pi * plate.shear_rigidity),
    )


def _on_discs(
    k: FloatArray, d: FloatArray, a: FloatArray, b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the effect of footprints (n,): a factor on the compliance in bending, and decades in
    shear.

    k (n,): lower limit of unresolved waves [1/m]; d (n,): distance of two footprints with radii a
    and b [m].
    """
    t = np.exp(_LOG_T)
    discs = special.j0(np.multiply.outer(k * d, t))
    for radius in (a, b):
        z = np.maximum(np.multiply.outer(k * radius, t), 1e-9)
        discs *= 2 * special.j1(z) / z
    return discs @ (2 * _LOG_WEIGHTS / t**2), discs @ _LOG_WEIGHTS / math.log(10)


def _edge_excess(z: FloatArray, ratio: float, further: float) -> FloatArray:
    """Mean of exp(-q) (ratio + further (q/2 + q²/4)) over q = z t, t >= 1, weighted with 2 / t³."""
    z = np.maximum(z, 1e-9)
    e1, e2, e3 = (special.expn(order, z) for order in (1, 2, 3))
    return 2 * (ratio * e3 + further * (z / 2 * e2 + z**2 / 4 * e1))


def _decay(z: FloatArray) -> FloatArray:
    """2 ∫ J0(z t) / t³ dt from 1 to infinity."""
    z = np.maximum(z, 1e-9)
    first = special.it2j0y0(z)[0] - np.euler_gamma - np.log(z / 2)  # of J0(z t) / t
    return special.j0(z) - z / 2 * (special.j1(z) + z * first)


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
        the plate under it; foot [m]: radius of the smallest, 0 for a point. None where more than
        MAX_POLYNOMIALS would be needed.
        """
        wavelength = plate.bending_wavelength(frequency_max)
        small = wavelength**2 / (plate.length * plate.width)
        wave_stiffness = plate.wave_stiffness(frequency_max)
        acting = stiffness / (1 + stiffness / (_AS_IF_RIGID * wave_stiffness))
        errors = _PER_STIFFNESS * (1 + _ON_SMALL_PLATES * small) * acting
        errors += _PER_WAVE_STIFFNESS * wave_stiffness
        extra_degrees = _ACCURATE + _PER_DECADE * max(0.0, math.log10(0.01 / accuracy))
        degrees = []
        for side in (plate.length, plate.width):
            waves = math.pi * side / wavelength
            further = extra_degrees * max(1, waves / _MANY) ** (1 / 3)
            lowest = max(MIN_DEGREE, math.ceil(waves + further))
            possible = np.arange(lowest, MAX_DEGREE + 1)
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
        """Numbers of evenly spaced points along x and y that show all details that it resolves."""
        return _POINTS_PER_DEGREE * self.nx + 1, _POINTS_PER_DEGREE * self.ny + 1

    @property
    def shortest_wavelength(self) -> float:
        """The shortest bending wavelength [m] that it resolves."""
        sides = (self.length / (self.nx - _RESOLVES), self.width / (self.ny - _RESOLVES))
        return math.pi * max(sides)

    def finer(self) -> Self:
        """Degrees to compare with, for the discretization error."""
        return replace(self, nx=self.nx + _FINER, ny=self.ny + _FINER)

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """Lowest degrees that resolve a frequency [Hz]."""
        half = plate.bending_wavelength(frequency) / math.pi
        nx = max(MIN_DEGREE, math.ceil(plate.length / half) + _RESOLVES)
        ny = max(MIN_DEGREE, math.ceil(plate.width / half) + _RESOLVES)
        return type(self)(nx, ny, plate.length, plate.width)

    def interpolation_error(self, plate: Plate, frequency: float) -> float:
        """0: polynomials are evaluated at any point."""
        return 0.0


@dataclass(frozen=True)
class KnownModes(Discretization):
    """In place of a mesh: nx modes of a surface up to a frequency [Hz], in one row."""

    frequency: float
    element_name: ClassVar[str] = "modes"
    strip: ClassVar[float] = 0.0

    @classmethod
    def of(cls, plate: Plate, surface: Surface) -> Self:
        """Return the modes of a surface file; plate: its equivalent plate."""
        faster = surface.frequency_factor(plate.thickness, plate.material.E)
        highest = faster * surface.frequency
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
        per_wavelength = 2 * _POINTS_PER_DEGREE
        nx = math.ceil(per_wavelength * self.length / self.shortest_wavelength)
        ny = math.ceil(per_wavelength * self.width / self.shortest_wavelength)
        return nx + 1, ny + 1

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
        known = LEAST_KNOWN * frequency
        return replace(self, nx=math.ceil(self.nx * known / self.frequency), frequency=known)

    def interpolation_error(self, plate: Plate, frequency: float) -> float:
        """0: splines through the nodes are evaluated at any point."""
        return 0.0


PlateMesh: TypeAlias = Mesh | SpectralMesh | KnownModes
"""Elements, polynomials over the whole plate, or the modes of another program.

They have the same properties and methods.
"""


def stretched(mesh: PlateMesh, plate: Plate) -> PlateMesh:
    """A mesh of its kind that resolves the same on a plate of another size."""
    nx = math.ceil(mesh.nx * max(plate.length / mesh.length, 1.0))
    ny = math.ceil(mesh.ny * max(plate.width / mesh.width, 1.0))
    return replace(mesh, nx=nx, ny=ny, length=plate.length, width=plate.width)
