"""What a drive of limited duration does at fingertips, solved in time with the fingers' weight."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from model.answer.over_duration import FollowedPart, OverDuration, pulse_ramp
from model.answer.search import Contents
from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray, Point
from model.drive_modes.forms import Drive
from model.finger.perception import detection_threshold
from model.structure.attachments import Fingertip, fingertip_loads
from model.table.raster import FingertipShapes
from model.table.raster_kernel import read_fingertips
from model.table.table import LocalizationTable
from model.transients.loaded_ramps import (
    ramped_accelerations,
    ramped_responses,
    response_count,
    time_count,
)


@dataclass(frozen=True, eq=False)
class PulseResponses:
    """Accelerations at k fingertips over a duration of each ERA alone at full stroke.

    rows (f,): of the table's frequencies; values (f, eras, n + 1, k, p) [m/s²]: demodulated, the
    last of the steady vibration; threshold (f,) [m/s²]; weights (k, p), count and share as for
    `OverDuration`.
    """

    rows: IntArray
    values: ComplexArray
    threshold: FloatArray
    weights: FloatArray
    count: int
    share: float

    def over(self, drive: Drive) -> OverDuration:
        """What fingers feel of a drive at full level, whose frequencies are rows of the table."""
        squares = np.zeros(self.values.shape[2:])
        for row, weights in drive:
            at = int(np.searchsorted(self.rows, row))
            field = np.tensordot(weights, self.values[at], axes=1)
            squares += (field.real**2 + field.imag**2) / self.threshold[at] ** 2
        return OverDuration.of(squares, self.weights, count=self.count, share=self.share)

    def fields(self) -> Complex64Array:
        """Fields over the duration (f, k, times, p, eras), as forms need them."""
        return self.values[:, :, :-1].transpose(0, 3, 2, 4, 1).astype(np.complex64)


@dataclass(frozen=True, eq=False)
class RingingUnderFingers:
    """Drives of a duration [s] along plain ramps [s], under fingers at places [m] of a plate.

    loads: of each relative to the rig's fingertip, empty for 1.
    """

    table: LocalizationTable
    places: tuple[Point, ...]
    loads: tuple[float, ...]
    duration: float
    ramp: float
    _solved: dict[tuple[int, ...], PulseResponses] = field(default_factory=dict)

    @classmethod
    def of_streams(
        cls, table: LocalizationTable, contents: Contents
    ) -> list["RingingUnderFingers | None"]:
        """One for each content that has a duration, None for those that last."""
        fingers = contents.places, contents.loads
        return [
            None
            if each is None
            else cls(table, *fingers, each, max(pulse_ramp(each), contents.least_ramp))
            for each in contents.durations
        ]

    def responses(self, rows: IntArray) -> PulseResponses:
        """Responses at ascending rows of the table's frequencies, solved once.

        At the few points of each fingertip by which drives are searched.
        """
        key = tuple(rows.tolist())
        if key not in self._solved:
            self._solved[key] = self._responses(rows)
        return self._solved[key]

    def _responses(self, rows: IntArray) -> PulseResponses:
        table, part = self.table, FollowedPart.of(self.duration)
        tips = self._tips
        k, p, r = tips.few.shape
        frequencies = table.frequencies[rows]
        values = [
            ramped_responses(
                table.in_time,
                frequency,
                points=tips.few.reshape(-1, r).astype(float),
                fingers=self._fingers(tips.few),
                ramp=self.ramp,
                duration=part.duration,
                after=part.after,
            )
            for frequency in frequencies.tolist()
        ]
        return PulseResponses(
            rows,
            np.array(values).reshape(len(rows), len(table.eras), -1, k, p),
            detection_threshold(frequencies, table.threshold),
            tips.few_weights.astype(float),
            response_count(part.duration),
            part.share,
        )

    def over(self, tones: Iterable[tuple[float, ComplexArray]]) -> OverDuration:
        """What fingers feel at their fine points of tones together.

        Of each its frequency [Hz] and the motions of the bases (eras,) [m].
        """
        table, part, tips = self.table, FollowedPart.of(self.duration), self._tips
        k, p, r = tips.fine.shape
        squares = np.zeros(())
        for frequency, bases in tones:
            found = ramped_accelerations(
                table.in_time,
                bases,
                float(frequency),
                points=tips.fine.reshape(-1, r).astype(float),
                fingers=self._fingers(tips.fine),
                ramp=self.ramp,
                duration=part.duration,
                after=part.after,
            )
            threshold = detection_threshold(np.array(frequency), table.threshold)
            squares = squares + (found.real**2 + found.imag**2) / threshold**2
        return OverDuration.of(
            squares.reshape(-1, k, p),
            tips.fine_weights.astype(float),
            count=time_count(part.duration),
            share=part.share,
        )

    @property
    def _tips(self) -> FingertipShapes:
        return read_fingertips(self.table, self.places)

    def _fingers(self, tips: Float32Array) -> Sequence[tuple[FloatArray, Fingertip]]:
        """Shapes (r,) of the plate under the fingers on it, from (k, p, r), and their loads."""
        loads = fingertip_loads(self.table.fingertip, self.places, self.loads)
        centres = tips[: len(loads), 0].astype(float)
        return [(centre, load.fingertip) for centre, load in zip(centres, loads, strict=True)]
