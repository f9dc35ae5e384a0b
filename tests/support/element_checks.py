"""What the matrices of a plate element must keep.

All but the last use the element's matrices only; the last solves a plate.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.linalg import eigh

from model.arrays import FloatArray
from model.fem.mesh import DOF_PER_NODE, Element, Mesh, rigidities
from model.fem.plate import assemble, lowest_modes
from model.structure.plate import Material, Plate

DX, DY = 0.03, 0.02  # m; not square, so that a swap of x and y shows
PLATE = Plate(0.3, 0.24, 0.002, Material("aluminium", E=70e9, rho=2700.0, nu=0.33))
THIN = Plate(0.3, 0.24, 0.3e-3, PLATE.material)  # so thin that locking shows
COARSE = 4  # elements a side of the coarser mesh

MIN_RATE = 1.8
"""Least order of convergence of a natural frequency in the element size."""

_SMALL = 1e-9  # relative rounding error
_EXACT = 1e-7  # relative error of a frequency below which no order can be measured

Field: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray | float]


@dataclass(frozen=True)
class ElementCheck:
    """One check: its name, what it requires, and a function that returns the problem, if any."""

    name: str
    requirement: str
    problem: Callable[[Element], str | None]


def nodes(element: Element) -> str | None:
    """Its nodes ascend from -1 to 1 along a side, symmetric about the middle."""
    side = np.array(element.side)
    if len(side) < 2 or side[0] != -1 or side[-1] != 1 or (np.diff(side) <= 0).any():
        return f"side must ascend from -1 to 1, got {element.side}"
    if np.abs(side + side[::-1]).max() > _SMALL:
        return f"side must be symmetric about 0, got {element.side}"
    return None


def matrices(element: Element) -> str | None:
    """Its matrices have three degrees of freedom a node and are symmetric, the mass definite."""
    size = DOF_PER_NODE * len(element.side) ** 2
    for name, matrix in _both(element).items():
        if matrix.shape != (size, size):
            return f"{name} must have the shape {(size, size)}, got {matrix.shape}"
        if np.abs(matrix - matrix.T).max() > _SMALL * np.abs(matrix).max():
            return f"{name} must be symmetric"
    least = np.linalg.eigvalsh(element.mass(PLATE, DX, DY))[0]
    return None if least > 0 else f"mass must be positive definite, got the eigenvalue {least:g}"


def mirror(element: Element) -> str | None:
    """Its matrices are symmetric under reflection along x and y, as a quarter plate requires."""
    count = len(element.side)
    number = np.arange(count**2).reshape(count, count)
    for along, order, signs in (
        ("x", number[:, ::-1], np.array([1.0, -1.0, 1.0])),
        ("y", number[::-1], np.array([1.0, 1.0, -1.0])),
    ):
        place = (DOF_PER_NODE * order.reshape(-1, 1) + np.arange(DOF_PER_NODE)).ravel()
        sign = np.tile(signs, count**2)
        for name, matrix in _both(element).items():
            mirrored = matrix[np.ix_(place, place)] * np.outer(sign, sign)
            if np.abs(mirrored - matrix).max() > _SMALL * np.abs(matrix).max():
                return f"{name} must be symmetric under reflection along {along}"
    return None


def rigid_motions(element: Element) -> str | None:
    """A rigid-body motion takes no force."""
    stiffness = element.stiffness(PLATE, DX, DY)
    for name, motion in {
        "moved up": _nodal(element, lambda x, y: 1.0, _zero, _zero),
        "tilted along x": _nodal(element, lambda x, y: x, lambda x, y: 1.0, _zero),
        "tilted along y": _nodal(element, lambda x, y: y, _zero, lambda x, y: 1.0),
    }.items():
        force = np.abs(stiffness @ motion).max()
        if force > _SMALL * np.abs(stiffness).max():
            return f"force must be zero when {name}, got {force:.3g}"
    return None


def no_other_free_motion(element: Element) -> str | None:
    """No other motion takes no force: there are no spurious modes."""
    energies = np.linalg.eigvalsh(element.stiffness(PLATE, DX, DY))
    free = int((energies <= _SMALL * energies[-1]).sum())
    return None if free == 3 else f"zero-energy motions must be 3, got {free}"


def bending(element: Element) -> str | None:
    """Constant curvature has the energy of thin-plate theory: along x, along y, saddle, twist.

    Per area D/2 for a unit curvature one way, D (1 - nu) for a saddle and for a twist of
    w = x y.
    """
    rigidity, nu = PLATE.flexural_rigidity, PLATE.material.nu
    shapes: dict[str, tuple[Field, Field, Field, float]] = {
        "along x": (lambda x, y: x**2 / 2, lambda x, y: x, _zero, rigidity / 2),
        "along y": (lambda x, y: y**2 / 2, _zero, lambda x, y: y, rigidity / 2),
        "as a saddle": (
            lambda x, y: (x**2 - y**2) / 2,
            lambda x, y: x,
            lambda x, y: -y,
            rigidity * (1 - nu),
        ),
        "twisted": (
            lambda x, y: x * y,
            lambda x, y: y,
            lambda x, y: x,
            rigidity * (1 - nu),
        ),
    }
    for name, (w, beta_x, beta_y, expected) in shapes.items():
        wrong = _wrong_energy(element, _nodal(element, w, beta_x, beta_y), expected)
        if wrong:
            return f"bent {name}: {wrong}"
    return None


def shear(element: Element) -> str | None:
    """Constant shear, w = x without rotation, has the energy kappa G h / 2 per area."""
    _, rigidity, _ = rigidities(PLATE)
    for name, w in (("x", lambda x, y: x), ("y", lambda x, y: y)):
        wrong = _wrong_energy(element, _nodal(element, w, _zero, _zero), rigidity / 2)
        if wrong:
            return f"sheared along {name}: {wrong}"
    return None


def inertia(element: Element) -> str | None:
    """Its mass is rho h dx dy and its rotary inertia rho h³ / 12 dx dy."""
    density = PLATE.material.rho * PLATE.thickness
    mass = element.mass(PLATE, DX, DY)
    for name, motion, expected in (
        ("up", _nodal(element, lambda x, y: 1.0, _zero, _zero), density),
        ("along x", _nodal(element, _zero, lambda x, y: 1.0, _zero), _rotary(density)),
        ("along y", _nodal(element, _zero, _zero, lambda x, y: 1.0), _rotary(density)),
    ):
        found = float(motion @ mass @ motion) / (DX * DY)
        if abs(found - expected) > _SMALL * expected:
            return f"inertia {name} must be {expected:.6g} per area, got {found:.6g}"
    return None


def convergence(element: Element) -> str | None:
    """A thin plate's lowest frequency converges nearly with the square of the element size.

    Or faster, or it is exact. The plate is simply supported, a thousand times as long as thick, and
    known in closed form; an element that locks fails here.
    """
    coarse, fine = (frequency_error(element, count) for count in (COARSE, 2 * COARSE))
    if abs(fine) < _EXACT or rate(coarse, fine) >= MIN_RATE:
        return None
    return (
        f"order of convergence must be at least {MIN_RATE:g}, got {rate(coarse, fine):.2f} (error "
        f"{coarse:.3%}, with halved elements {fine:.3%})"
    )


CHECKS = tuple(
    ElementCheck(check.__name__, (check.__doc__ or "").partition("\n")[0].rstrip("."), check)
    for check in (
        nodes,
        matrices,
        mirror,
        rigid_motions,
        no_other_free_motion,
        bending,
        shear,
        inertia,
        convergence,
    )
)
"""In the order in which they build on each other."""


def frequency_error(element: Element, count: int) -> float:
    """Relative error of a thin plate's lowest natural frequency with count by count elements.

    On hard simple supports, w and the rotation along the
    edge fixed, w = sin(pi x / L) sin(pi y / W) with rotations alike solves the Reissner-Mindlin
    plate exactly.
    """
    mesh = Mesh(count, count, THIN.length, THIN.width, element)
    assembled = assemble(THIN, mesh)
    node = np.arange(mesh.node_count).reshape(mesh.rows, mesh.columns)
    sides, ends = node[:, [0, -1]].ravel(), node[[0, -1]].ravel()
    fixed = np.concatenate([3 * sides, 3 * sides + 2, 3 * ends, 3 * ends + 1])
    free = np.setdiff1d(np.arange(assembled.dof), fixed)
    exact = _exact_omega_squared(THIN)
    eigenvalues, _ = lowest_modes(
        assembled.stiffness[free][:, free], assembled.mass[free][:, free], 1, shift=exact
    )
    return float(np.sqrt(max(eigenvalues[0], 0.0) / exact) - 1)


def rate(coarse: float, fine: float) -> float:
    """Order of convergence from errors with elements of one size and of half of it."""
    return float(np.log2(abs(coarse) / abs(fine)))


def _exact_omega_squared(plate: Plate) -> float:
    a, b = np.pi / plate.length, np.pi / plate.width
    _, shear_rigidity, moving = rigidities(plate)
    D, nu, S = plate.flexural_rigidity, plate.material.nu, shear_rigidity
    coupled = D * a * b * (1 + nu) / 2
    stiffness = np.array(
        [
            [S * (a**2 + b**2), -S * a, -S * b],
            [-S * a, D * (a**2 + (1 - nu) / 2 * b**2) + S, coupled],
            [-S * b, coupled, D * (b**2 + (1 - nu) / 2 * a**2) + S],
        ]
    )
    return float(eigh(stiffness, moving, eigvals_only=True)[0])


def _both(element: Element) -> dict[str, FloatArray]:
    return {
        "stiffness": element.stiffness(PLATE, DX, DY),
        "mass": element.mass(PLATE, DX, DY),
    }


def _nodal(element: Element, w: Field, beta_x: Field, beta_y: Field) -> FloatArray:
    """Degrees of freedom of the element for fields of x and y [m] from its lower left."""
    side = (1 + np.array(element.side)) / 2
    x, y = np.tile(DX * side, len(side)), np.repeat(DY * side, len(side))
    fields = [np.broadcast_to(field(x, y), x.shape) for field in (w, beta_x, beta_y)]
    return np.stack(fields, axis=1).ravel()


def _wrong_energy(element: Element, motion: FloatArray, expected: float) -> str | None:
    found = float(motion @ element.stiffness(PLATE, DX, DY) @ motion) / 2 / (DX * DY)
    if abs(found - expected) <= _SMALL * expected:
        return None
    return f"the energy must be {expected:.6g} per area, got {found:.6g}"


def _rotary(density: float) -> float:
    return density * PLATE.thickness**2 / 12


def _zero(x: FloatArray, y: FloatArray) -> float:
    return 0.0
