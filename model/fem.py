"""Finite-element model of the plate: mesh, matrices, and natural modes.

The mesh is a lattice of Reissner-Mindlin rectangles (Reissner, J. Appl. Mech. 12 (1945) A69;
Mindlin, J. Appl. Mech. 18 (1951) 31): MITC4 (the founding paper's) or Q3 to Q5. With Young's
modulus E, shear modulus G and thickness h, the flexural rigidity is D = E h³ / (12 (1 - nu²)), and
the shear rigidity is S = kappa G h (`rigidities`).

A function of the mesh is the product of a function of x and a function of y, and so is an integral
over the plate (`ElementRow`). Thin plates do not lock with elements of the third order and above on
Gauss-Lobatto nodes. The four-node element needs assumed shear strains: along x constant in x, along
y constant in y (Bathe and Dvorkin, Int. J. Num. Meth. Eng. 21 (1985) 367-383). On a rectangle, this
replaces a rotation by its mean along the strain. Narrow elements at a free edge resolve the
boundary layer, which is as wide as the plate is thick and limits elements of low order to linear
convergence (Babuška and Li, Comput. Methods Appl. Mech. Engrg. 100 (1992) 249-273; Häggblad and
Bathe, Int. J. Num. Meth. Eng. 30 (1990) 981-1011).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.polynomial import legendre
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from model.arrays import FloatArray, IntArray, lattice
from model.errors import InputError
from model.structure.attachments import PointLoad, footprints_of
from model.structure.footprints import check_footprints_on_plate, mean_over
from model.structure.modal_elasticity import Discretization
from model.structure.plate import SHEAR_CORRECTION, Plate

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
        """Lagrange polynomials N of a side at xi (n,) in -1..1: (n, order + 1), rows sum to 1."""
        return np.vander(xi, self.order + 1, increasing=True) @ self._coefficients()

    def integrals(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Integrals over -1..1 of N_i N_j, N_i' N_j, N_i' N_j' and R_i R_j, exact, (n, n) each.

        R are the functions of rotations in shear: N, or the means of N for MITC4.
        """
        points, weights = legendre.leggauss(len(self.side))
        powers = np.arange(len(self.side))
        slopes_of_powers = powers * points[:, None] ** np.maximum(powers - 1, 0)
        slope = slopes_of_powers @ self._coefficients()
        shape = self.shape(points)
        weighted_slope = slope.T * weights
        value = (shape.T * weights) @ shape
        sheared = value
        if self.order == 1:
            means = value.sum(axis=1)
            sheared = np.outer(means, means) / 2
        return value, weighted_slope @ shape, weighted_slope @ slope, sheared

    def _coefficients(self) -> FloatArray:
        """Monomial coefficients of the Lagrange polynomials, a column for each node of a side."""
        return np.linalg.inv(np.vander(self.side, increasing=True))


class ElementRow:
    """Elements in a row: nodes at `nodes` (n,) [m] between the ends of elements (m + 1,) [m].

    integrals: sparse (n, n), by the functions of rows and columns: "N N", "N' N", "N N'", "N' N'"
    and "R R", with a prime for slopes and R for rotations in shear (`Element.integrals`).
    """

    def __init__(self, element: Element, ends: FloatArray) -> None:
        self.ends = ends
        self._element = element
        shares = (1 + np.array(element.side[:-1])) / 2
        sizes = np.diff(ends)
        nodes = ends[:-1, None] + shares * sizes[:, None]
        self.nodes = np.append(nodes.ravel(), ends[-1])
        value, mixed, slope, sheared = element.integrals()
        self.integrals = {
            "N N": self._assembled(value, sizes / 2),
            "N' N": self._assembled(mixed, np.ones(len(sizes))),
            "N' N'": self._assembled(slope, 2 / sizes),
            "R R": self._assembled(sheared, sizes / 2),
        }
        self.integrals["N N'"] = self.integrals["N' N"].T.tocsr()

    def numbers(self, cells: IntArray) -> IntArray:
        """Numbers of the nodes of elements (c,), (c, order + 1)."""
        order = self._element.order
        return order * cells[:, None] + np.arange(order + 1)

    def at(self, places: FloatArray) -> tuple[IntArray, FloatArray]:
        """Numbers of nodes, and their functions, at places (p,) [m], (p, order + 1) each."""
        cells = np.searchsorted(self.ends, places, side="right") - 1
        cells = np.clip(cells, 0, len(self.ends) - 2)
        start = self.ends[cells]
        end = self.ends[cells + 1]
        xi = (2 * places - start - end) / (end - start)
        return self.numbers(cells), self._element.shape(xi)

    def _assembled(self, matrix: FloatArray, scales: FloatArray) -> sparse.csr_array:
        numbers = self.numbers(np.arange(len(scales)))
        row, column = np.broadcast_arrays(numbers[:, :, None], numbers[:, None])
        values = (scales[:, None, None] * matrix).ravel()
        size = len(self.nodes)
        return sparse.csr_array((values, (row.ravel(), column.ravel())), shape=(size, size))


def _gauss_lobatto(order: int) -> tuple[float, ...]:
    """The order + 1 nodes: the ends and the extrema of the Legendre polynomial."""
    inner = legendre.Legendre.basis(order).deriv().roots().real
    return (-1.0, *sorted(inner.tolist()), 1.0)


MITC4 = Element("MITC4", (-1.0, 1.0))
Q3, Q4, Q5 = (Element(f"Q{order}", _gauss_lobatto(order)) for order in (3, 4, 5))

ELEMENTS = {element.name: element for element in (MITC4, Q3, Q4, Q5)}
"""All elements by name."""


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
"""Minimum number of nodes to a bending wavelength."""


@dataclass(frozen=True)
class Mesh(Discretization):
    """nx by ny equal rectangles over length by width [m], optionally with strips along the edges.

    strip [m]: width of an additional row of elements along every edge, for the boundary layer of a
    free edge; the nx by ny elements share the rest. The nodes form a lattice: node j * columns + i
    is the i-th along x and the j-th along y.
    """

    element: Element = MITC4
    strip: float = 0.0

    def __post_init__(self) -> None:
        """Reject a mesh without elements, or with strips that fill the plate."""
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
        nx = max(Q5_MIN_ELEMENTS, math.ceil(plate.length / size))
        ny = max(Q5_MIN_ELEMENTS, math.ceil(plate.width / size))
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
        """Largest side lengths (dx, dy) of the elements [m], strips included."""
        dx = (self.length - 2 * self.strip) / self.nx
        dy = (self.width - 2 * self.strip) / self.ny
        return max(dx, self.strip), max(dy, self.strip)

    @cached_property
    def along(self) -> tuple[ElementRow, ElementRow]:
        """Elements along x and along y."""
        return self._row(self.length, self.nx), self._row(self.width, self.ny)

    def _row(self, side: float, count: int) -> ElementRow:
        """Return the elements along a side [m]: `count` elements between the strips."""
        ends = np.linspace(self.strip, side - self.strip, count + 1)
        if self.strip:
            ends = np.concatenate([[0.0], ends, [side]])
        return ElementRow(self.element, ends)

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
        """Numbers of evenly spaced points along x and y that show all details of the mesh.

        The nodes themselves for elements of the first order without strips.
        """
        per_element = 1 if self.element.order == 1 else 2 * self.element.order
        return per_element * self.nx + 1, per_element * self.ny + 1

    @property
    def element_name(self) -> str:
        """Name of the element."""
        return self.element.name

    @property
    def dof(self) -> int:
        """Number of degrees of freedom: w, beta_x, beta_y at each node."""
        return DOF_PER_NODE * self.node_count

    @property
    def shortest_wavelength(self) -> float:
        """Shortest resolved bending wavelength [m]: six elements of the first order."""
        return MIN_NODES_PER_WAVELENGTH * max(self.element_size) / self.element.order

    def resolving(self, plate: Plate, frequency: float) -> Self:
        """Return the coarsest mesh of the element, without strips, for a frequency [Hz]."""
        order = self.element.order
        size = plate.bending_wavelength(frequency) * order / MIN_NODES_PER_WAVELENGTH
        # Rounding must not make an exactly fitting mesh too coarse.
        size *= 1 - 1e-9
        nx = math.ceil(plate.length / size)
        ny = math.ceil(plate.width / size)
        return type(self)(nx, ny, plate.length, plate.width, self.element)

    def interpolation_error(self, plate: Plate, frequency: float) -> float:
        """Return the largest relative error of its shape functions for a wave between nodes.

        A polynomial of order p through nodes at most a step s apart represents a wave k within (k
        s)^(p + 1) / (4 (p + 1)) (Heath, Scientific Computing, 2nd ed., chapter 7).
        """
        order = self.element.order
        step = max(self.element_size) / order
        wavenumber = 2 * math.pi / plate.bending_wavelength(frequency)
        return float((wavenumber * step) ** (order + 1) / (4 * (order + 1)))

    def interpolation(self, points: FloatArray) -> sparse.csr_array:
        """Shape functions at points [m] (n, 2): sparse (n, node_count), rows sum to 1.

        The element's own shape functions for the deflection, their means at footprints (n, 3).
        Raises InputError for a point off the plate.
        """
        points = np.atleast_2d(np.asarray(points, dtype=float))
        if points.shape[1] == 3:
            return mean_over(self.interpolation, points, length=self.length, width=self.width)
        check_footprints_on_plate(points, length=self.length, width=self.width)
        of_x, weight_x = self.along[0].at(points[:, 0])
        of_y, weight_y = self.along[1].at(points[:, 1])
        columns = of_y[:, :, None] * self.columns + of_x[:, None]
        weights = weight_y[:, :, None] * weight_x[:, None]
        rows = np.repeat(np.arange(len(points)), len(self.element.side) ** 2)
        shape = (len(points), self.node_count)
        return sparse.csr_array((weights.ravel(), (rows, columns.ravel())), shape=shape)


RIGID_BODY_MODES = 3  # of a free plate: up and down, and two tilts


class _EnergyTerm(NamedTuple):
    """Term of the stiffness between two fields: w, or the rotations x and y."""

    fields: str
    """Fields of rows and columns."""
    rigidity: str
    """Rigidity that multiplies the integrals."""
    along_x: str
    """Integral along x, a key of `ElementRow.integrals`."""
    along_y: str
    sign: int = 1


_ENERGY = (
    _EnergyTerm("ww", "shear_x", "N' N'", "N N"),
    _EnergyTerm("ww", "shear_y", "N N", "N' N'"),
    _EnergyTerm("wx", "shear_x", "N' N", "N N", -1),
    _EnergyTerm("wy", "shear_y", "N N", "N' N", -1),
    _EnergyTerm("xx", "shear_x", "R R", "N N"),
    _EnergyTerm("xx", "bending_x", "N' N'", "N N"),
    _EnergyTerm("xx", "twist", "N N", "N' N'"),
    _EnergyTerm("yy", "shear_y", "N N", "R R"),
    _EnergyTerm("yy", "bending_y", "N N", "N' N'"),
    _EnergyTerm("yy", "twist", "N' N'", "N N"),
    _EnergyTerm("xy", "coupled", "N' N", "N N'"),
    _EnergyTerm("xy", "twist", "N N'", "N' N"),
)
"""Strain energy of bending and shear (paper Eq. 17)."""


def rigidities(plate: Plate) -> dict[str, float]:
    """Bending, coupled and twist [N m], and shear [N/m] of a plate's section (paper Eq. 5 to 7).

    bending: D; coupled: nu D; twist: G h³ / 12, between the rotations; shear: S = kappa G h.
    """
    material = plate.material
    shares = material.shares
    h = plate.thickness
    D = material.E * h**3 / (12 * material.plane_stress)
    S = SHEAR_CORRECTION * material.E * h
    return {
        "bending_x": D,
        "bending_y": shares.e2 * D,
        "coupled": material.nu * shares.e2 * D,
        "twist": shares.g12 * material.E * h**3 / 12,
        "shear_x": shares.g13 * S,
        "shear_y": shares.g23 * S,
    }


@dataclass(frozen=True)
class PlateMatrices:
    """Sparse stiffness and mass of the free plate (dof, dof), CSC, with their mesh.

    Degree of freedom 3 * node is the deflection, the next two are the rotations.
    """

    plate: Plate
    mesh: Mesh
    stiffness: sparse.csc_array
    mass: sparse.csc_array

    def deflection_at(self, points: FloatArray) -> sparse.csr_array:
        """Return the sparse map (n, dof) of degrees of freedom to deflections at points (n, 2)."""
        deflection = sparse.csr_array(np.array([[1.0, 0.0, 0.0]]))
        interpolation = self.mesh.interpolation(points)
        return sparse.csr_array(sparse.kron(interpolation, deflection, format="csr"))


def assemble(plate: Plate, mesh: Mesh) -> PlateMatrices:
    """Assemble stiffness and mass of the free plate.

    Raises InputError for a mesh of another plate, and for a plate of layers or with air.
    """
    if plate.needs_polynomials:
        what = "a laminate" if plate.laminate is not None else "a plate with air"
        raise InputError(
            f"mesh: must be of polynomials for {what}, got {mesh}; finite elements are for "
            "homogeneous plates in a vacuum: use mesh auto, or Legendre with degrees"
        )
    has_length = math.isclose(plate.length, mesh.length)
    has_width = math.isclose(plate.width, mesh.width)
    if not (has_length and has_width):
        raise InputError(
            f"mesh: must cover the plate of {plate.length:g} x {plate.width:g} m, got "
            f"{mesh.length:g} x {mesh.width:g} m; make the mesh for this plate"
        )
    density = plate.surface_density
    rotary = density * plate.thickness**2 / 12
    along_x, along_y = mesh.along
    value = sparse.kron(along_y.integrals["N N"], along_x.integrals["N N"])
    mass = sparse.kron(value, np.diag([density, rotary, rotary]))  # paper Eq. 19 and 20
    return PlateMatrices(
        plate=plate,
        mesh=mesh,
        stiffness=_stiffness(mesh, rigidities(plate)),
        mass=sparse.csc_array(mass),
    )


def _stiffness(
    mesh: Mesh, section: Mapping[str, float], by_side: str | None = None
) -> sparse.csc_array:
    """Return the stiffness (dof, dof) for a section's rigidities, or its derivative by a side.

    The derivative is with respect to the logarithm of the side "x" or "y", at constant mass.
    Functions are stretched with the side. Slopes and rotations along it are proportional to its
    reciprocal s, so each part is proportional to a power of s.
    """
    along_x, along_y = mesh.along
    blocks: dict[str, Any] = {}
    for term in _ENERGY:
        factor = term.sign * section[term.rigidity]
        if by_side is not None:
            integral = term.along_x if by_side == "x" else term.along_y
            factor *= -(term.fields.count(by_side) + integral.count("'"))
        part = sparse.kron(along_y.integrals[term.along_y], along_x.integrals[term.along_x])
        blocks[term.fields] = blocks.get(term.fields, 0) + factor * part
    stiffness: Any = 0
    for fields, block in blocks.items():
        row, column = map("wxy".index, fields)
        between_fields = np.zeros((DOF_PER_NODE, DOF_PER_NODE))
        between_fields[row, column] = 1
        addend = sparse.kron(block, between_fields, format="csc")
        if row != column:
            addend = addend + addend.T
        stiffness = stiffness + addend
    return sparse.csc_array(stiffness)


def simply_supported_modes(
    matrices: PlateMatrices, count: int, loads: Sequence[PointLoad] = ()
) -> tuple[FloatArray, FloatArray]:
    """Natural frequencies (n,) [Hz], ascending, and undamped modes (dof, n) of modal mass 1.

    The deflection of all four edges is zero, and their rotation is free. Raises InputError for a
    count above the mesh's number of modes.
    """
    mesh = matrices.mesh
    at_loads = matrices.deflection_at(footprints_of(loads))
    springs = sparse.diags_array(np.array([load.stiffness for load in loads], dtype=float))
    masses = sparse.diags_array(np.array([load.mass for load in loads], dtype=float))
    is_free = np.ones((mesh.rows, mesh.columns, DOF_PER_NODE), dtype=bool)
    is_free[[0, -1], :, 0] = False
    is_free[:, [0, -1], 0] = False
    free = np.flatnonzero(is_free)
    stiffness = sparse.csc_array(matrices.stiffness + at_loads.T @ springs @ at_loads)
    mass = sparse.csc_array(matrices.mass + at_loads.T @ masses @ at_loads)
    eigenvalues, vectors = lowest_modes(
        sparse.csc_array(stiffness[free][:, free]),
        sparse.csc_array(mass[free][:, free]),
        count,
        shift=(2 * np.pi * matrices.plate.lowest_bending_frequency) ** 2,
    )
    modes = np.zeros((mesh.dof, count))
    modes[free] = vectors
    return np.sqrt(np.maximum(eigenvalues, 0)) / (2 * np.pi), modes


def lowest_modes(
    stiffness: sparse.csc_array, mass: sparse.csc_array, count: int, *, shift: float
) -> tuple[FloatArray, FloatArray]:
    """Solve K phi = omega² M phi for the lowest eigenpairs; a few by shift-invert Lanczos.

    Returns omega² ascending (count,) and vectors (dof, count) of unit modal mass. shift [rad²/s²]:
    above zero, of the order of the lowest elastic omega²; K + shift M is then positive definite
    although K is singular for a free plate.
    """
    size = stiffness.shape[0]
    if count > size:
        raise InputError(
            f"modes must be at most the mesh's {size} free degrees of freedom, got {count}; take "
            "fewer modes or a finer mesh"
        )
    if count >= size / 2:
        lowest = (0, count - 1)
        return linalg.eigh(stiffness.toarray(), mass.toarray(), subset_by_index=lowest)
    factor = factorize(stiffness + shift * mass)
    eigenvalues, vectors = eigsh(
        stiffness,
        count,
        M=mass,
        sigma=-shift,
        which="LM",
        OPinv=LinearOperator(stiffness.shape, matvec=factor.solve, dtype=float),
        v0=np.random.default_rng(0).standard_normal(size),  # ARPACK's own start is random
    )
    order = np.argsort(eigenvalues, kind="stable")
    return eigenvalues[order], vectors[:, order]


def factorize(matrix: sparse.sparray) -> SuperLU:
    """Factorize a matrix with symmetric pattern and a strong diagonal.

    SuperLU's defaults, meant for unsymmetric matrices, take several times longer here; a pivot
    threshold above zero alone made it 80 times slower.
    """
    return splu(
        sparse.csc_array(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def element_slopes(plate: Plate, mesh: Mesh, shapes: FloatArray) -> FloatArray:
    """Return derivatives (3, r, r) of the stiffness between shapes (dof, r) of a plate on a mesh.

    With respect to the logarithms of length and width, at constant mass, and to Poisson's ratio.
    They are exact, as explained in `model.spectral.direct_solution`.
    """
    material = plate.material
    section = rigidities(plate)
    by_nu = dict.fromkeys(section, 0.0)
    if material.orthotropy is None:  # otherwise shear moduli do not follow from nu
        for key, value in section.items():
            by_nu[key] = -value / (1 + material.nu)
    for key in ("bending_x", "bending_y"):
        by_nu[key] = 2 * material.nu * material.shares.e2 / material.plane_stress * section[key]
    by_nu["coupled"] = material.nu * by_nu["bending_y"] + section["bending_y"]
    slopes = (
        _stiffness(mesh, section, "x"),
        _stiffness(mesh, section, "y"),
        _stiffness(mesh, by_nu),
    )
    return np.array([shapes.T @ (slope @ shapes) for slope in slopes])
