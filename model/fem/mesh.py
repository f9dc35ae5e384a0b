"""A structured mesh over the plate of Reissner-Mindlin rectangles: MITC4, the paper's, Q3 to Q5.

Every function of the mesh is the product of one of x and one of y, and so is every integral over
the plate (`ElementRow`). From the third order on, on Gauss-Lobatto nodes, thin plates do not lock.
The four-node element would: its shear strain along x is assumed constant along x, that along y
constant along y (Bathe and Dvorkin, Int. J. Num. Meth. Eng. 21 (1985) 367-383), which on a
rectangle takes rotations by their mean along the strain. Narrow elements at a free edge resolve the
boundary layer, as wide as the plate is thick, that limits elements of low order to linear
convergence (Babuška and Li, Comput. Methods Appl. Mech. Engrg. 100 (1992) 249-273; Häggblad and
Bathe, Int. J. Num. Meth. Eng. 30 (1990) 981-1011).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.polynomial import legendre
from scipy import sparse

from model.arrays import FloatArray, IntArray, lattice
from model.errors import InputError
from model.structure.discretisation import Discretisation
from model.structure.footprint import check_on_plate, mean_over
from model.structure.plate import Plate

DOF_PER_NODE = 3


@dataclass(frozen=True)
class Element:
    """A rectangle of (order + 1)² nodes with the degrees of freedom w, beta_x, beta_y at each.

    side: node positions along a side, from -1 to 1, (order + 1,); the same along x and y. Each
    field is the tensor product of the Lagrange polynomials of the side; beta_x, beta_y are the
    rotations of paper Eq. 1.
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

    def integrals(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Integrals over -1..1 of N_i N_j, N_i' N_j and N_i' N_j', exact, (n, n) each.

        And those of N_i N_j as rotations take part in shear: of MITC4 by their means.
        """
        points, weights = legendre.leggauss(len(self.side))
        powers = np.arange(len(self.side))
        shape = self.shape(points)
        slope = powers * points[:, None] ** np.maximum(powers - 1, 0) @ self._coefficients()
        value = (shape.T * weights) @ shape
        means = value.sum(axis=1)
        sheared = np.outer(means, means) / 2 if self.order == 1 else value
        return value, (slope.T * weights) @ shape, (slope.T * weights) @ slope, sheared

    def _coefficients(self) -> FloatArray:
        """Monomial coefficients of the Lagrange polynomials, a column for each node of a side."""
        return np.asarray(np.linalg.inv(np.vander(self.side, increasing=True)))


class ElementRow:
    """Elements in a row: nodes at `nodes` (n,) [m] between the ends of elements (m + 1,) [m].

    integrals: by name, sparse (n, n), of functions "vv", of a slope and a function "sv" and "vs",
    of slopes "ss", and of rotations in shear "rr".
    """

    def __init__(self, element: Element, ends: FloatArray) -> None:
        self.ends, self._element = ends, element
        share = (1 + np.array(element.side[:-1])) / 2
        sizes = np.diff(ends)
        self.nodes = np.append((ends[:-1, None] + share * sizes[:, None]).ravel(), ends[-1])
        value, mixed, slope, sheared = element.integrals()
        self.integrals = {
            "vv": self._assembled(value, sizes / 2),
            "sv": self._assembled(mixed, np.ones(len(sizes))),
            "ss": self._assembled(slope, 2 / sizes),
            "rr": self._assembled(sheared, sizes / 2),
        }
        self.integrals["vs"] = self.integrals["sv"].T.tocsr()

    def numbers(self, cells: IntArray) -> IntArray:
        """Numbers of the nodes of elements (c,), (c, order + 1)."""
        order = self._element.order
        return np.asarray(order * cells[:, None] + np.arange(order + 1))

    def at(self, places: FloatArray) -> tuple[IntArray, FloatArray]:
        """Numbers of nodes, and their functions, at places (p,) [m], (p, order + 1) each."""
        cells = np.searchsorted(self.ends, places, side="right") - 1
        cells = np.clip(cells, 0, len(self.ends) - 2)
        start, end = self.ends[cells], self.ends[cells + 1]
        return self.numbers(cells), self._element.shape((2 * places - start - end) / (end - start))

    def _assembled(self, matrix: FloatArray, scales: FloatArray) -> sparse.csr_array:
        numbers = self.numbers(np.arange(len(scales)))
        row, column = np.broadcast_arrays(numbers[:, :, None], numbers[:, None])
        values = (scales[:, None, None] * matrix).ravel()
        size = len(self.nodes)
        places = (row.ravel(), column.ravel())
        return sparse.csr_array(sparse.coo_array((values, places), shape=(size, size)))


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


# An accurate mesh. The lowest twelve natural frequencies of the paper's plate are then within
# 0.01 % of converged, and its accelerations (relative L2) within 0.1 % with ERAs at the corners,
# 0.2 % with ERAs elsewhere and 0.6 % there at a resonance: a point force bends the plate more
# sharply than an element does.
Q5_PER_WAVELENGTH = 5.5
Q5_MIN_ELEMENTS = 3
Q5_STRIP_THICKNESSES = 2.0  # the free edge's boundary layer is as wide as h

MIN_NODES_PER_WAVELENGTH = 6
"""With fewer nodes to a bending wavelength a mesh is refused."""


@dataclass(frozen=True)
class Mesh(Discretisation):
    """nx by ny equal rectangles over length by width [m], optionally with strips along the edges.

    strip [m]: width of one more row of elements along every edge, for the boundary layer of a free
    edge; the nx by ny elements then share the rest. The nodes form a lattice: node j * columns + i
    is the i-th along x and the j-th along y.
    """

    element: Element = MITC4
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
        return cls(nx, ny, plate.length, plate.width, Q5, strip)

    def __str__(self) -> str:
        text = f"{self.nx}x{self.ny}"
        if self.element != MITC4:
            text += f" {self.element.name}"
        if self.strip:
            text += f" with strips of {1000 * self.strip:g} mm"
        return text

    @property
    def element_size(self) -> tuple[float, float]:
        """Side lengths (dx, dy) of the nx by ny elements, the largest ones [m]."""
        return (self.length - 2 * self.strip) / self.nx, (self.width - 2 * self.strip) / self.ny

    @cached_property
    def along(self) -> tuple[ElementRow, ElementRow]:
        """Its elements along x and along y."""
        found = []
        for length, count in ((self.length, self.nx), (self.width, self.ny)):
            ends = np.linspace(self.strip, length - self.strip, count + 1)
            if self.strip:
                ends = np.concatenate([[0.0], ends, [length]])
            found.append(ElementRow(self.element, ends))
        return found[0], found[1]

    @property
    def columns(self) -> int:
        """Number of nodes along x."""
        return len(self.along[0].nodes)

    @property
    def rows(self) -> int:
        """Number of nodes along y."""
        return len(self.along[1].nodes)

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return self.columns * self.rows

    @cached_property
    def nodes(self) -> FloatArray:
        """Positions of the nodes [m], (node_count, 2), x running first."""
        return lattice(*(line.nodes for line in self.along))

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
        return DOF_PER_NODE * self.node_count

    @property
    def shortest_wavelength(self) -> float:
        """The shortest bending wavelength [m] that it resolves: six elements of the first order."""
        return MIN_NODES_PER_WAVELENGTH * max(self.element_size) / self.element.order

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """The coarsest of its element, without strips, that resolves a frequency [Hz]."""
        order = self.element.order
        size = plate.bending_wavelength(frequency) * order / MIN_NODES_PER_WAVELENGTH
        # Rounding must not turn a mesh that fits exactly into one too coarse.
        size *= 1 - 1e-9
        nx, ny = (math.ceil(side / size) for side in (plate.length, plate.width))
        return type(self)(nx, ny, plate.length, plate.width, self.element)

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
        of_x, weight_x = self.along[0].at(points[:, 0])
        of_y, weight_y = self.along[1].at(points[:, 1])
        columns = of_y[:, :, None] * self.columns + of_x[:, None]
        weights = weight_y[:, :, None] * weight_x[:, None]
        rows = np.repeat(np.arange(len(points)), len(self.element.side) ** 2)
        shape = (len(points), self.node_count)
        return sparse.csr_array((weights.ravel(), (rows, columns.ravel())), shape=shape)
