"""Steady vibration of a rig's plate: excitations, maps, natural modes and discretization errors.

An excitation is a tone for each active ERA. ERAs at the same frequency add as complex numbers;
at different frequencies magnitudes add (paper Eq. 28). Adding magnitudes at a single frequency
would remove the nodal lines.

Discretization errors are the changes on a finer mesh (`study_convergence`), or estimates
(`estimate_error`). For polynomials over the plate, the estimate is the sum of two changes of the
response: the change with two additional degrees, and the change if the compliance under forces that
polynomials do not resolve is higher by 20 % (under points, by a decade of the logarithm;
`model.spectral.modes`). For finite elements, the estimate is the difference to polynomials, which
take at most a tenth of the time of equally accurate elements (`reference_mesh`).
"""

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, TypeAlias

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray, lattice
from model.errors import InputError
from model.fem import RIGID_BODY_MODES, Mesh, assemble, simply_supported_modes
from model.files.csv_file import as_frame
from model.processes import Progress, unseen
from model.quantities import counted
from model.reduction.element_modes import FiniteElementModes
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.reduction.supported_plate import SupportedModes, on_springs, supported_modes
from model.rig.rig import Rig
from model.rig.rig_mesh import mesh_of
from model.spectral.plate_mesh import PlateMesh, SpectralMesh
from model.structure.attachments import PointLoad, footprints_of
from model.structure.exciter import Actuator
from model.structure.modal_elasticity import check_is_plate
from model.structure.plate import Plate
from model.structure.sources import Source


@dataclass(frozen=True)
class Tone:
    """One frequency [Hz], base amplitude a [m] and phase [rad]: y(t) = a sin(2 pi f t + phase)."""

    frequency: float
    amplitude: float
    phase: float = 0.0

    @classmethod
    def from_phasor(cls, frequency: float, phasor: complex) -> Self:
        """Make the tone of a phasor [m] at a frequency [Hz]."""
        return cls(frequency, abs(phasor), cmath.phase(phasor))

    @property
    def phasor(self) -> complex:
        """Complex amplitude a exp(i phase) [m]: y(t) = Im[phasor exp(2 pi i f t)]."""
        return cmath.rect(self.amplitude, self.phase)


Excitation: TypeAlias = Mapping[str, Tone]
"""A tone for each active ERA, by name; the base of any other ERA is at rest."""

G = 9.8
"""Standard gravity as the paper rounds it [m/s²]; used only where accelerations are shown in g."""

NULL_SHARE = 0.1
"""Share of a map's maximum below which a local minimum is a null."""


def base_amplitudes(
    excitation: Excitation, eras: Sequence[Source], *others: Excitation
) -> tuple[FloatArray, ComplexArray]:
    """Return distinct frequencies (f,) [Hz] and the phasor of each ERA's base there, (f, eras) [m].

    others: excitations that play at the same time. Raises InputError if no ERA is driven, or an
    unknown one.
    """
    tones = [each for one in (excitation, *others) for each in one.items()]
    if not tones:
        raise InputError("excitation: must drive at least one ERA")
    names = [era.name for era in eras]
    frequencies = sorted({tone.frequency for _, tone in tones})
    amplitudes = np.zeros((len(frequencies), len(eras)), dtype=complex)
    for name, tone in tones:
        if name not in names:
            raise InputError(f"the rig has no ERA {name!r}; it has {', '.join(names)}")
        phasor = cmath.rect(tone.amplitude, tone.phase)  # faster than the property
        amplitudes[frequencies.index(tone.frequency), names.index(name)] += phasor
    return np.array(frequencies), amplitudes


def tone_fields(
    excitation: Excitation,
    eras: Sequence[Source],
    response: Callable[[FloatArray], ComplexArray],
    *others: Excitation,
) -> tuple[FloatArray, ComplexArray]:
    """Return distinct frequencies (f,) [Hz] and the complex acceleration at each, (f, p) [m/s²].

    response: takes frequencies (f,), returns the acceleration (f, eras, p) by each ERA at full
    stroke; others: excitations that play at the same time.
    """
    frequencies, amplitudes = base_amplitudes(excitation, eras, *others)
    weights = amplitudes / np.array([era.full_level for era in eras])
    return frequencies, np.einsum("fe,fep->fp", weights, response(frequencies))


def peak_acceleration(amplitudes: FloatArray) -> FloatArray:
    """Return the peak acceleration over time (p,), the sum of amplitudes per frequency (f, p)."""
    return np.asarray(amplitudes.sum(axis=0))


def find_nulls(x: FloatArray, y: FloatArray, peak: FloatArray) -> FloatArray:
    """Return the positions (n, 2) [m] of nulls in a map (len(y), len(x)): low local minima.

    A curve of nulls shows as the lowest points along it.
    """
    from scipy.ndimage import minimum_filter  # only maps need it, and it takes long to load

    low = peak <= NULL_SHARE * peak.max()
    rows, columns = np.nonzero(low & (peak == minimum_filter(peak, size=3, mode="nearest")))
    return np.column_stack([x[columns], y[rows]])


_MAX_POINTS = 1_000_000
"""Maximum number of points of a map; each takes some hundred bytes."""

_BATCH = 10_000  # points that are solved together, at some kilobytes each


@dataclass(frozen=True)
class PlateMap:
    """Acceleration on a regular raster over the plate."""

    x: FloatArray
    """Raster (nx,) along the length [m]."""
    y: FloatArray
    """Raster (ny,) along the width [m]."""
    peak: FloatArray
    """Peak acceleration (ny, nx) [m/s²], the sum of magnitudes of `field`."""
    nulls: FloatArray
    """Positions (n, 2) of nulls [m]."""
    frequencies: FloatArray
    """Frequencies (f,) [Hz]."""
    field: ComplexArray
    """Complex acceleration (f, ny, nx) at each frequency [m/s²], for exp(+i omega t)."""

    def to_frame(self) -> Any:
        """Return points and peak acceleration as a pandas DataFrame, a row per point."""
        x, y = np.meshgrid(self.x, self.y)
        return as_frame({"x_m": x.ravel(), "y_m": y.ravel(), "peak_m_s2": self.peak.ravel()})

    def __repr__(self) -> str:
        return (
            f"<PlateMap of {len(self.x)} x {len(self.y)} points, "
            f"at most {self.peak.max():.3g} m/s², {counted(len(self.nulls), 'null')}>"
        )


@dataclass(frozen=True, eq=False)
class FrequencySweep:
    """Acceleration at points over frequency."""

    frequencies: FloatArray
    """Frequencies (f,) [Hz]."""
    points: FloatArray
    """Points (p, 2) [m]."""
    acceleration: ComplexArray
    """Complex peak acceleration (f, p) [m/s²]: a(t) = Im[acceleration exp(i omega t)]."""

    def to_frame(self) -> Any:
        """Return frequency, point, peak and phase as a pandas DataFrame, a row for each pair."""
        count = len(self.points)
        x, y = np.tile(self.points, (len(self.frequencies), 1)).T
        acceleration = self.acceleration.ravel()
        return as_frame(
            {
                "frequency_hz": np.repeat(self.frequencies, count),
                "x_m": x,
                "y_m": y,
                "peak_m_s2": np.abs(acceleration),
                "phase_deg": np.degrees(np.angle(acceleration)),
            }
        )


def plate_map(
    rig: Rig,
    *excitations: Excitation,
    raster: tuple[int, int] | None = None,
    free: FreePlate | None = None,
) -> PlateMap:
    """Solve the rig's plate for excitations that play together, on the mesh's raster by default.

    free: the same plate, if it has been solved before. Raises InputError for a raster below 2x2 or
    of millions of points, and for a frequency that the mesh cannot resolve.
    """
    mesh = rig.mesh
    columns, rows = raster or mesh.raster
    if columns < 2 or rows < 2:
        raise InputError(f"map: points must be 2x2 or more, got {columns}x{rows}")
    if columns * rows > _MAX_POINTS:
        raise InputError(
            f"map: points must be at most {_MAX_POINTS}, got {columns}x{rows}; take a coarser one"
        )
    x = np.linspace(0, rig.plate.length, columns)
    y = np.linspace(0, rig.plate.width, rows)
    points = lattice(x, y)

    def respond(driven: FloatArray) -> ComplexArray:
        highest = max(rig.limits.frequency_max, float(driven.max()))
        solved = free or solve_free_plate(rig.plate, mesh, frequency_max=highest)
        parts = np.array_split(points, 1 + len(points) // _BATCH)
        found = [solved.acceleration(rig.eras, driven, part, loads=rig.masses) for part in parts]
        return np.concatenate(found, axis=2)

    frequencies, field = tone_fields(excitations[0], rig.eras, respond, *excitations[1:])
    peak = peak_acceleration(np.abs(field)).reshape(rows, columns)
    nulls = find_nulls(x, y, peak)
    return PlateMap(x, y, peak, nulls, frequencies, field.reshape(-1, rows, columns))


def damped_modes(rig: Rig) -> SupportedModes:
    """Solve for all modes of a rig's plate on its ERAs, with damping ratios.

    The modes extend to the highest frequency of the rig's limits. Raises InputError for a plate
    without supports.
    """
    highest = rig.limits.frequency_max
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=highest)
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses))
    return supported_modes(reduced, rig.eras, loads=rig.masses, frequency_max=highest)


@dataclass(frozen=True, eq=False)
class NaturalModes:
    """Undamped natural modes of a plate."""

    frequencies: FloatArray
    """Natural frequencies (n,) [Hz], ascending."""
    basis: Callable[[FloatArray], Any]
    """Returns m functions at points (p, m)."""
    coordinates: FloatArray
    """Each mode's coordinates (m, n) in these functions."""
    mesh: PlateMesh

    def at(self, points: FloatArray) -> FloatArray:
        """Return the mode shapes (p, n) [1/sqrt(kg)] at points (p, 2) [m]."""
        return np.asarray(self.basis(points) @ self.coordinates)


_BEYOND = 4.0  # factor on a mesh's resolution, since coarse meshes are compared with others


def natural_modes(
    rig: Rig,
    count: int,
    *,
    support: str,
    mesh: PlateMesh | None = None,
    free: FreePlate | None = None,
) -> NaturalModes:
    """Solve for the lowest modes of a rig on a mesh, by default its own.

    support: free (elastic modes only), eras, or simply-supported, which is solved by finite
    elements; free: the rig's plate, if it has been solved on the mesh. Raises InputError for a
    count below 1 or above the mesh's number of modes, and for a simply supported plate of layers.
    """
    if count < 1:
        raise InputError(f"modes must be 1 or more, got {count}")
    chosen = mesh or rig.mesh
    if support == "simply-supported":
        return _simply_supported(rig, count, chosen)
    attached: list[Source | PointLoad] = [*rig.masses]
    if support == "eras":
        attached += rig.eras
    gap = rig.plate.air_gap
    # Air that is sealed in resists motion up and down; under tilts it only flows to and fro.
    rigid = RIGID_BODY_MODES - (gap is not None and gap.closed) if support == "free" else 0
    if rig.plate.surface is not None and support == "free":
        rigid = rig.plate.surface.rigid
    highest = rig.limits.frequency_max
    while True:
        solved = free or solve_free_plate(rig.plate, chosen, frequency_max=highest)
        modes = _modes_with(solved, attached)
        found = int((modes.frequencies <= highest).sum()) - rigid
        if found >= count:
            break
        if highest > _BEYOND * chosen.highest_frequency(rig.plate):
            raise InputError(
                f"modes must be at most {found} with mesh {chosen}, got {count}; take fewer modes "
                "or a finer mesh"
            )
        highest, free = 1.5 * highest, None
    chosen_modes = slice(rigid, rigid + count)
    return replace(
        modes,
        frequencies=modes.frequencies[chosen_modes],
        coordinates=modes.coordinates[:, chosen_modes],
    )


def _modes_with(free: FreePlate, attached: list[Source | PointLoad]) -> NaturalModes:
    """Solve all modes of the undamped plate with attachments; the highest ones are mixtures."""
    places = footprints_of(attached)
    reduced = reduce_free_plate(free, places)
    M, _, K = on_springs(reduced, [each.in_time for each in attached], reduced.at(places))
    squares, coordinates = linalg.eigh(K, M)
    frequencies = np.sqrt(np.maximum(squares, 0)) / (2 * np.pi)
    return NaturalModes(frequencies, reduced.at, coordinates[: len(reduced.omega)], free.mesh)


def _simply_supported(rig: Rig, count: int, mesh: PlateMesh) -> NaturalModes:
    """Solve the modes with finite elements; their shapes are known at the nodes."""
    check_is_plate(rig.plate, "simply-supported modes")
    if rig.plate.needs_polynomials:
        raise InputError(
            "support must be free or eras for a plate of layers or with air, got "
            "simply-supported, which only finite elements solve"
        )
    if not isinstance(mesh, Mesh):
        mesh = Mesh.accurate(rig.plate, frequency_max=rig.limits.frequency_max)
    matrices = assemble(rig.plate, mesh)
    frequencies, unknowns = simply_supported_modes(matrices, count, rig.masses)
    return NaturalModes(frequencies, matrices.deflection_at, unknowns, mesh)


MAP_FREQUENCIES = (110.0, 250.0)
"""Frequencies of the founding paper's maps [Hz]."""

MODE_COUNT = 12
"""Number of modes that are compared."""

MOVED = 0.1e-3
"""Typical error of an ERA's position [m]."""

FOOT = 5e-3
"""Radius of a foot [m] represented by a point."""

# The coarsest MITC4 mesh of a study; on the paper's plate up to 500 Hz it is the paper's 12x9. Each
# next one has twice as many elements along both sides.
_COARSEST_PER_WAVELENGTH = 6.5
MESH_DOUBLINGS = 3

# Relative to the plate's lowest bending frequency, below which a natural frequency is rounding of
# free tilting on one or two ERAs.
_MIN_FREQUENCY_RATIO = 1e-3

# Raster for comparing responses, finer than half a wavelength.
_RASTER = (49, 37)


@dataclass(frozen=True)
class MeshError:
    """Discretization error of a mesh, relative to the reference."""

    mesh: PlateMesh
    frequency: FloatArray
    """Signed error of the natural frequencies that are compared (n,)."""
    response: FloatArray
    """Error of the acceleration field at each frequency (f,): relative L2, worst driven ERA."""
    estimate: FloatArray | None
    """Estimate of that error without the reference, for polynomials only."""


@dataclass(frozen=True)
class Convergence:
    """Errors of several meshes against a reference mesh, response at f frequencies."""

    reference: PlateMesh
    natural_frequencies: FloatArray
    """The lowest natural frequencies (n,) on the ERAs [Hz], without unsupported motion."""
    errors: tuple[MeshError, ...]
    by_place: FloatArray
    """For comparison, change of the response (f,) if every ERA is MOVED nearer to the middle."""
    by_foot: FloatArray
    """For comparison, change of the response (f,) if every ERA's foot is wider by FOOT."""


def meshes_to_compare(rig: Rig) -> tuple[PlateMesh, ...]:
    """List four MITC4 meshes, `mesh: auto`, one of Q5 with strips, and the rig's own.

    A plate with layers or air is solved with polynomials only; then there are three degrees
    in place of meshes of elements.
    """
    plate, high = rig.plate, rig.limits.frequency_max
    check_is_plate(plate, "a study of meshes")
    stiffness = rig.largest_stiffness
    foot = min(era.foot for era in rig.eras)
    automatic = mesh_of("auto", plate, frequency_max=high, stiffness=stiffness, foot=foot)
    if plate.needs_polynomials and isinstance(automatic, SpectralMesh):
        lowest = automatic.resolving(plate, high)
        return tuple(dict.fromkeys([lowest, automatic, automatic.finer(), rig.mesh]))
    size = plate.bending_wavelength(high) / _COARSEST_PER_WAVELENGTH
    nx, ny = (max(1, math.ceil(side / size)) for side in (plate.length, plate.width))
    plain = [Mesh(nx << n, ny << n, plate.length, plate.width) for n in range(MESH_DOUBLINGS + 1)]
    chosen = [*plain, automatic, Mesh.accurate(plate, frequency_max=high), rig.mesh]
    return tuple(dict.fromkeys(chosen))


def default_frequencies(rig: Rig) -> FloatArray:
    """Return the frequencies of the paper's maps [Hz] within the rig's limit, else the limit."""
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
    """Solve a rig on several meshes and compare them with a reference.

    frequencies (f,) [Hz] up to the rig's limit; progress: called with the number of solved meshes,
    the reference first, and their total. Raises InputError for frequencies that a mesh cannot
    resolve.
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
    accurate = (
        rig.mesh if rig.plate.needs_polynomials else Mesh.accurate(rig.plate, frequency_max=high)
    )
    plain = _solved(rig, accurate)
    before = response(plain, rig.eras)
    length, width = sides
    nearer = [
        replace(
            era,
            x=era.x + MOVED * float(np.sign(length / 2 - era.x)),
            y=era.y + MOVED * float(np.sign(width / 2 - era.y)),
        )
        for era in rig.eras
    ]
    wider = [replace(era, foot=era.foot + FOOT) for era in rig.eras]
    by_place, by_foot = (
        _relative_error(response(plain, eras), before).max(axis=1) for eras in (nearer, wider)
    )
    return Convergence(
        reference.mesh,
        exact[supported],
        tuple(errors),
        by_place=by_place,
        by_foot=by_foot,
    )


def _relative_error(found: ComplexArray, exact: ComplexArray) -> FloatArray:
    """Return the relative L2 error (f, eras) of fields (f, eras, points)."""
    size = np.linalg.norm(exact, axis=2)
    return np.asarray(np.linalg.norm(found - exact, axis=2) / size)


def _reference(rig: Rig) -> PlateMesh:
    """Return the reference mesh: elements, or polynomials for a plate with layers."""
    high = rig.limits.frequency_max
    if not rig.plate.needs_polynomials:
        return reference_mesh(rig.plate, frequency_max=high)
    automatic = mesh_of("auto", rig.plate, frequency_max=high)
    return replace(automatic, nx=2 * automatic.nx, ny=2 * automatic.ny)


def _natural_frequencies(rig: Rig, free: FreePlate) -> FloatArray:
    solved = natural_modes(rig, MODE_COUNT, support="eras", mesh=free.mesh, free=free)
    return solved.frequencies


def _solved(rig: Rig, mesh: PlateMesh) -> FreePlate:
    return solve_free_plate(rig.plate, mesh, frequency_max=rig.limits.frequency_max)


_MAX_VALUES = 1_000_000  # of fields per batch, 16 bytes each
_ACCURACY = 0.005  # of polynomials before their two further degrees


def reference_mesh(plate: Plate, *, frequency_max: float) -> Mesh:
    """Return an accurate mesh with 1.5 times as many elements per side, strips half as wide."""
    accurate = Mesh.accurate(plate, frequency_max=frequency_max)
    nx, ny = (math.ceil(1.5 * count) for count in (accurate.nx, accurate.ny))
    return replace(accurate, nx=nx, ny=ny, strip=accurate.strip / 2)


def finer_mesh(
    plate: Plate, mesh: PlateMesh, *, frequency_max: float, stiffness: float = 0.0
) -> PlateMesh:
    """Return the mesh for the comparison of a mesh's response, accurate up to a frequency [Hz].

    For polynomials, the mesh has two additional degrees. For elements, it consists of polynomials,
    or of elements if too many polynomials were needed. stiffness [N/m]: of the stiffest ERA.
    """
    if not isinstance(mesh, Mesh):
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
    """Estimate the error of the acceleration over points (p, 2) [m], relative L2, (f, eras).

    finer: of `finer_mesh`; frequencies (f,) [Hz]. Each ERA is driven alone.
    """
    exactly = (
        free
        if finer == free.mesh
        else solve_free_plate(free.plate, finer, frequency_max=free.frequency_max)
    )
    others = (
        []
        if isinstance(free.modes, FiniteElementModes)
        else [replace(free, modes=each) for each in free.modes.alternatives()]
    )
    # Squares of the field, of its error from the mesh, and of its uncertainty from the modes.
    squares = np.zeros((3, len(frequencies), len(eras)))
    # A few points at a time: whole fields of sixteen ERAs take a gigabyte.
    parts = math.ceil(len(frequencies) * len(eras) * len(points) / _MAX_VALUES)
    for few in np.array_split(points, parts):
        own, exact, *possible = (
            of.acceleration(eras, frequencies, few, loads=loads) for of in (free, exactly, *others)
        )
        squares[0] += np.linalg.norm(exact, axis=2) ** 2
        squares[1] += np.linalg.norm(own - exact, axis=2) ** 2
        for each in possible:
            squares[2] += np.linalg.norm(own - each, axis=2) ** 2 / len(possible)
    size, by_mesh, by_modes = np.sqrt(squares)
    return np.asarray((by_mesh + by_modes) / size)
