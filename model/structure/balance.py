"""Static balance of a rigid plate on its supports: center of mass, static loads, and tipping.

Supports are springs to the ground: ERAs, held exciters and feet. A foot only pushes; bolted or
glued supports can also pull. The plate tips if its center of mass is outside the convex hull of the
supports. A finger that presses outside the hull tips the plate over an edge of the hull.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from model.arrays import FloatArray, Point
from model.structure.attachments import (
    GRAVITY,
    PointLoad,
    Source,
    center_of_mass,
    static_loads,
)
from model.structure.plate import Plate


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
        return np.asarray(ConvexHull(self.supports).equations)

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
    attached = [*(source.support for source in sources), *loads]
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
    return np.asarray(edges[:, :2] @ point + edges[:, 2])
