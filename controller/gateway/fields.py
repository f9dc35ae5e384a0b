"""How the plate vibrates, for the picture of it: complex amplitude per frequency on a raster."""

import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from controller.api.schema import PlayedTone
from model.arrays import ComplexArray, lattice
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig

_COLUMNS = 64  # points along the plate's longer side; bending waves are several of them long
_MOST_FREQUENCIES = 64  # that are kept
_FULL_SCALE = 32767
_HEADER = np.dtype("<f4")


@dataclass(frozen=True)
class Field:
    """Complex acceleration [m/s²] per frequency [Hz] (f, ny, nx), south-west corner first."""

    frequencies: tuple[float, ...]
    amplitude: ComplexArray

    @property
    def peak(self) -> float:
        """The highest peak acceleration anywhere [m/s²]: the sum over the frequencies."""
        return float(np.abs(self.amplitude).sum(axis=0).max(initial=0.0))

    def encoded(self) -> bytes:
        """For the wire, all little-endian.

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


class FieldMaker:
    """Fields of one rig; solves its plate once, and keeps what each frequency does."""

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
        self._responses: OrderedDict[float, ComplexArray] = OrderedDict()

    def field(self, drive: Mapping[str, PlayedTone]) -> Field:
        """The plate's steady vibration under a drive by ERA; raises InputError."""
        frequencies = tuple(sorted({tone.frequency_hz for tone in drive.values()}))
        names = [era.name for era in self._rig.eras]
        amplitude = np.zeros((len(frequencies), self.rows * self.columns), dtype=complex)
        for name, tone in drive.items():
            weight = tone.level * np.exp(1j * math.radians(tone.phase_deg))
            response = self._response(tone.frequency_hz)
            amplitude[frequencies.index(tone.frequency_hz)] += weight * response[names.index(name)]
        return Field(frequencies, amplitude.reshape(-1, self.rows, self.columns))

    def _response(self, frequency: float) -> ComplexArray:
        """Acceleration of each ERA at full stroke [m/s²], (eras, points)."""
        if frequency not in self._responses:
            (response,) = self._free.acceleration(
                self._rig.eras, np.array([frequency]), self._points, loads=self._rig.loads
            )
            self._responses[frequency] = response
            if len(self._responses) > _MOST_FREQUENCIES:
                self._responses.popitem(last=False)
        self._responses.move_to_end(frequency)
        return self._responses[frequency]
