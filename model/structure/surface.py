"""Surface defined by normal modes, computed by another program or measured in a modal test.

It replaces the plate in a rig (`surface` instead of `plate`). Where other modules need plate
properties (wavelengths, weight, bounding rectangle), a homogeneous plate with the same number of
modes and the same mass is used. Touch coordinates are in the plane perpendicular to the normal,
with the origin at the corner of the bounding rectangle of all nodes, or the origin stated by the
file.

The mass is the mass in rigid motion along the normal: with modes phi of unit modal mass and
coefficients c such that sum c phi = 1, it is |c|². Mounts that hold the surface must be included
either in the modes or in the rig, not in both.

Not modeled: in-plane forces and motion, including the actuators'.
"""

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, Point
from model.errors import InputError

if TYPE_CHECKING:  # only a surface needs it
    from model.files.modal_file import ModeShapes

Rings: TypeAlias = tuple[tuple[Point, ...], ...]

THICKNESS, NU = 2e-3, 0.25
"""Thickness [m] and Poisson's ratio of the homogeneous plate, both arbitrary."""

EDGES = 1.25
"""Number of modes of a plate with free edges relative to the estimate from its area alone."""

LEAST_KNOWN, WELL_KNOWN = 1.15, 3.0
"""Multiples of the highest frequency up to which modes must be known, and should be: with fewer,
fields were wrong by a fifth; with those up to three times by 3 %."""

MAX_DEVIATING = 64
"""Number of lowest elastic modes that can differ from a file's modes."""

RIGID_FREQUENCY = 1.0  # Hz; below it a mode is of the rigid body
_ALONG_NORMAL = 0.2  # normal motion of a rigid mode, relative to the mode with the most
_SEEN = 1e-3  # normal motion of an elastic mode, relative to the median; others are in-plane
_TILTING = 3  # rigid modes of a free surface, which moves along the normal and tilts
_FEWEST = 6  # minimum number of nodes, and of elastic modes
_NEIGHBORS = 9  # nodes that define the plane for a normal
_ON_OUTLINE = 1e-3  # m; a point within this distance of the outline is on the surface
_SAME_MASS = 0.1
_SAME_LOSS = 0.01


@dataclass(frozen=True)
class Surface:
    """Properties of a plate given by the modes of a file; `surface_modes` reads the modes."""

    file: str
    digest: str
    """SHA-256 of the file's content."""

    normal: str
    """Direction of touches: an axis of the file, -z for one downwards, or `local z`."""

    count: int
    """Number of modes, including rigid-body modes."""

    rigid: int
    """Number of modes of the rigid body; 0 for a surface that its modes hold."""

    frequency: float
    """Natural frequency [Hz] of the highest mode."""

    modulus: float
    """Modulus of elasticity [Pa] of the homogeneous plate."""

    outline: Rings = ()
    """Edges and cut-outs as rings of points [m]; none for the whole rectangle."""

    sizes: tuple[float, ...] = ()
    """Factors on the shapes of the lowest elastic modes, if they differ from the file's."""

    notes: tuple[str, ...] = ()
    """Suspicious properties of the modes, as warnings show them."""

    def frequency_factor(self, thickness: float, modulus: float) -> float:
        """Return the factor of its natural frequencies for an equivalent plate with other
        properties.

        thickness [m], modulus [Pa]: of the equivalent homogeneous plate.
        """
        return thickness / THICKNESS * math.sqrt(modulus / self.modulus)


@dataclass(frozen=True, eq=False)
class SurfaceShapes:
    """Normal modes at n nodes, with unit modal mass, rigid-body modes first."""

    points: FloatArray
    """Nodes (n, 2) in coordinates of touches [m]."""

    frequencies: FloatArray
    """Natural frequencies (r,) [Hz], ascending, 0 of the rigid body."""

    shapes: FloatArray
    """(n, r) [1/sqrt(kg)]."""

    damping_ratios: FloatArray
    """(r,), NaN if missing in the file."""

    rigid: int
    """Number of modes of the rigid body."""

    mass: float
    """Mass that moves along the normal [kg], NaN without a rigid motion."""

    size: FloatArray
    """Sides (2,) of the rectangle around the surface [m]."""

    outline: Rings
    """Edges of its faces, none where the file has no faces."""

    motions: FloatArray
    """Rigid-body motion along the normal at the nodes (n, 3): translation and two rotations."""

    modes: "ModeShapes"
    """All modes in the order of the file."""


def digest_of_file(path: Path) -> str:
    """Return the SHA-256 of a file's content; raises InputError if it cannot be read."""
    from model.files.uff import read_measured_bytes  # only a surface needs it

    return hashlib.sha256(read_measured_bytes(path)).hexdigest()


def center_of_surface(surface: Surface) -> Point | None:
    """Return the center of mass [m] of a surface; None unless its rigid body is free to tilt."""
    moments = moments_of_surface(surface)
    if moments is None:
        return None
    x, y = moments[0, 1:].tolist()
    return x, y


def moments_of_surface(surface: Surface) -> FloatArray | None:
    """Return the mean of p p' over the mass of a surface (3, 3) with p = (1, x, y) [m].

    None unless its rigid body is free to tilt.
    """
    if surface.rigid < _TILTING:
        return None
    return _moments(surface.file, surface.digest, surface.normal)


@lru_cache(maxsize=4)
def _moments(file: str, digest: str, normal: str) -> FloatArray | None:
    """Compute the moments of a free surface, relative to its mass, from its rigid modes.

    Modes of unit modal mass are P T, where P has a row (1, x, y) for each node: then the mass and
    the first and second moments of the surface are (T T')^-1.
    """
    shapes = surface_shapes(file, digest, normal)
    motions = np.column_stack([np.ones(len(shapes.points)), shapes.points])
    factors, _, rank, _ = np.linalg.lstsq(motions, shapes.shapes[:, : shapes.rigid])
    if rank < _TILTING or np.linalg.matrix_rank(factors) < _TILTING:
        return None
    moments = np.linalg.inv(factors @ factors.T)
    return np.asarray(moments / moments[0, 0])


@lru_cache(maxsize=4)
def surface_shapes(file: str, digest: str, normal: str) -> SurfaceShapes:
    """Read modes along a normal from a file with this digest; raises InputError for a file without
    modes."""
    from model.files.modal_file import read_modes  # only a surface needs these
    from model.files.uff import read_measured_bytes

    content = read_measured_bytes(Path(file))
    if hashlib.sha256(content).hexdigest() != digest:
        raise InputError(f"{file}: modes have changed since the rig was read; start again")
    read = read_modes(Path(file), content)
    axis = "xyz".index(normal[-1])
    upwards = -1.0 if "-" in normal else 1.0
    along_axis = (read.shapes if read.shapes.ndim == 2 else upwards * read.shapes[:, :, axis]).T
    w = along_axis
    normals = upwards * np.eye(3)[[axis] * len(read.nodes)]
    if normal.startswith("local") and read.shapes.ndim == 3:
        normals = upwards * _normals(read.nodes, axis)
        w = np.einsum("rnk,nk->nr", read.shapes, normals)
    order = np.argsort(read.frequencies, kind="stable")
    frequencies = read.frequencies[order]
    w = w[:, order]
    is_rigid = frequencies < RIGID_FREQUENCY
    elastic = w[:, ~is_rigid]
    size = np.sqrt((elastic**2).mean(axis=0))
    is_seen = size > _SEEN * np.median(size) if len(size) else np.empty(0, dtype=bool)
    if is_seen.sum() < _FEWEST or len(w) < _FEWEST:
        raise InputError(
            f"{file}: modes must be {_FEWEST} elastic ones or more that move along {normal}, at "
            f"{_FEWEST} nodes or more, got {is_seen.sum()} at {len(w)}; export more, or give "
            "surface.normal"
        )
    # Combinations of rigid motions along the normal; no attachment would hold the others.
    _, sizes, combinations = np.linalg.svd(w[:, is_rigid], full_matrices=False)
    along_normal = combinations[sizes > _ALONG_NORMAL * sizes.max(initial=0.0)]
    rigid = len(along_normal)
    places = np.delete(read.nodes, axis, axis=1) if read.places is None else read.places
    points = places - places.min(axis=0)
    if not np.ptp(points, axis=0).all():
        raise InputError(
            f"{file}: nodes must extend along both axes across {normal}, got a line; set "
            "surface.normal to the axis out of the surface"
        )
    elastic_frequencies = frequencies[~is_rigid][is_seen]
    elastic_ratios = read.damping_ratios[order][~is_rigid][is_seen]
    return SurfaceShapes(
        points=points,
        frequencies=np.concatenate([np.zeros(rigid), elastic_frequencies]),
        shapes=np.hstack([w[:, is_rigid] @ along_normal.T, elastic[:, is_seen]]),
        damping_ratios=np.concatenate([np.full(rigid, math.nan), elastic_ratios]),
        rigid=rigid,
        mass=_mass(along_axis[:, order][:, is_rigid]),
        size=np.ptp(points, axis=0),
        outline=rings_of(read.faces, points),
        motions=_rigid_motions(read.nodes, normals, axis),
        modes=read,
    )


def _rigid_motions(nodes: FloatArray, normals: FloatArray, axis: int) -> FloatArray:
    """Motion along normals (n, 3) by a translation along an axis and rotations about the others."""
    arms = nodes - nodes.mean(axis=0)
    motions = [normals[:, axis]]
    for direction in np.delete(np.eye(3), axis, axis=0):
        motions.append((np.cross(direction, arms) * normals).sum(axis=1))
    return np.column_stack(motions)


def evenly_spaced(points: FloatArray, count: int) -> FloatArray:
    """Numbers of at most so many points (n, 2), evenly over the surface; equal places once."""
    _, first = np.unique(np.round(points / (1e-6 * np.ptp(points))), axis=0, return_index=True)
    size = math.sqrt(float(np.prod(np.ptp(points, axis=0))) / count)
    while len(first) > count:
        cells = np.floor(points[first] / size).astype(int)
        _, chosen = np.unique(cells, axis=0, return_index=True)
        if len(chosen) <= count:
            first = first[chosen]
        size *= 1.05
    return np.sort(first)


def _normals(nodes: FloatArray, axis: int) -> FloatArray:
    """Return unit normals (n, 3) at nodes: of the best-fit plane of each node's neighbors, along
    an axis."""
    from scipy.spatial import cKDTree  # only curved surfaces need it

    _, near = cKDTree(nodes).query(nodes, k=min(_NEIGHBORS, len(nodes)))
    neighbors = nodes[near] - nodes[near].mean(axis=1, keepdims=True)
    normals = np.linalg.svd(neighbors)[2][:, 2]
    return normals * np.where(normals[:, [axis]] < 0, -1.0, 1.0)


def _mass(rigid: FloatArray) -> float:
    """Return the mass [kg] from rigid modes (n, r) of unit modal mass, NaN if they have no uniform
    motion."""
    # Six digits of a file leave directions that are rounding, and would be light.
    shares, *_ = np.linalg.lstsq(rigid, np.ones(len(rigid)), rcond=1e-4)
    is_even = rigid.size > 0 and np.abs(rigid @ shares - 1).max() < 0.05
    return float(shares @ shares) if is_even else math.nan


def rings_of(faces: Iterable[Sequence[int]], points: FloatArray) -> Rings:
    """Edges that only one of the faces has, in rings of points [m]: outline and cut-outs."""
    count = Counter(
        frozenset(edge)
        for face in faces
        for edge in zip(face, (*face[1:], face[0]), strict=True)
        if edge[0] != edge[1]
    )
    beside = defaultdict[int, list[int]](list)
    for a, b in (sorted(edge) for edge, times in count.items() if times == 1):
        beside[a].append(b)
        beside[b].append(a)
    rings = []
    while beside:
        ring = [min(beside)]
        while nexts := beside.get(ring[-1]):
            next_node = nexts.pop()
            beside[next_node].remove(ring[-1])
            ring.append(next_node)
        for node in ring:
            if not beside.get(node, True):
                del beside[node]
        rings.append(tuple((float(x), float(y)) for x, y in points[ring[:-1]]))
    return tuple(rings)


def is_within(outline: Rings, points: FloatArray) -> NDArray[np.bool_]:
    """Whether points (p, 2) [m] are inside of rings by the even-odd rule, or on them, (p,)."""
    inside, on_edge = np.zeros((2, len(points)), dtype=bool)
    x, y = points.T
    for ring in outline:
        for (x0, y0), (x1, y1) in zip(ring, (*ring[1:], ring[0]), strict=True):
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (x1 - x0) * (y - y0) / ((y1 - y0) or 1.0))
            along = np.array([x1 - x0, y1 - y0])
            share = ((points - (x0, y0)) @ along / (along @ along or 1.0)).clip(0, 1)
            on_edge |= np.hypot(*(points - (x0, y0) - share[:, None] * along).T) < _ON_OUTLINE
    return inside | on_edge


def homogeneous(shapes: SurfaceShapes, mass: float | None) -> tuple[float, float, float]:
    """Return modulus [Pa], density [kg/m³] and loss factor of a surface's equivalent plate.

    Its modes are N(f) = 1.25 S / 2 sqrt(mu / D) f. mass [kg]: as stated, None for the mass of the
    modes; raises InputError if both contradict each other, and without either.
    """
    modal_mass = shapes.mass
    if mass is None and math.isnan(modal_mass):
        raise InputError(
            "mass must be stated for modes without an even rigid motion, got none; add the mass "
            "that moves along the normal"
        )
    if mass is not None and abs(modal_mass / mass - 1) > _SAME_MASS:
        raise InputError(
            f"mass must match the modes, {modal_mass:.4g} kg, got {mass:.4g} kg; check the units "
            "of the file and its modal masses, or leave it out"
        )
    elastic, area = shapes.frequencies[shapes.rigid :], float(np.prod(shapes.size))
    mu = (modal_mass if mass is None else mass) / area
    rigidity = mu / (2 * len(elastic) / (EDGES * elastic[-1] * area)) ** 2
    ratios = shapes.damping_ratios[np.isfinite(shapes.damping_ratios)]
    return (
        float(12 * rigidity * (1 - NU**2) / THICKNESS**3),
        float(mu / THICKNESS),
        float(2 * np.median(ratios)) if len(ratios) else 0.01,
    )


def deviating_losses(shapes: SurfaceShapes, loss_factor: float) -> tuple[tuple[float, float], ...]:
    """Return damping differences of the lowest elastic modes from a plate's (`mode_deviations`)."""
    ratios = shapes.damping_ratios[shapes.rigid :][:MAX_DEVIATING]
    factors = np.where(ratios > 0, 2 * ratios, loss_factor) / max(loss_factor, 1e-12)
    if np.abs(factors - 1).max() < _SAME_LOSS:
        return ()
    return tuple((0.0, float(factor)) for factor in np.log(factors))
