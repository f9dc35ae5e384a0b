"""The plate's vibration field for drawing: complex amplitude per frequency on a grid."""

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from controller.api.schema import PlayedTone
from model.arrays import ComplexArray, lattice
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig

_COLUMNS = 64  # grid points along the longer side; several per bending wavelength
_MAX_FREQUENCIES = 64  # in the cache
_FULL_SCALE = 32767
_HEADER = np.dtype("<f4")


@dataclass(frozen=True)
class Field:
    """Complex acceleration [m/s²] (f, ny, nx) per frequency [Hz], south-west corner first."""

    frequencies: tuple[float, ...]
    amplitude: ComplexArray

    def encoded(self) -> bytes:
        """Encode for the WebSocket, little-endian.

        u16 columns, u16 rows, u16 frequencies, u16 zero; f32 scale [m/s²]; f32 per frequency [Hz];
        then i16 per frequency, row and column: real and imaginary part, of 32767 as the scale.
        """
        count, rows, columns = self.amplitude.shape
        parts = np.stack([self.amplitude.real, self.amplitude.imag], axis=-1)
        scale = float(np.abs(parts).max(initial=0.0))
        whole = np.rint(parts / (scale or 1.0) * _FULL_SCALE).astype("<i2")
        sizes = np.array([columns, rows, count, 0], dtype="<u2")
        numbers = np.array([scale, *self.frequencies], dtype=_HEADER)
        return sizes.tobytes() + numbers.tobytes() + whole.tobytes()


class FieldSolver:
    """Computes fields of one rig; solves its plate once and caches the response per frequency."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._free = solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)
        longer = max(rig.plate.length, rig.plate.width)
        self.columns, self.rows = (
            max(2, math.ceil(_COLUMNS * side / longer))
            for side in (rig.plate.length, rig.plate.width)
        )
        self._points = lattice(
            np.linspace(0, rig.plate.length, self.columns),
            np.linspace(0, rig.plate.width, self.rows),
        )
        self._response = lru_cache(_MAX_FREQUENCIES)(self._solve)

    def field(self, drive: Mapping[str, PlayedTone]) -> Field:
        """The steady-state vibration under a drive by ERA; raises InputError."""
        frequencies = tuple(sorted({tone.frequency_hz for tone in drive.values()}))
        names = [era.name for era in self._rig.eras]
        amplitude = np.zeros((len(frequencies), self.rows * self.columns), dtype=complex)
        for name, tone in drive.items():
            weight = cmath.rect(tone.level, math.radians(tone.phase_deg))
            response = self._response(tone.frequency_hz)
            amplitude[frequencies.index(tone.frequency_hz)] += weight * response[names.index(name)]
        return Field(frequencies, amplitude.reshape(-1, self.rows, self.columns))

    def _solve(self, frequency: float) -> ComplexArray:
        """Acceleration [m/s²] (eras, points) per ERA at full stroke."""
        response: ComplexArray = self._free.acceleration(
            self._rig.eras, np.array([frequency]), self._points, loads=self._rig.masses
        )[0]
        return response
