"""Stimuli of limited duration: what fingers feel of a drive over it, onset and ringing included.

A plate follows its drive late: over 40 ms the root mean square at a finger is several decibels
below, on a sharp resonance ten decibels below, that of the steady vibration, and it rings on. A
target counts by the mean of its demodulated acceleration over the duration, another fingertip by
its power, that after the end included. The best drives are solved in time, with the fingers'
weight.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from model.answer.fingers import SHAPED_FROM
from model.answer.fingers_on_plate import FingerForms
from model.answer.search import Contents
from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray, Point
from model.drive_modes.forms import Drive, Forms
from model.ensemble.touched_plate import gram
from model.finger.perception import detection_threshold
from model.structure.attachments import Fingertip, fingertip_loads
from model.table.raster import FingertipShapes
from model.table.table import LocalizationTable, read_fingertips
from model.transients.knots import RISE
from model.transients.loaded_ramps import (
    ramped_accelerations,
    ramped_responses,
    response_count,
    time_count,
)
from model.transients.ringing import RINGING_TIMES, RampedRinging

ONSET_RAMP = 0.040
"""Duration of a plain ramp [s].

Twice what just avoids a click: the slower start gains 4 dB of contrast over the first 100 ms, and
at 20 dB SL the target still feels it after a fifth of it (docs/concepts/transients.md).
"""

RINGING = 0.100
"""Time [s] after a short effect over which what other fingers feel is followed.

Weights keep them quiet as long as they are followed, and no longer: where that was 20 ms, what
rang after was up to 7 dB stronger on four ERAs, 18 dB on a large table.
"""

_BESIDE = 1.7
"""Distance of the frequencies beside its own that count of a short drive, by the reciprocal of its
duration: beyond it are 1.4 % of its energy."""


def pulse_ramp(duration: float) -> float:
    """Plain ramp [s] of a vibration of this duration [s], a quarter of it.

    The vibration is even over its duration then: no 40 ms of a click of 40 ms are more than 0.8 dB
    (median) stronger than the first 40, along a ramp of half of it 1.5, as long as it 3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


def shaped_gain(duration: float) -> float:
    """Amplitude over a duration [s] relative to the steady one with a shaped onset.

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    return math.sqrt(1 - 5 / 8 * min(RISE, duration) / duration)


@dataclass(frozen=True)
class FollowedPart:
    """Part of an effect that is followed: its duration and what is followed after it [s].

    after: None where the effect goes on; share: of the part in the duration.
    """

    duration: float
    after: float | None
    share: float

    @classmethod
    def of(cls, duration: float) -> "FollowedPart":
        """Short ones to beyond their end, where a quiet finger may feel most."""
        length = min(duration, SHAPED_FROM)  # the rest is steady
        after = RINGING if duration <= SHAPED_FROM else None
        return cls(length, after, length / duration)


@dataclass(frozen=True, eq=False)
class OverDuration:
    """What k fingers feel of a drive over a duration on the nominal plate.

    gains (k,): mean amplitude relative to the steady one; heard (k, p): squared amplitude to
    threshold at each point over as long, at its strongest.
    """

    gains: FloatArray
    heard: FloatArray

    @classmethod
    def of(
        cls, squares: FloatArray, weights: FloatArray, *, count: int, share: float
    ) -> "OverDuration":
        """From squared amplitudes to threshold (n + 1, k, p), the last of them lasting.

        weights (k, p): of the points in the mean; count: times within the part that is followed;
        share: of it in the duration, the rest of which is steady.
        """
        lasting, sums = squares[-1], np.cumsum(squares[:-1], axis=0)
        sums[count:] -= sums[:-count].copy()
        power = share * sums[count - 1 :] / count + (1 - share) * lasting
        felt = (np.sqrt(power[0]) * weights).sum(axis=1)
        steady = (np.sqrt(lasting) * weights).sum(axis=1)
        return cls(felt / np.maximum(steady, 1e-30), power.max(axis=0))


def on_drawn_plates(
    energies: FloatArray, heard: FloatArray, factor: FloatArray | float
) -> FloatArray:
    """Power over a duration on drawn plates (..., 1 + d), from energies, nominal first.

    heard (...): over the duration on the nominal plate; factor: of power over the duration to
    energies, as at the target. What other plates add to the energy is felt by as much.
    """
    added = factor * (energies - energies[..., :1])
    return np.asarray(np.maximum(heard[..., None] + added, 0.0))


def forms_over(
    steady: Forms,
    formed: FingerForms,
    targets: Sequence[int],
    others: Sequence[int],
    ringing: RampedRinging,
) -> Forms:
    """Forms over an effect from steady ones; ringing is that of the plate without fingers."""
    fields, few = formed.contacts.fields, formed.fingers.tips.few
    (f, k, p, n), at = fields.shape, few.reshape(-1, few.shape[2])
    real, imaginary = ringing.parts[:, formed.rows].reshape(2, -1, at.shape[1]) @ at.T
    parts = (real + 1j * imaginary).reshape(f, n, -1, k, p).transpose(0, 3, 2, 4, 1)
    over = parts + ringing.envelope[:, None, None] * fields[:, :, None]
    return forms_of(steady, formed, targets, others, over, RINGING_TIMES)


def forms_of(
    steady: Forms,
    formed: FingerForms,
    targets: Sequence[int],
    others: Sequence[int],
    over: Complex64Array,
    count: int,
) -> Forms:
    """Forms from fields over an effect (f, k, times, p, n); count: times until its end."""
    targets, others = [*targets], [*others]
    weights, (f, _, _, _, n) = formed.fingers.tips.few_weights, over.shape
    at = over[:, targets, :count].mean(axis=2)
    scale = np.sqrt(weights[others])[:, None, :, None]
    lasting, during = (
        (each[:, others] * scale / np.float32(math.sqrt(length))).reshape(f, len(others), -1, n)
        for each, length in ((formed.contacts.fields[:, :, None], 1), (over, count))
    )
    return replace(
        steady,
        targets=(at * weights[targets, :, None]).sum(axis=2).swapaxes(0, 1),
        quiet=np.ascontiguousarray(steady.quiet + gram(during) - gram(lasting)),
        level_margin=0.0,
        few=None,
        fine=None,
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

    def spectrum(self, row: int) -> tuple[IntArray, FloatArray]:
        """Rows of the table's frequencies near its own (b,), and factors (b,) on weights.

        Tones with these have together the energy of the drive on any plate (Parseval), but for what
        its ramps excite far beside: of a duration T along raised cosines of r the amplitude is
        sinc(f T) cos(pi f r) / (1 - 4 f² r²), each for what is nearest to it. Above the threshold
        at its own frequency.
        """
        table, ramp = self.table, self.ramp
        off = table.frequencies - table.frequencies[row]
        rows = np.flatnonzero(np.abs(off) * self.duration < _BESIDE)
        off = off[rows]
        edges = np.sinc(off * ramp - 0.5) + np.sinc(off * ramp + 0.5)
        widths = np.gradient(table.frequencies)[rows] if len(table.frequencies) > 1 else 1.0
        amplitudes = np.sinc(off * self.duration) * edges * np.sqrt(widths)
        thresholds = table.thresholds[rows] / table.thresholds[row]
        return rows, thresholds * amplitudes / np.linalg.norm(amplitudes)

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
