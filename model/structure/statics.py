"""Statics of a rigid plate on its supports: rigid-body modes, static loads, balance and tipping.

Supports are springs to the ground: ERAs, exciters whose magnet a frame holds, and feet. They
support the plate if they hold all of its rigid-body modes. The displacement of the rigid plate is
w = q' p, with

    p = (1, x / L - 1/2, y / W - 1/2),

so that both tilts have the size of the heave. The plate tips if its center of mass is outside the
convex hull of the supports. A finger that presses outside the hull tips the plate over an edge of
the hull. A foot only pushes; bolted or glued supports can also pull.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray, Point
from model.errors import InputError
from model.structure.attachments import PointLoad
from model.structure.plate import Plate
from model.structure.sources import Source
from model.structure.surface import center_of_surface, moments_of_surface

GRAVITY = 9.80665
"""Standard acceleration of gravity, g [m/s²]."""

MIN_RIGID_BODY_FREQUENCY = 1.0
"""Hz. Under its own weight a plate moves by g / omega²: 25 cm in a mode of this frequency."""


def rigid_body_frequencies(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> FloatArray:
    """Natural frequencies (3,) [Hz] of the rigid plate on its springs, ascending.

    K = sum k p p', M = plate + sum m p p'. A mode that no spring holds has frequency 0.
    """
    p, stiffness, mass = _supports(plate, eras, loads)
    K = (p * stiffness) @ p.T
    M = (p * mass) @ p.T + _rigid_mass_matrix(plate)
    inverse = np.linalg.inv(np.linalg.cholesky(M))
    eigenvalues = np.linalg.eigvalsh(inverse @ K @ inverse.T)
    return np.asarray(np.sqrt(np.maximum(eigenvalues, 0.0)) / (2 * np.pi))


def _rigid_mass_matrix(plate: Plate) -> FloatArray:
    """Return the mass matrix (3, 3) [kg] of the bare rigid plate in p.

    A surface whose modes show its moments can have its center of mass and its inertia anywhere.
    """
    moments = None if plate.surface is None else moments_of_surface(plate.surface)
    if moments is None:
        return np.diag([plate.mass, plate.mass / 12, plate.mass / 12])
    to_sides = np.array(
        [[1.0, 0.0, 0.0], [-0.5, 1 / plate.length, 0.0], [-0.5, 0.0, 1 / plate.width]]
    )
    return np.asarray(plate.mass * to_sides @ moments @ to_sides.T)


def static_loads(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> FloatArray:
    """Weight [N] of the rigid plate on each ERA, and then on each spring among the loads.

    Excludes an exciter whose magnet is free: it carries nothing, but its weight counts. At least
    three springs must not be in one line. K q = sum of weights p; the reactions are k p' q.
    """
    p, stiffness, mass = _supports(plate, eras, loads)
    center = _rigid_shape(plate, *center_of_mass(plate))
    weight = GRAVITY * (p @ mass + plate.mass * center)
    q = np.linalg.solve((p * stiffness) @ p.T, weight)
    return (stiffness * (q @ p))[stiffness > 0]


def center_of_mass(plate: Plate) -> Point:
    """Return the center of mass [m] of a bare plate, or of a surface according to its modes."""
    if plate.surface is not None:
        center = center_of_surface(plate.surface)
        if center is not None:
            return center
    return plate.length / 2, plate.width / 2


def _supports(
    plate: Plate, eras: Sequence[Source], loads: Sequence[PointLoad]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return p (3, n), stiffness [N/m] and mass [kg] (n,) of all attachments."""
    attached = _static_equivalents(eras, loads)
    mounts = [(at.x, at.y, at.stiffness, at.mass) for at in attached]
    x, y, stiffness, mass = np.array(mounts, dtype=float).reshape(-1, 4).T
    return _rigid_shape(plate, x, y), stiffness, mass


def _static_equivalents(eras: Sequence[Source], loads: Sequence[PointLoad]) -> list[PointLoad]:
    return [*(era.support for era in eras), *loads]


def _rigid_shape(plate: Plate, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
    """Return p at x, y [m], (3, ...)."""
    return np.stack([np.ones_like(x), x / plate.length - 0.5, y / plate.width - 0.5])


def support_problem(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> str | None:
    """Describe why ERAs and loads do not support a plate, with the remedy; None if they do."""
    if plate.surface is not None and not plate.surface.rigid:
        return None  # its modes include its mounts
    lowest = rigid_body_frequencies(plate, eras, loads=loads)[0]
    if lowest >= MIN_RIGID_BODY_FREQUENCY:
        return None
    return (
        f"the plate is not supported: its lowest rigid-body frequency must be at least "
        f"{MIN_RIGID_BODY_FREQUENCY:g} Hz, got {lowest:.2g} Hz; put at least three ERAs or "
        "supports under it, stiff enough and not in one line; a free exciter holds nothing"
    )


def check_supported(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> None:
    """Raise InputError for a plate that its ERAs and loads do not support."""
    problem = support_problem(plate, eras, loads=loads)
    if problem is not None:
        raise InputError(problem)


@dataclass(frozen=True, eq=False)
class Balance:
    """A plate at rest on n supports, which are not in one line."""

    weight: float
    """Weight of the plate and everything that moves with it [N]."""
    center: Point
    """Center of mass [m]."""
    supports: FloatArray
    """Positions of the supports (n, 2) [m]."""
    loads: FloatArray
    """Static load of each support (n,) [N], negative if it is pulled upwards."""

    @property
    def edges(self) -> FloatArray:
        """Edges of the supports' convex hull (e, 3): unit normal outwards, and offset [m].

        normal · point + offset is the distance of a point to the edge, positive outside.
        """
        from scipy.spatial import ConvexHull  # slow to import

        return ConvexHull(self.supports).equations

    @property
    def inside(self) -> float:
        """Distance of the center of mass to the nearest edge [m], negative outside the hull."""
        return float(np.min(-_distances(self.edges, self.center)))

    @property
    def inside_share(self) -> float:
        """Smallest distance to an edge, relative to the hull's depth behind that edge.

        On three supports it equals the smallest fraction of the weight on a support.
        """
        edges = self.edges
        depths = np.max(-(self.supports @ edges[:, :2].T + edges[:, 2]), axis=0)
        return float(np.min(-_distances(edges, self.center) / depths))

    def tipping_force(self, points: Iterable[Point]) -> tuple[float, Point] | None:
        """Return the smallest force [N] on any given point [m] that tips the plate, and the point.

        None if no point is outside the hull. The center of mass must be within it.
        """
        edges = self.edges
        holding = -self.weight * _distances(edges, self.center)  # N m, about each edge
        smallest: tuple[float, Point] | None = None
        for point in points:
            levers = _distances(edges, point)
            is_outside = levers > 0
            if not is_outside.any():
                continue
            force = float(np.min(holding[is_outside] / levers[is_outside]))
            if smallest is None or force < smallest[0]:
                smallest = force, point
        return smallest


def balance_of(plate: Plate, sources: Sequence[Source], loads: Sequence[PointLoad] = ()) -> Balance:
    """Return the balance of a plate on its sources and loads.

    Static loads are computed for a rigid plate on springs; on three supports they follow from the
    positions alone.
    """
    attached = _static_equivalents(sources, loads)
    springs = [support for support in attached if support.stiffness > 0]
    masses = np.array([plate.mass, *(load.mass for load in attached)])
    positions = np.array([center_of_mass(plate), *((load.x, load.y) for load in attached)])
    x, y = (masses @ positions / masses.sum()).tolist()
    return Balance(
        weight=GRAVITY * float(masses.sum()),
        center=(x, y),
        supports=np.array([(support.x, support.y) for support in springs]),
        loads=static_loads(plate, sources, loads=loads),
    )


def _distances(edges: FloatArray, point: Point) -> FloatArray:
    """Distances [m] of a point to edges (e, 3), positive outside."""
    return edges[:, :2] @ point + edges[:, 2]
