"""A structured mesh over the plate of Reissner-Mindlin rectangles: MITC4, the paper's, Q3 to Q5.

Every integral over a rectangle is the product of an integral along x and one along y. From the
third order on, on Gauss-Lobatto nodes, thin plates do not lock. The four-node element would: its
shear strain along x is assumed constant along x, that along y constant along y (Bathe and Dvorkin,
Int. J. Num. Meth. Eng. 21 (1985) 367-383), which on a rectangle takes rotations by their mean along
the strain. Narrow elements at a free edge resolve the boundary layer, as wide as the plate is
thick, that limits elements of low order to linear convergence (Babuška and Li, Comput. Methods
Appl. Mech. Engrg. 100 (1992) 249-273; Häggblad and Bathe, Int. J. Num. Meth. Eng. 30 (1990)
981-1011).
"""

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np
from numpy.polynomial import legendre
from scipy import sparse

from model.arrays import FloatArray, IntArray, lattice
from model.errors import InputError
from model.structure.footprint import check_on_plate, mean_over
from model.structure.plate import Plate

DOF_PER_NODE = 3
SHEAR_CORRECTION = 5 / 6


@dataclass(frozen=True)
class Element:
    """A rectangle of (order + 1)² nodes with the degrees of freedom w, beta_x, beta_y at each.

    side: node positions along a side, from -1 to 1, (order + 1,); the same along x and y. Nodes are
    numbered row by row from the lower left, x running first; each field is the tensor product of
    the Lagrange polynomials of the side; beta_x, beta_y are the rotations of paper Eq. 1.
    """

    name: str
    side: tuple[float, ...]

    @property
    def order(self) -> int:
        """Polynomial order along a side."""
        return len(self.side) - 1

    def shape(self, xi: FloatArray) -> FloatArray:
        """Lagrange polynomials of a side at xi (n,) in -1..1: (n, order + 1), rows sum to 1."""
        return np.asarray(np.vander(xi, self.order + 1, increasing=True) @ self._coefficients())

    def stiffness(self, plate: Plate, dx: float, dy: float) -> FloatArray:
        """Stiffness (3 n, 3 n) [N/m, N, N m] of a dx by dy rectangle [m] (paper Eq. 17)."""
        bending, shear, _ = rigidities(plate)
        bend, coupled, twist = bending[0, 0], bending[0, 1], bending[2, 2]
        value, slope_value, slope = self._integrals()
        means = value.sum(axis=1)
        tied = np.outer(means, means) / 2 if self.order == 1 else value
        n = len(self.side) ** 2
        total = np.zeros((n, 3, n, 3))

        # kron(A, B): integral of A along y times integral of B along x, over the element's nodes.
        area = dx * dy / 4
        along_x = np.kron(value, slope) * dy / dx
        along_y = np.kron(slope, value) * dx / dy
        total[:, 0, :, 0] = shear * (along_x + along_y)
        total[:, 0, :, 1] = -shear * np.kron(value, slope_value) * dy / 2
        total[:, 0, :, 2] = -shear * np.kron(slope_value, value) * dx / 2
        total[:, 1, :, 1] = shear * np.kron(value, tied) * area + bend * along_x + twist * along_y
        total[:, 2, :, 2] = shear * np.kron(tied, value) * area + bend * along_y + twist * along_x
        total[:, 1, :, 2] = coupled * np.kron(slope_value.T, slope_value)
        total[:, 1, :, 2] += twist * np.kron(slope_value, slope_value.T)
        for row, column in ((0, 1), (0, 2), (1, 2)):
            total[:, column, :, row] = total[:, row, :, column].T
        return total.reshape(3 * n, 3 * n)

    def mass(self, plate: Plate, dx: float, dy: float) -> FloatArray:
        """Consistent mass (3 n, 3 n) with rotary inertia of a rectangle [m] (paper Eq. 19)."""
        value, _, _ = self._integrals()
        return np.asarray(np.kron(np.kron(value, value) * dx * dy / 4, rigidities(plate)[2]))

    def _coefficients(self) -> FloatArray:
        """Monomial coefficients of the Lagrange polynomials, a column for each node of a side."""
        return np.asarray(np.linalg.inv(np.vander(self.side, increasing=True)))

    def _integrals(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Integrals over -1..1 of N_i N_j, N_i' N_j and N_i' N_j', exact, (n, n) each."""
        points, weights = legendre.leggauss(len(self.side))
        powers = np.arange(len(self.side))
        shape = self.shape(points)
        slope = powers * points[:, None] ** np.maximum(powers - 1, 0) @ self._coefficients()
        weighted = (slope.T * weights) @ slope
        return (shape.T * weights) @ shape, (slope.T * weights) @ shape, weighted


def rigidities(plate: Plate) -> tuple[FloatArray, float, FloatArray]:
    """Bending (3, 3) [N m], shear [N/m] and inertia (3, 3) [kg/m², -, kg] of a plate's section.

    Paper Eq. 5 to 7, 17 and 20: D C_b, kappa G h and H.
    """
    nu, rho, h = plate.material.nu, plate.material.rho, plate.thickness
    bending = plate.flexural_rigidity * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
    inertia = np.diag([rho * h, rho * h**3 / 12, rho * h**3 / 12])
    return bending, SHEAR_CORRECTION * plate.material.shear_modulus * h, inertia


def _gauss_lobatto(order: int) -> tuple[float, ...]:
    """The order + 1 nodes: the ends and the extrema of the Legendre polynomial."""
    inner = legendre.Legendre.basis(order).deriv().roots().real
    return (-1.0, *sorted(inner.tolist()), 1.0)


MITC4 = Element("MITC4", (-1.0, 1.0))
Q3, Q4, Q5 = (Element(f"Q{order}", _gauss_lobatto(order)) for order in (3, 4, 5))

ELEMENTS = {element.name: element for element in (MITC4, Q3, Q4, Q5)}
"""All of them, by name."""


def element_of(name: str) -> Element:
    """Look up an element; raises InputError."""
    if name not in ELEMENTS:
        raise InputError(f"element must be one of {', '.join(ELEMENTS)}, got {name[:40]!r}")
    return ELEMENTS[name]


class _Resolves(Protocol):
    def highest_frequency(self, plate: Plate) -> float: ...

    def resolving(self, plate: Plate, frequency: float) -> object: ...


PAPER_ELEMENT = MITC4
"""The default element of a mesh."""

# An accurate mesh. The lowest twelve natural frequencies of the paper's plate are then within
# 0.01 % of converged, and its accelerations (relative L2) within 0.1 % with ERAs at the corners,
# 0.2 % with ERAs elsewhere and 0.6 % there at a resonance: a point force bends the plate more
# sharply than an element does.
Q5_ELEMENT = Q5
Q5_PER_WAVELENGTH = 5.5
Q5_MIN_ELEMENTS = 3
Q5_STRIP_THICKNESSES = 2.0  # the free edge's boundary layer is as wide as h

MIN_NODES_PER_WAVELENGTH = 6
"""With fewer nodes to a bending wavelength a mesh is refused."""


@dataclass(frozen=True)
class Mesh:
    """nx by ny equal rectangles over length by width [m], optionally with strips along the edges.

    strip [m]: width of one more row of elements along every edge, for the boundary layer of a free
    edge; the nx by ny elements then share the rest. The nodes form a lattice: node j * columns + i
    lies at (node_x[i], node_y[j]).
    """

    nx: int
    ny: int
    length: float
    width: float
    element: Element = PAPER_ELEMENT
    strip: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a mesh without elements, or with strips that fill the plate."""
        if self.nx < 1 or self.ny < 1:
            raise InputError(f"mesh: elements must be 1x1 or more, got {self.nx}x{self.ny}")
        if not 0 <= 2 * self.strip < min(self.length, self.width):
            raise InputError(
                f"mesh: strips must be narrower than half the plate of {self.length:g} x "
                f"{self.width:g} m, got {self.strip:g} m; 0 for none"
            )

    @classmethod
    def accurate(cls, plate: Plate, *, frequency_max: float) -> Self:
        """Make the cheapest mesh of Q5 that is accurate up to a frequency [Hz]."""
        size = plate.bending_wavelength(frequency_max) / Q5_PER_WAVELENGTH
        nx, ny = (
            max(Q5_MIN_ELEMENTS, math.ceil(side / size)) for side in (plate.length, plate.width)
        )
        # On a thick plate the boundary layer is no narrower than an element: no strip needed.
        strip = Q5_STRIP_THICKNESSES * plate.thickness
        if strip > min(plate.length / nx, plate.width / ny) / 2:
            strip = 0.0
        return cls(nx, ny, plate.length, plate.width, Q5_ELEMENT, strip)

    @classmethod
    def coarsest(cls, plate: Plate, *, frequency: float, element: Element = PAPER_ELEMENT) -> Self:
        """Make the coarsest mesh of an element that resolves a frequency [Hz]."""
        size = plate.bending_wavelength(frequency) * element.order / MIN_NODES_PER_WAVELENGTH
        # Rounding must not turn a mesh that fits exactly into one too coarse.
        size *= 1 - 1e-9
        nx, ny = (math.ceil(side / size) for side in (plate.length, plate.width))
        return cls(nx, ny, plate.length, plate.width, element)

    def to_dict(self) -> dict[str, Any]:
        """Its fields for a file, the element by its name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return values | {"element": self.element.name}

    def __str__(self) -> str:
        text = f"{self.nx}x{self.ny}"
        if self.element != PAPER_ELEMENT:
            text += f" {self.element.name}"
        if self.strip:
            text += f" with strips of {1000 * self.strip:.3g} mm"
        return text

    @property
    def element_size(self) -> tuple[float, float]:
        """Side lengths (dx, dy) of the nx by ny elements, the largest ones [m]."""
        return (self.length - 2 * self.strip) / self.nx, (self.width - 2 * self.strip) / self.ny

    @property
    def element_counts(self) -> tuple[int, int]:
        """Number of elements along x and y, strips included."""
        strips = 2 if self.strip else 0
        return self.nx + strips, self.ny + strips

    @cached_property
    def element_sides(self) -> tuple[IntArray, IntArray]:
        """1 for elements along x and y that are as wide as a strip, 0 for the others."""
        sides = tuple(np.zeros(count, dtype=int) for count in self.element_counts)
        if self.strip:
            for side in sides:
                side[[0, -1]] = 1
        return sides[0], sides[1]

    @property
    def columns(self) -> int:
        """Number of nodes along x."""
        return self.element.order * self.element_counts[0] + 1

    @property
    def rows(self) -> int:
        """Number of nodes along y."""
        return self.element.order * self.element_counts[1] + 1

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return self.columns * self.rows

    @cached_property
    def lines(self) -> tuple[FloatArray, FloatArray]:
        """Element boundaries along x (n,) and y (m,) [m], the plate's edges included."""
        lines = []
        for length, count in ((self.length, self.nx), (self.width, self.ny)):
            inner = np.linspace(self.strip, length - self.strip, count + 1)
            lines.append(np.concatenate([[0.0], inner, [length]]) if self.strip else inner)
        return lines[0], lines[1]

    @cached_property
    def node_x(self) -> FloatArray:
        """Positions of the columns of nodes [m], (columns,)."""
        return self._along(self.lines[0])

    @cached_property
    def node_y(self) -> FloatArray:
        """Positions of the rows of nodes [m], (rows,)."""
        return self._along(self.lines[1])

    def _along(self, lines: FloatArray) -> FloatArray:
        share = (1 + np.array(self.element.side[:-1])) / 2
        inner = lines[:-1, None] + share * np.diff(lines)[:, None]
        return np.append(inner.ravel(), lines[-1])

    @cached_property
    def nodes(self) -> FloatArray:
        """Positions of the nodes [m], (node_count, 2)."""
        return lattice(self.node_x, self.node_y)

    @cached_property
    def connectivity(self) -> IntArray:
        """Nodes of each element, row by row from its lower left, (elements, (order + 1)²).

        Elements are numbered row by row as well, x running first.
        """
        order = self.element.order
        along_x, along_y = (order * np.arange(count) for count in self.element_counts)
        corner = (along_y[:, None] * self.columns + along_x).ravel()
        step = np.arange(order + 1)
        return np.asarray(corner[:, None] + (step[:, None] * self.columns + step).ravel())

    @property
    def raster(self) -> tuple[int, int]:
        """Numbers of evenly spaced points along x and y that show what the mesh resolves.

        The nodes themselves for elements of the first order without strips.
        """
        per_element = 1 if self.element.order == 1 else 2 * self.element.order
        return per_element * self.nx + 1, per_element * self.ny + 1

    @property
    def element_name(self) -> str:
        """Name of its element."""
        return self.element.name

    @property
    def dof(self) -> int:
        """Number of degrees of freedom: w, beta_x, beta_y at each node."""
        return 3 * self.node_count

    @property
    def shortest_wavelength(self) -> float:
        """The shortest bending wavelength [m] that it resolves: six elements of the first order."""
        return MIN_NODES_PER_WAVELENGTH * max(self.element_size) / self.element.order

    def highest_frequency(self, plate: Plate) -> float:
        """The highest frequency [Hz] whose bending waves in a plate it resolves."""
        return plate.bending_frequency(self.shortest_wavelength)

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """The coarsest mesh of its element, without strips, that resolves a frequency [Hz]."""
        return self.coarsest(plate, frequency=frequency, element=self.element)

    def interpolation_error(self, plate: Plate, frequency: float) -> float:
        """By how much its shape functions may deviate from a wave between nodes, relative to it.

        A wave k between nodes a step s apart is followed by a polynomial of order p within
        (k s)^(p + 1) / 4 (p + 1).
        """
        order = self.element.order
        step = max(self.element_size) / order
        phase = 2 * math.pi / plate.bending_wavelength(frequency) * step
        return float(phase ** (order + 1) / (4 * (order + 1)))

    def interpolation(self, points: FloatArray) -> sparse.csr_array:
        """Shape functions at points [m] (n, 2): sparse (n, node_count), rows sum to 1.

        The element's own shape functions for the deflection, their means at footprints (n, 3).
        Raises InputError for a point off the plate.
        """
        points = np.atleast_2d(np.asarray(points, dtype=float))
        if points.shape[1] == 3:
            return mean_over(self.interpolation, points, length=self.length, width=self.width)
        check_on_plate(points, length=self.length, width=self.width)
        cell_x, weight_x = self._locate(points[:, 0], self.lines[0])
        cell_y, weight_y = self._locate(points[:, 1], self.lines[1])
        weights = weight_y[:, :, None] * weight_x[:, None, :]
        columns = self.connectivity[cell_y * self.element_counts[0] + cell_x]
        rows = np.repeat(np.arange(len(points)), columns.shape[1])
        shape = (len(points), self.node_count)
        return sparse.csr_array((weights.ravel(), (rows, columns.ravel())), shape=shape)

    def _locate(self, position: FloatArray, lines: FloatArray) -> tuple[IntArray, FloatArray]:
        """Element along one direction and shape functions there of each position [m]."""
        cell = np.clip(np.searchsorted(lines, position, side="right") - 1, 0, len(lines) - 2)
        start, end = lines[cell], lines[cell + 1]
        return cell, self.element.shape((2 * position - start - end) / (end - start))


def check_frequencies(plate: Plate, mesh: _Resolves, frequencies: FloatArray) -> None:
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
