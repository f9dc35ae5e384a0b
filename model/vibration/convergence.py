"""Discretisation error of natural frequencies and response, against a finer mesh.

Without a converged response the error is estimated: of polynomials over the plate it is the sum of
two changes of the response: by two further degrees, and where the compliance under forces that
polynomials do not resolve is higher by 20 % and, under points, by a decade of the logarithm
(`model.spectral.local_compliance`). Of finite elements it is the change to polynomials over the
plate, which are solved in a tenth of the time of elements as accurate or less (`reference_mesh`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import ComplexArray, FloatArray, lattice
from model.errors import InputError
from model.fem.mesh import Mesh
from model.progress import Progress, unseen
from model.reduction.free_modes import SpectralModes
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.meshes import mesh_of
from model.rig.rig import Rig
from model.spectral.mesh import PlateMesh, SpectralMesh
from model.structure.actuators import Actuator
from model.structure.attachments import PointLoad
from model.structure.plate import Plate
from model.vibration.natural_modes import natural_modes

MAP_FREQUENCIES = (110.0, 250.0)
"""Where the founding paper shows maps [Hz]."""

MODE_COUNT = 12

MOVED = 0.1e-3
"""How far an ERA may be from where it should be [m]; few are mounted better."""

FOOT = 5e-3
"""Radius of a foot [m] that a point stands for."""

# The coarsest MITC4 mesh of a study; on the paper's plate up to 500 Hz it is the paper's 12x9. Each
# next one has twice as many elements along both sides.
_COARSEST_PER_WAVELENGTH = 6.5
_DOUBLINGS = 3

# Relative to the plate's lowest bending frequency, below which a natural frequency is rounding of
# free tilting on one or two ERAs.
_MIN_FREQUENCY_RATIO = 1e-3

# Raster for comparing responses, finer than half a wavelength.
_RASTER = (49, 37)


@dataclass(frozen=True)
class MeshError:
    """Discretisation error of a mesh, relative to the reference.

    frequency: of the natural frequencies that are compared, signed, (n,); response: of the
    acceleration field at each frequency, relative L2 over the plate, the worst driven ERA, (f,);
    estimate: of that error, without the reference, of polynomials only.
    """

    mesh: PlateMesh
    frequency: FloatArray
    response: FloatArray
    estimate: FloatArray | None


@dataclass(frozen=True)
class Convergence:
    """Errors of several meshes against a reference mesh, response at f frequencies.

    natural_frequencies: the lowest on the ERAs [Hz] without unsupported motion, (n,). For
    comparison, by how much the response changes, as `MeshError.response`, where every ERA stands
    MOVED nearer to the middle, and where it stands on a disc FOOT wider in radius.
    """

    reference: PlateMesh
    natural_frequencies: FloatArray
    errors: tuple[MeshError, ...]
    by_place: FloatArray
    by_foot: FloatArray


def meshes_to_compare(rig: Rig) -> tuple[PlateMesh, ...]:
    """List four MITC4 meshes, `mesh: auto`, one of Q5 with strips, and the rig's own.

    For a plate of layers or with air behind it, which are solved in polynomials only, three degrees
    in place of meshes of elements.
    """
    plate, high = rig.plate, rig.limits.frequency_max
    stiffness = rig.largest_stiffness
    foot = min(era.foot for era in rig.eras)
    automatic = mesh_of("auto", plate, frequency_max=high, stiffness=stiffness, foot=foot)
    if plate.is_layered and isinstance(automatic, SpectralMesh):
        lowest = automatic.resolving(plate, high)
        return tuple(dict.fromkeys([lowest, automatic, automatic.finer(), rig.mesh]))
    size = plate.bending_wavelength(high) / _COARSEST_PER_WAVELENGTH
    nx, ny = (max(1, math.ceil(side / size)) for side in (plate.length, plate.width))
    plain = [Mesh(nx << n, ny << n, plate.length, plate.width) for n in range(_DOUBLINGS + 1)]
    chosen = [*plain, automatic, Mesh.accurate(plate, frequency_max=high), rig.mesh]
    return tuple(dict.fromkeys(chosen))


def default_frequencies(rig: Rig) -> FloatArray:
    """Those of the paper's maps [Hz] as far as they are within the rig's limit, else the limit."""
    high = rig.limits.frequency_max
    within = [frequency for frequency in MAP_FREQUENCIES if frequency <= high]
    return np.array(within or [high])


def study_convergence(
    rig: Rig,
    meshes: Sequence[PlateMesh],
    *,
    frequencies: Sequence[float] | FloatArray,
    progress: Progress = unseen,
) -> Convergence:
    """Solve a rig on each mesh and on the reference.

    frequencies (f,) [Hz] up to the rig's limit. Raises InputError for those that a mesh cannot
    resolve. progress is called with the number of solved meshes, the reference first, and of all.
    """
    high = rig.limits.frequency_max
    checked, sides = np.asarray(frequencies, dtype=float), (rig.plate.length, rig.plate.width)
    points = lattice(*(np.linspace(0, side, n) for side, n in zip(sides, _RASTER, strict=True)))
    if (checked > high).any():
        raise InputError(
            f"frequencies must be at most the rig's limits.frequency of {high:g} Hz, got "
            f"{checked.max():g} Hz; take lower frequencies or raise the limit"
        )

    def response(of: FreePlate, eras: Sequence[Actuator]) -> ComplexArray:
        return of.acceleration(eras, checked, points, loads=rig.masses)

    reference = _solved(rig, _reference(rig))
    exact, exact_response = _natural_frequencies(rig, reference), response(reference, rig.eras)
    supported = exact > _MIN_FREQUENCY_RATIO * rig.plate.lowest_bending_frequency
    errors = []
    for done, mesh in enumerate(meshes, start=1):
        progress(done, 1 + len(meshes))
        free, estimate = _solved(rig, mesh), None
        if isinstance(mesh, SpectralMesh):
            estimate = estimate_error(
                free, mesh.finer(), rig.eras, checked, points, loads=rig.masses
            ).max(axis=1)
        found = _relative_error(response(free, rig.eras), exact_response).max(axis=1)
        of_frequencies = _natural_frequencies(rig, free)[supported] / exact[supported] - 1
        errors.append(MeshError(mesh, of_frequencies, found, estimate))
    progress(1 + len(meshes), 1 + len(meshes))
    accurate = rig.mesh if rig.plate.is_layered else Mesh.accurate(rig.plate, frequency_max=high)
    plain = _solved(rig, accurate)
    before = response(plain, rig.eras)
    by_place, by_foot = (
        _relative_error(response(plain, eras), before).max(axis=1)
        for eras in (
            [_nearer_the_middle(era, rig.plate) for era in rig.eras],
            [replace(era, foot=era.foot + FOOT) for era in rig.eras],
        )
    )
    return Convergence(
        reference.mesh,
        exact[supported],
        tuple(errors),
        by_place=by_place,
        by_foot=by_foot,
    )


def _relative_error(found: ComplexArray, exact: ComplexArray) -> FloatArray:
    """Of fields over points (f, eras, points), relative L2, (f, eras)."""
    size = np.linalg.norm(exact, axis=2)
    return np.asarray(np.linalg.norm(found - exact, axis=2) / size)


def _nearer_the_middle(era: Actuator, plate: Plate) -> Actuator:
    """An ERA moved by MOVED along both sides."""
    x, y = (
        at + MOVED * np.sign(side / 2 - at)
        for at, side in ((era.x, plate.length), (era.y, plate.width))
    )
    return replace(era, x=float(x), y=float(y))


def _reference(rig: Rig) -> PlateMesh:
    """The mesh that others are compared with: of elements, or of polynomials for layers."""
    high = rig.limits.frequency_max
    if not rig.plate.is_layered:
        return reference_mesh(rig.plate, frequency_max=high)
    automatic = mesh_of("auto", rig.plate, frequency_max=high)
    return replace(automatic, nx=2 * automatic.nx, ny=2 * automatic.ny)


def _natural_frequencies(rig: Rig, free: FreePlate) -> FloatArray:
    solved = natural_modes(rig, MODE_COUNT, support="eras", mesh=free.mesh, free=free)
    return solved.frequencies


def _solved(rig: Rig, mesh: PlateMesh) -> FreePlate:
    return solve_free_plate(rig.plate, mesh, frequency_max=rig.limits.frequency_max)


_MAX_FIELDS = 1_000_000  # values at once, of 16 bytes each
_ACCURACY = 0.005  # of polynomials before their two further degrees


def reference_mesh(plate: Plate, *, frequency_max: float) -> Mesh:
    """Half as many elements again along both sides as an accurate mesh, in strips half as wide."""
    accurate = Mesh.accurate(plate, frequency_max=frequency_max)
    nx, ny = (math.ceil(1.5 * count) for count in (accurate.nx, accurate.ny))
    return replace(accurate, nx=nx, ny=ny, strip=accurate.strip / 2)


def finer_mesh(
    plate: Plate, mesh: PlateMesh, *, frequency_max: float, stiffness: float = 0.0
) -> PlateMesh:
    """The mesh whose response a mesh is compared with, accurate up to a frequency [Hz].

    Two further degrees of polynomials; for elements those of polynomials, or elements where there
    would be too many. stiffness [N/m]: of the stiffest ERA.
    """
    if isinstance(mesh, SpectralMesh):
        return mesh.finer()
    polynomials = SpectralMesh.accurate(
        plate, frequency_max=frequency_max, accuracy=_ACCURACY, stiffness=stiffness
    )
    if polynomials is None:
        return reference_mesh(plate, frequency_max=frequency_max)
    return polynomials.finer()


def estimate_error(
    free: FreePlate,
    finer: PlateMesh,
    eras: Sequence[Actuator],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[PointLoad] = (),
) -> FloatArray:
    """Estimated error of the acceleration over points (p, 2) [m], relative L2, (f, eras).

    finer: of `finer_mesh`; frequencies (f,) [Hz]. Each ERA is driven alone.
    """

    plates = [solve_free_plate(free.plate, finer, frequency_max=free.frequency_max), free]
    if isinstance(free.modes, SpectralModes):
        plates.append(replace(free, modes=free.modes.softer()))
    squares = np.zeros((len(plates), len(frequencies), len(eras)))
    # A few points at a time: whole fields of sixteen ERAs take a gigabyte.
    parts = math.ceil(len(frequencies) * len(eras) * len(points) / _MAX_FIELDS)
    for few in np.array_split(points, parts):
        exact, own, *others = (
            of.acceleration(eras, frequencies, few, loads=loads) for of in plates
        )
        differences = [own - each for each in (exact, *others)]
        for square, field in zip(squares, (exact, *differences), strict=True):
            square += np.linalg.norm(field, axis=2) ** 2
    size, *errors = np.sqrt(squares)
    return np.asarray(sum(errors) / size)
