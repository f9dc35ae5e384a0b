"""The localization table: which pattern makes one finger feel it and the others not.

It holds the response of every ERA at every frequency at the nodes of the mesh, so that a quiet zone
of fingertips anywhere on the plate can be asked for at run time, and the response of every pattern
at every cell of a grid, which says what lone fingers get and what the whole table can do.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata

import numpy as np
from numpy.typing import NDArray

from model.actuator import Era
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.excitation import Excitation, Tone
from model.fingertip import FINGERTIP_RADIUS, fingertip_points
from model.free_plate import solve_free_plate
from model.localization import CELL_SAMPLES, SURROUNDINGS_RADIUS, Grid, contrast_db, decibels
from model.mesh import Mesh
from model.perception import STRONG_DB_SL, detection_threshold
from model.plate import Plate
from model.point_mass import PointMass
from model.rig import Rig, physics_fingerprint
from model.switched import (
    SILENT,
    enumerate_patterns,
    peak_of_patterns,
    sensation_of_patterns,
)
from model.vibration import tone_amplitudes

PAPER_FREQUENCIES = np.arange(60.0, 321.0, 10.0)
"""The 27 excitation frequencies [Hz]: 60 to 320 in steps of 10 holds every one the paper names."""

MODES = ("switched",)
"""Drive modes that a table can be built for."""

PAPER_GRID = Grid(12, 9)

# Long enough not to click, short enough to be felt as one with the touch.
ONSET_RAMP = 0.020


@dataclass(frozen=True)
class Pattern:
    """What the table answers: an excitation with its ramp [s] and what it is predicted to do.

    level_db_sl: at the target; contrast_db: target to the loudest quiet point; quiet_level_db_sl:
    at that point. The last two are None where one finger is alone.
    """

    excitation: Excitation
    ramp: float
    level_db_sl: float
    contrast_db: float | None
    quiet_level_db_sl: float | None


@dataclass(frozen=True)
class LocalizationTable:
    """Patterns of one plate on its ERAs, with all that is needed to choose among them.

    frequencies (f,) [Hz]; acceleration (f, eras, nodes) complex [m/s²], each ERA alone at full
    stroke; patterns (n, eras) index of a frequency or SILENT; cell_response (n, cells) mean peak
    acceleration over each cell [m/s²].
    """

    plate: Plate
    eras: tuple[Era, ...]
    masses: tuple[PointMass, ...]
    mesh: Mesh
    grid: Grid
    mode: str
    code_version: str
    frequencies: FloatArray
    acceleration: NDArray[np.complex64]
    patterns: NDArray[np.int16]
    cell_response: NDArray[np.float32]

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the plate on its ERAs that this table is for."""
        return physics_fingerprint(self.plate, self.eras, masses=self.masses)

    def answer(
        self,
        target: tuple[float, float],
        *,
        quiet: Sequence[tuple[float, float]] = (),
        level_db_sl: float = STRONG_DB_SL,
    ) -> Pattern:
        """The pattern of highest contrast among those that reach a level at the target.

        target, quiet: where fingertips rest [m]. A lone target is told from the plate beyond 50 mm
        (root mean square). The pattern is then turned down to the level asked for; contrast does
        not depend on that. Raises InputError for positions off the plate, a target within a quiet
        fingertip, and a level that no pattern reaches.
        """
        at_target = self._response(self._fingertip(target, what="target"))
        sensation = sensation_of_patterns(at_target, self._threshold).mean(axis=-1)
        available = decibels(sensation)
        reaches = available >= level_db_sl
        if not reaches.any():
            raise InputError(
                f"no pattern reaches {level_db_sl:g} dB SL at ({target[0]:g}, {target[1]:g}) m; "
                f"the most that can be had there is {available.max():.1f} dB SL"
            )
        peak_target = peak_of_patterns(at_target)
        if quiet:
            at_quiet = self._response(self._quiet_zone(target, quiet))
            contrast = contrast_db(peak_target, peak_of_patterns(at_quiet))
        else:
            contrast = decibels(peak_target.mean(axis=-1) / self._surroundings(target))
        best = int(np.argmax(np.where(reaches, contrast, -np.inf)))
        gain = 10 ** ((level_db_sl - available[best]) / 20)
        quiet_level = None
        if quiet:
            loudest = sensation_of_patterns(at_quiet, self._threshold)[best].max()
            quiet_level = float(decibels(gain * loudest))
        return Pattern(
            excitation=self._excitation(best, gain=gain),
            ramp=ONSET_RAMP,
            level_db_sl=level_db_sl,
            contrast_db=float(contrast[best]) if quiet else None,
            quiet_level_db_sl=quiet_level,
        )

    def amplitudes(self, excitation: Excitation) -> tuple[FloatArray, FloatArray]:
        """Frequencies (f,) [Hz] and peak acceleration at the mesh's nodes (f, nodes) [m/s²].

        The excitation's frequencies must be the table's own.
        """
        return tone_amplitudes(
            excitation,
            self.eras,
            lambda f: self.acceleration[np.searchsorted(self.frequencies, f)].astype(complex),
        )

    def drive_of(self, excitation: Excitation) -> dict[str, dict[str, float]]:
        """An excitation as people read it: frequency, level 0..1 of the stroke, phase, by ERA."""
        strokes = {era.name: era.stroke for era in self.eras}
        return {
            name: {
                "frequency_hz": tone.frequency,
                "level": tone.amplitude / strokes[name],
                "phase_deg": math.degrees(tone.phase),
            }
            for name, tone in excitation.items()
        }

    @cached_property
    def available_level_db_sl(self) -> FloatArray:
        """Highest level [dB SL] that any pattern reaches at the centre of each cell, (cells,)."""
        at_centres = _at_points(self.mesh, self.acceleration, self._cell_centres)
        return decibels(sensation_of_patterns(at_centres, self._threshold).max(axis=0))

    @cached_property
    def _threshold(self) -> FloatArray:
        return detection_threshold(self.frequencies)

    @cached_property
    def _cell_centres(self) -> FloatArray:
        return self.grid.centres(self.plate)

    def _fingertip(self, position: tuple[float, float], *, what: str) -> FloatArray:
        x, y = position
        if not self.plate.contains(x, y):  # not true of NaN either
            raise InputError(
                f"{what} ({x:g}, {y:g}) m is not on the plate, which reaches from (0, 0) to "
                f"({self.plate.length:g}, {self.plate.width:g}) m"
            )
        return fingertip_points(x, y, self.plate)

    def _quiet_zone(
        self, target: tuple[float, float], quiet: Sequence[tuple[float, float]]
    ) -> FloatArray:
        for position in quiet:
            if np.hypot(position[0] - target[0], position[1] - target[1]) < FINGERTIP_RADIUS:
                raise InputError(
                    f"target ({target[0]:g}, {target[1]:g}) m lies within the quiet fingertip at "
                    f"({position[0]:g}, {position[1]:g}) m; keep them "
                    f"{1000 * FINGERTIP_RADIUS:g} mm apart at least"
                )
        return np.concatenate([self._fingertip(position, what="quiet") for position in quiet])

    def _response(self, points: FloatArray) -> ComplexArray:
        """Acceleration of each ERA at points (p, 2): (f, eras, p)."""
        return _at_points(self.mesh, self.acceleration, points)

    def _surroundings(self, target: tuple[float, float]) -> FloatArray:
        """Root mean square of every pattern (n,) over the cells that are not near the target."""
        far = np.hypot(*(self._cell_centres - target).T) > SURROUNDINGS_RADIUS
        cells = self.cell_response[:, far if far.any() else slice(None)]
        return np.asarray(np.sqrt((cells.astype(float) ** 2).mean(axis=-1)))

    def _excitation(self, pattern: int, *, gain: float) -> Excitation:
        return {
            era.name: Tone(float(self.frequencies[index]), float(gain * era.stroke))
            for era, index in zip(self.eras, self.patterns[pattern], strict=True)
            if index != SILENT
        }


def build_table(
    rig: Rig,
    *,
    frequencies: FloatArray = PAPER_FREQUENCIES,
    grid: Grid = PAPER_GRID,
    mode: str = "switched",
) -> LocalizationTable:
    """Solve the rig's plate on its mesh and keep what localization needs.

    frequencies [Hz], ascending, within the rig's limits; mode: one of MODES. Raises InputError.
    """
    if mode not in MODES:
        raise InputError(f"unknown drive mode {mode!r}; known: {', '.join(MODES)}")
    _check_frequencies(frequencies, rig)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(frequencies[-1]))
    nodes = free.acceleration(rig.eras, frequencies, rig.mesh.nodes, loads=rig.loads)
    peak = peak_of_patterns(_at_points(rig.mesh, nodes, grid.samples(rig.plate)))
    return LocalizationTable(
        plate=rig.plate,
        eras=rig.eras,
        masses=rig.masses,
        mesh=rig.mesh,
        grid=grid,
        mode=mode,
        code_version=metadata.version("era-haptics"),
        frequencies=frequencies,
        acceleration=nodes.astype(np.complex64),
        patterns=enumerate_patterns(len(rig.eras), len(frequencies)),
        cell_response=peak.reshape(len(peak), -1, CELL_SAMPLES**2).mean(axis=-1).astype(np.float32),
    )


def _at_points(
    mesh: Mesh, acceleration: NDArray[np.complexfloating], points: FloatArray
) -> ComplexArray:
    """Acceleration (f, eras, nodes) at points [m] (p, 2) instead: (f, eras, p)."""
    flat = acceleration.reshape(-1, mesh.node_count)
    return np.asarray(mesh.interpolation(points) @ flat.T).T.reshape(*acceleration.shape[:2], -1)


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
