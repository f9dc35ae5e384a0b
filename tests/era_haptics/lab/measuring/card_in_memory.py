"""A sound card in memory, in front of a plate on a desk, with faults of its wires and blocks."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from era_haptics.lab.measuring.sound_card import SoundCard
from kit.desk_plate import DeskPlate
from model.arrays import Float32Array, FloatArray

MEMORY_BLOCK = 4800
BLOCK = 128
"""Samples that are lost at once."""


class DeskCard(SoundCard):
    """Samples of a plate, without time.

    lost: runs in which a block is lost; late: runs in which samples come as late as if a block had
    been lost before; reported: losses that the driver reports in each run; on_outputs,
    on_inputs: order of the cables, by default as they should be; gain: of all inputs;
    drifts: of the clocks of some inputs, relative; factors: of some inputs; loudest: largest sample
    of each output so far; amplified: what amplifiers make of samples (n, eras) in a run.
    """

    def __init__(
        self,
        plate: DeskPlate,
        *,
        rate: float,
        lost: Sequence[int] = (),
        late: Sequence[int] = (),
        reported: int = 0,
        on_outputs: Sequence[int] | None = None,
        on_inputs: Sequence[int] | None = None,
        gain: float = 1.0,
        drifts: Mapping[int, float] = MappingProxyType({}),
        factors: Mapping[int, float] = MappingProxyType({}),
        amplified: Callable[[FloatArray, int], FloatArray] = lambda played, run: played,
    ) -> None:
        self.name = "memory"
        self.rate = rate
        self.gaps = reported
        self.runs = 0
        self.loudest = np.zeros(1)
        self._plate = plate
        self._lost, self._late = lost, late
        self._gain, self._drifts, self._factors = gain, drifts, factors
        self._amplified = amplified
        self._on_outputs = range(plate.outputs) if on_outputs is None else on_outputs
        self._on_inputs = range(plate.inputs) if on_inputs is None else on_inputs

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate by so many samples."""
        self.loudest = np.maximum(self.loudest, np.abs(played).max(axis=0))
        amplified = self._amplified(played[:, :-1], self.runs)
        driven = np.column_stack([amplified, played[:, -1]])[:, self._on_outputs]
        blocks = np.split(driven, range(MEMORY_BLOCK, len(played), MEMORY_BLOCK))
        heard = np.concatenate([self._plate.advance(block) for block in blocks])
        heard = self._with_losses(heard)
        self.runs += 1
        self._distort(heard)
        samples = np.clip(self._gain * heard[:, self._on_inputs], -1, 1)
        return np.asarray(samples, dtype=np.float32)

    def _with_losses(self, heard: FloatArray) -> FloatArray:
        """Return the samples without a block in the middle, or late by a block."""
        if self.runs in self._lost:
            middle = round(2 * self.rate)  # nothing says that a block is missing there
            heard = np.concatenate([heard[:middle], heard[middle + BLOCK :], heard[-BLOCK:]])
        if self.runs in self._late:
            silence = np.zeros((BLOCK, heard.shape[1]))
            heard = np.concatenate([silence, heard[:-BLOCK]])
        return heard

    def _distort(self, heard: FloatArray) -> None:
        """Let the clocks of some inputs drift, and scale some inputs."""
        samples = np.arange(len(heard), dtype=float)
        for number, drift in self._drifts.items():
            column = heard[:, number - 1]
            heard[:, number - 1] = np.interp(samples * (1 + drift), samples, column)
        for number, factor in self._factors.items():
            heard[:, number - 1] *= factor

    def close(self) -> None:
        """Nothing is open."""
