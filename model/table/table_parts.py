"""The parts of a table: what can be solved apart from the rest, and how."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import FloatArray
from model.drive_modes.sources import magnitudes_of_sources
from model.errors import InputError
from model.fem.assembly import era_positions
from model.fem.mesh import Mesh
from model.files.array_file import Arrays
from model.finger.grid import CELL_SAMPLES, Grid
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig, canonical_json
from model.structure.point_load import load_positions
from model.structure.support import check_supported
from model.table.file import FORMAT_VERSION, MAX_BYTES
from model.table.raster import Raster
from model.version import NUMERICS_VERSION
from model.vibration.convergence import reference_mesh

# Some ten milliseconds of work on the paper's plate, and some megabytes.
FREQUENCIES_AT_ONCE = 16
CELLS_AT_ONCE = 36


@dataclass(frozen=True)
class Part:
    """A part of a table; what: a name in PARTS; start, stop: of its frequencies or cells."""

    what: str
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class TableProblem:
    """All that the numbers of a table depend on; the drive mode is not among it.

    frequencies (f,) [Hz], ascending, within the rig's limits. Raises InputError for others, and
    for a rig whose ERAs do not support its plate.
    """

    rig: Rig
    frequencies: FloatArray
    grid: Grid

    def __post_init__(self) -> None:
        """Refuse frequencies that make no table, and a table that would be too large to be read."""
        _check_frequencies(self.frequencies, self.rig)
        check_supported(self.rig.plate, self.rig.eras, loads=self.rig.loads)
        eras, f = len(self.rig.eras), len(self.frequencies)
        sources = eras * (eras + 1) // 2 * f + 1
        size = 8 * self.raster.point_count * eras * f + 4 * sources * self.grid.cell_count
        if size > MAX_BYTES:
            raise InputError(
                f"this table would have {size / 1e9:.1f} GB, more than the {MAX_BYTES / 1e9:.1f} "
                "GB that are read; take fewer frequencies or a coarser grid"
            )

    @cached_property
    def raster(self) -> Raster:
        """Where the fields are held."""
        return Raster.for_plate(self.rig.plate, frequency_max=float(self.frequencies[-1]))

    @cached_property
    def free_plate(self) -> FreePlate:
        """The rig's plate, solved up to the highest frequency."""
        highest = float(self.frequencies[-1])
        return solve_free_plate(self.rig.plate, self.rig.mesh, frequency_max=highest)

    @property
    def reference_mesh(self) -> Mesh:
        """The finer mesh that the rig's is compared with."""
        limit = self.rig.limits.frequency_max
        return reference_mesh(self.rig.plate, frequency_max=limit)

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all that decides the numbers of the table, and over their format."""
        decisive = {
            "format": FORMAT_VERSION,
            "numerics": NUMERICS_VERSION,
            "plate": self.rig.fingerprint,
            "mesh": self.rig.mesh.to_dict(),
            "reference_mesh": self.reference_mesh.to_dict(),  # follows from the rig's limits
            "grid": [self.grid.nx, self.grid.ny],
            "frequencies": self.frequencies.tolist(),
        }
        return hashlib.sha256(canonical_json(decisive).encode()).hexdigest()

    def parts(self) -> tuple[Part, ...]:
        """What there is to solve; the longest first."""
        f, cells = len(self.frequencies), self.grid.cell_count
        return (
            Part("discretisation", 0, f),
            Part("modes", 0, f),
            *_shares("fields", f, FREQUENCIES_AT_ONCE),
            *_shares("cells", cells, CELLS_AT_ONCE),
        )


def solve_part(problem: TableProblem, part: Part) -> Arrays:
    """The arrays of one part."""
    return PARTS[part.what](problem, part)


def _fields(problem: TableProblem, part: Part) -> Arrays:
    """Fields on the raster at some of the frequencies."""
    frequencies = problem.frequencies[part.start : part.stop]
    rig = problem.rig
    fields = problem.free_plate.acceleration(
        rig.eras, frequencies, problem.raster.points, loads=rig.loads
    )
    turned = np.ascontiguousarray(fields.transpose(2, 0, 1), dtype=np.complex64)
    return {"acceleration": turned}


def _cells(problem: TableProblem, part: Part) -> Arrays:
    """What patterns are made of, mean over some of the cells."""
    rig = problem.rig
    each = CELL_SAMPLES**2
    points = problem.grid.samples(rig.plate)[each * part.start : each * part.stop]
    fields = problem.free_plate.acceleration(rig.eras, problem.frequencies, points, loads=rig.loads)
    sources = magnitudes_of_sources(fields.astype(np.complex64))
    return {"cell_sources": sources.reshape(len(sources), -1, each).mean(axis=-1)}


def _modes(problem: TableProblem, part: Part) -> Arrays:
    """The reduced plate, at what holds it and on the raster."""
    rig, highest = problem.rig, float(problem.frequencies[-1])
    attached = np.vstack([era_positions(rig.eras), load_positions(rig.loads)])
    reduced = reduce_plate(rig.plate, rig.mesh, attached, frequency_max=highest)
    return {
        "omega": reduced.omega,
        "held": reduced.at(attached),
        "shapes": reduced.at(problem.raster.points).astype(np.float32),
    }


def _discretisation(problem: TableProblem, part: Part) -> Arrays:
    """How far the rig's mesh is from a finer one, at every frequency; of all ERAs the worst."""
    rig, highest = problem.rig, float(problem.frequencies[-1])
    finer = solve_free_plate(rig.plate, problem.reference_mesh, frequency_max=highest)
    own, exact = (
        plate.acceleration(rig.eras, problem.frequencies, problem.raster.points, loads=rig.loads)
        for plate in (problem.free_plate, finer)
    )
    error = np.linalg.norm(own - exact, axis=2) / np.linalg.norm(exact, axis=2)
    return {"discretisation_error": error.max(axis=1)}


PARTS: dict[str, Callable[[TableProblem, Part], Arrays]] = {
    "discretisation": _discretisation,
    "modes": _modes,
    "fields": _fields,
    "cells": _cells,
}
"""How each kind of part is solved, by its name."""

PART_TYPES: dict[str, dict[str, str]] = {
    "discretisation": {"discretisation_error": "<f8"},
    "modes": {"omega": "<f8", "held": "<f8", "shapes": "<f4"},
    "fields": {"acceleration": "<c8"},
    "cells": {"cell_sources": "<f4"},
}
"""The arrays of each kind of part and their types."""


def _shares(what: str, count: int, size: int) -> list[Part]:
    return [Part(what, start, min(start + size, count)) for start in range(0, count, size)]


def _check_frequencies(frequencies: FloatArray, rig: Rig) -> None:
    if len(frequencies) == 0 or not (np.isfinite(frequencies).all()):
        raise InputError("a table needs at least one frequency, all of them numbers")
    if not (np.diff(frequencies) > 0).all():
        raise InputError("the frequencies of a table must ascend, each given once")
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    if frequencies[0] < low or frequencies[-1] > high:
        raise InputError(
            f"frequencies from {frequencies[0]:g} to {frequencies[-1]:g} Hz leave the rig's limits "
            f"of {low:g} to {high:g} Hz; choose others or change limits.frequency in the rig"
        )
