"""A thin plate in Bogner-Fox-Schmit elements: another theory and element than the model's.

Kirchhoff's plate without shear and rotary inertia, products of cubic Hermite polynomials on a
regular grid, all of its modes; ERAs, masses and fingers attached by their equations of motion. Its
loss is that of viscous modes, eta w w_r in place of eta w_r². Nothing of the model is used.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Reals: TypeAlias = NDArray[np.float64]
Complexes: TypeAlias = NDArray[np.complex128]

ELEMENTS = (13, 10)
LOSS_AT = 150.0  # Hz


@dataclass(frozen=True, eq=False)
class Line:
    """Cubic Hermite elements on (0, length) [m]: deflection and slope at each node."""

    length: float
    elements: int

    @property
    def step(self) -> float:
        """Length of an element [m]."""
        return self.length / self.elements

    def integrals(
        self, start: float = 0.0, end: float = np.inf, *, slope: float = 0.0, power: int = 1
    ) -> dict[tuple[int, int], Reals]:
        """Integrals of derivative a of one function and b of another, by (a, b).

        start, end [m]: of the part over which they are taken; slope, power: of a factor
        (1 + slope u)^power, u from -1 to 1 along the line.
        """
        points, weights = np.polynomial.legendre.leggauss(6)
        size = 2 * (self.elements + 1)
        found = {key: np.zeros((size, size)) for key in ((0, 0), (1, 1), (2, 2), (2, 0))}
        for e in range(self.elements):
            low, high = np.clip((np.array([start, end]) / self.step) - e, 0, 1)
            t, own = low + (high - low) * (points + 1) / 2, weights / 2 * (high - low) * self.step
            own = own * (1 + slope * (2 * (e + t) / self.elements - 1)) ** power
            for (a, b), total in found.items():
                local = np.einsum("q,qi,qj->ij", own, self._local(t, a), self._local(t, b))
                total[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += local
        return found

    def at(self, x: Reals) -> Reals:
        """Values of all functions at x (p,), beyond an end at it, (p, 2 nodes)."""
        x = np.clip(x, 0.0, self.length)
        element = np.clip((x / self.step).astype(int), 0, self.elements - 1)
        values = self._local(x / self.step - element, 0)
        found = np.zeros((len(x), 2 * (self.elements + 1)))
        rows = np.arange(len(x))[:, None]
        found[rows, 2 * element[:, None] + np.arange(4)] = values
        return found

    def _local(self, t: Reals, derivative: int) -> Reals:
        """The four functions of an element at t in (0, 1), or a derivative, (q, 4)."""
        h = self.step
        cubics = np.array([[1, 0, -3, 2], [0, h, -2 * h, h], [0, 0, 3, -2], [0, 0, -h, h]])
        rows = [np.polynomial.polynomial.polyder(c, derivative) for c in cubics]
        values = [np.polynomial.polynomial.polyval(t, row) for row in rows]
        return np.asarray(np.array(values).T / h**derivative, dtype=float)


@dataclass(frozen=True, eq=False)
class ThinPlate:
    """A free plate: sides, thickness [m], E [Pa], rho [kg/m³], nu.

    parts: x from, to, y from, to [m] of parts that are stiffer and heavier, and what they have of
    rigidity and of mass beside the plate's, relative; taper: thickness that each side's ends have
    more or less than its middle, relative.
    """

    length: float
    width: float
    thickness: float
    modulus: float
    density: float
    ratio: float
    parts: tuple[tuple[float, ...], ...] = ()
    taper: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def _lines(self) -> tuple[Line, Line]:
        return Line(self.length, ELEMENTS[0]), Line(self.width, ELEMENTS[1])

    @cached_property
    def modes(self) -> tuple[Reals, Reals]:
        """Eigenvalues omega² (r,) [rad²/s²] and modes (size, r) of modal mass 1."""
        along, across = self._lines
        lines = list(zip(self._lines, self.taper, strict=True))
        x, y = (line.integrals(slope=slope, power=3) for line, slope in lines)
        mass_x, mass_y = (line.integrals(slope=slope)[0, 0] for line, slope in lines)
        rigidity = self.modulus * self.thickness**3 / 12 / (1 - self.ratio**2)
        stiffness, mass = self._bending(x, y), np.kron(mass_x, mass_y)
        for *place, stiffer, heavier in self.parts:
            of_x, of_y = along.integrals(*place[:2]), across.integrals(*place[2:])
            stiffness = stiffness + stiffer * self._bending(of_x, of_y)
            mass = mass + heavier * np.kron(of_x[0, 0], of_y[0, 0])
        mass = self.density * self.thickness * mass
        values, vectors = linalg.eigh(rigidity * stiffness, mass)
        values[:3] = 0.0
        return values, vectors

    def _bending(self, x: dict[tuple[int, int], Reals], y: dict[tuple[int, int], Reals]) -> Reals:
        """Stiffness at a rigidity of 1, by integrals along both sides."""
        nu, mixed = self.ratio, np.kron(x[2, 0], y[2, 0].T)
        stiffness = np.kron(x[2, 2], y[0, 0]) + np.kron(x[0, 0], y[2, 2])
        twist = 2 * (1 - nu) * np.kron(x[1, 1], y[1, 1])
        return np.asarray(stiffness + nu * (mixed + mixed.T) + twist)

    def thinned(self, factor: float) -> "ThinPlate":
        """The plate with its thickness times a factor, whose modes scale exactly."""
        values, vectors = self.modes
        thinner = replace(self, thickness=factor * self.thickness)
        thinner.__dict__["modes"] = (factor**2 * values, vectors / np.sqrt(factor))
        return thinner

    def shapes(self, points: Reals) -> Reals:
        """Mode shapes at points (p, 2) [m], (p, r)."""
        along = [line.at(points[:, axis]) for axis, line in enumerate(self._lines)]
        functions = along[0][:, :, None] * along[1][:, None, :]
        return np.asarray(functions.reshape(len(points), -1) @ self.modes[1])


@dataclass(frozen=True, eq=False)
class Mounted:
    """A plate on n ERAs with masses.

    at (n, 2) [m]; stiffness, damping, bolt, gain (n,); masses (m, 3): x, y [m] and mass [kg];
    loss: factor at LOSS_AT, loss_exponent of its power of frequency.
    """

    plate: ThinPlate
    at: Reals
    stiffness: Reals
    damping: Reals
    bolt: Reals
    gain: Complexes
    masses: Reals
    loss: float
    loss_exponent: float

    @cached_property
    def attached(self) -> Reals:
        """Mode shapes at ERAs and masses (n + m, r)."""
        return self.plate.shapes(np.vstack([self.at, self.masses[:, :2]]))

    def receptance(self, frequency: float) -> Complexes:
        """Of each mode of the free plate, (r,)."""
        w, values = 2 * np.pi * frequency, self.plate.modes[0]
        loss = self.loss * (frequency / LOSS_AT) ** self.loss_exponent
        return np.asarray(1 / (values + 1j * loss * w * np.sqrt(values) - w**2))

    def accelerations(
        self,
        frequency: float,
        points: Reals,
        *,
        fingers: Reals | None = None,
        loads: Complexes | None = None,
    ) -> Complexes:
        """Acceleration at points (p, 2) per base displacement of each ERA, its gain included.

        (p, n) [1/s²]; fingers (k, 2) [m] with dynamic stiffness loads (k,) [N/m].
        """
        w, n = 2 * np.pi * frequency, len(self.at)
        base = self.stiffness + 1j * w * self.damping
        held: list[Complexes | Reals] = [base - w**2 * self.bolt, -(w**2) * self.masses[:, 2]]
        shapes = self.attached
        if fingers is not None and loads is not None:
            shapes = np.vstack([shapes, self.plate.shapes(fingers)])
            held.append(loads)
        Z = np.concatenate(held)
        modal = self.receptance(frequency)
        system = np.eye(len(Z)) + Z[:, None] * ((shapes * modal) @ shapes.T)
        applied = np.zeros((len(Z), n), dtype=complex)
        applied[np.arange(n), np.arange(n)] = base * self.gain
        forces = np.linalg.solve(system, applied)
        return np.asarray(-(w**2) * (self.plate.shapes(points) * modal) @ (shapes.T @ forces))
