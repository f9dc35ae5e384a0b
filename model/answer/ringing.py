"""Drives of limited duration on a plate with fingers: spectra, and the sensations of fingers."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from model.answer.envelope import DriveEnvelope, OverDuration
from model.answer.question import Contents
from model.arrays import ComplexArray, FloatArray, IntArray, Point
from model.drive_forms import Forms, WeightedTones
from model.finger import detection_threshold
from model.structure.fingertips import fingertip_loads
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.transients.enveloped_response import enveloped_accelerations

_MAX_DISTANCE = 60.0  # Hz; of the tones that represent a drive
_LEAST_SHARE = 1e-3  # minimum power of a tone, relative to the drive's strongest moments
_LEAST_PERIODS = 1.7  # minimum number in a pulse; 1.4 % of its energy is below 0 Hz then


@dataclass(frozen=True, eq=False)
class RingingUnderFingers:
    """Drives along an envelope on a table's plate with fingers.

    The envelope is represented by tones at the table's frequencies near the drive's. Weights are
    searched and drawn plates evaluated with these tones (`DriveEnvelope.shares_at`).
    """

    table: LocalizationTable
    places: tuple[Point, ...]
    """Positions of the fingers [m]."""
    loads: tuple[float, ...]
    """Loads relative to the rig's fingertip, empty for 1 each."""
    envelope: DriveEnvelope
    _solved: dict[tuple[tuple[int, bytes], ...], OverDuration] = field(default_factory=dict)

    @classmethod
    def of_streams(
        cls, table: LocalizationTable, contents: Contents
    ) -> list["RingingUnderFingers | None"]:
        """Build one for each content with a duration; None for continuous or shaped ones."""
        ringing: list[RingingUnderFingers | None] = []
        for stream in contents.streams:
            envelope: DriveEnvelope | None = None
            if stream.course is not None:
                envelope = DriveEnvelope.of_course(stream.course)
            elif stream.duration is not None and contents.is_pulse(stream):
                envelope = DriveEnvelope.of_pulse(stream.duration, contents.ramp(stream))
            if envelope is None:
                ringing.append(None)
            else:
                ringing.append(
                    cls(
                        table=table,
                        places=contents.places,
                        loads=contents.loads,
                        envelope=envelope,
                    )
                )
        return ringing

    @cached_property
    def shares(self) -> FloatArray:
        """Fraction (f, f) of a drive's steady power in tones at each of the table's frequencies.

        One row per frequency that the drive can have.
        """
        frequencies = self.table.frequencies
        row_count = len(frequencies)
        near_lowest = (frequencies <= frequencies[0] + _MAX_DISTANCE).sum()
        near_highest = (frequencies >= frequencies[-1] - _MAX_DISTANCE).sum()
        pad_count = int(max(near_lowest, near_highest)) - 1
        padded = np.pad(frequencies, pad_count, mode="reflect", reflect_type="odd")
        # Tones beyond the table's ends are reflected into it.
        padded_rows = np.pad(np.arange(row_count), pad_count, mode="reflect")
        shares = np.zeros((row_count, row_count))
        shares_by_distances = dict[tuple[float, ...], FloatArray]()
        for row, frequency in enumerate(frequencies.tolist()):
            distances = np.round(padded - frequency, 6)
            is_near = np.abs(distances) <= _MAX_DISTANCE
            near_distances = distances[is_near]
            key = tuple(near_distances.tolist())
            if key not in shares_by_distances:
                shares_by_distances[key] = self.envelope.shares_at(near_distances)
            np.add.at(shares[row], padded_rows[is_near], shares_by_distances[key])
        strongest = self.envelope.moments(self.envelope.values**2).max()
        shares[shares < _LEAST_SHARE * strongest] = 0.0
        return shares

    def spectrum(self, drive: WeightedTones) -> WeightedTones:
        """Return steady tones with the energy of a drive along the envelope, on any plate.

        By Parseval's theorem, except for frequencies far from the drive's. Amplitudes are compared
        with the threshold at the drive's own frequency.
        """
        tones: WeightedTones = []
        thresholds = self.table.thresholds
        for drive_row, weights in drive:
            drive_shares = self.shares[drive_row]
            for row in np.flatnonzero(drive_shares).tolist():
                factor = math.sqrt(drive_shares[row]) * thresholds[row] / thresholds[drive_row]
                tones.append((row, np.asarray(factor * weights, dtype=np.complex64)))
        return tones

    def forms(self, steady: Forms, rows: IntArray) -> Forms:
        """Return forms over the envelope at some rows, from steady forms at all frequencies."""
        shares = self.shares[rows].astype(np.float32)
        target_power = (np.abs(steady.targets) ** 2).sum(axis=(0, 2))
        power_gain = shares @ target_power / np.maximum(target_power[rows], 1e-30)
        quiet = shares @ steady.quiet.reshape(len(steady.quiet), -1)
        own_shares = np.sqrt(self.shares[rows, rows]).astype(np.float32)
        carrier_gain = own_shares[:, None, None, None]
        forms = steady.at(rows)
        return replace(
            forms,
            targets=forms.targets * np.sqrt(power_gain)[:, None],
            quiet=quiet.reshape(forms.quiet.shape),
            level_margin=0.0,
            few=None if forms.few is None else forms.few * carrier_gain,
            fine=None if forms.fine is None else forms.fine * carrier_gain,
        )

    def lasting_long_enough(self, rows: IntArray) -> IntArray:
        """Return the rows whose spectrum does not reach down to 0 Hz; all rows if every spectrum
        does.

        A drive with fewer periods moves the plate as a whole. The frequencies of a table cannot
        represent this motion.
        """
        if self.envelope.is_course:
            return rows
        periods = self.table.frequencies[rows] * self.envelope.within * self.envelope.step
        long_rows = rows[periods >= _LEAST_PERIODS]
        return long_rows if len(long_rows) else rows

    def over_drive(self, drive: WeightedTones) -> OverDuration:
        """Return the sensation of a drive over the duration; each drive is solved once."""
        key = tuple([(row, weights.tobytes()) for row, weights in drive])
        if key not in self._solved:
            tones = list[tuple[float, ComplexArray]]()
            for row, weights in drive:
                bases = np.multiply(weights, self.table.highest_drives[row], dtype=complex)
                tones.append((float(self.table.frequencies[row]), bases))
            self._solved[key] = self.over(tones)
        return self._solved[key]

    def over(self, tones: Iterable[tuple[float, ComplexArray]]) -> OverDuration:
        """Solve the sensation of simultaneous tones: frequency [Hz], base motions (eras,) [m]."""
        table = self.table
        tips = read_fingertips(table, self.places)
        finger_count, point_count, coordinate_count = tips.fine.shape
        loads = fingertip_loads(table.fingertip, self.places, self.loads)
        centers = tips.fine[: len(loads), 0].astype(float)
        fingers = [(center, load.fingertip) for center, load in zip(centers, loads, strict=True)]
        squares = np.zeros(())
        for frequency, bases in tones:
            accelerations = enveloped_accelerations(
                table.in_time,
                bases,
                float(frequency),
                points=tips.fine.reshape(-1, coordinate_count).astype(float),
                fingers=fingers,
                envelope=self.envelope.values,
                step=self.envelope.step,
            )
            threshold = detection_threshold(np.array(frequency), table.threshold)
            squares = squares + (accelerations.real**2 + accelerations.imag**2) / threshold**2
        by_finger = squares.reshape(-1, finger_count, point_count)
        return self.envelope.felt(by_finger, tips.fine_weights.astype(float))


def on_drawn_plates(
    energies: FloatArray, heard: FloatArray, factor: FloatArray | float
) -> FloatArray:
    """Convert energies to power over a duration on drawn plates (..., 1 + d), nominal first.

    heard (...): power over the duration on the nominal plate; factor: ratio of power to energy at
    the target, applied to the additional energy on other plates.
    """
    added = factor * (energies - energies[..., :1])
    return np.maximum(heard[..., None] + added, 0.0)
