"""Playback of layers on a plate: records of fingertips, and the levels that fingers feel.

The plate is linear: each layer is played alone, which separates a finger's own layers from the
layers of other fingers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.files.csv_file import as_frame
from model.finger import (
    DEFAULT_THRESHOLD,
    contrast_db,
    decibels,
    over_threshold,
    sensation_level,
)
from model.quantities import counted
from model.transients.shaping import ONSET_WINDOW
from sim.plant.fingers import FingerRecord, felt_peaks, fit_tones

STEADY = 0.25
"""Length [s] of the final window for fitting steady amplitudes; resolves 10 Hz."""

LEVEL_WINDOW = 0.03
"""Length [s] of the Hann window for the RMS level over time."""

LEVEL_STEP = 0.005
"""Time [s] between two windows of the RMS level."""


@dataclass(frozen=True, eq=False)
class FeltFinger:
    """Steady level and level over time that a finger feels during playback; contains no promises.

    level_db_sl: level of its own layers, mean over the fingertip; foreign_level_db_sl: level of all
    other layers at its loudest point; both -inf without layers. levels_db_sl, foreign_levels_db_sl
    (w,): RMS levels over a Hann window of 30 ms, at times (w,) [s]. All levels are relative to the
    threshold set of the playback. An answer's foreign_level_db_sl is the maximum over several sets:
    compare this one with its rig_foreign_level_db_sl.
    """

    level_db_sl: float
    foreign_level_db_sl: float
    contrast_db: float | None
    times: FloatArray = field(repr=False)
    levels_db_sl: FloatArray = field(repr=False)
    foreign_levels_db_sl: FloatArray = field(repr=False)

    def to_frame(self) -> Any:
        """Return time, own level and foreign level as a pandas DataFrame; needs pandas."""
        return as_frame(
            {
                "time_s": self.times,
                "level_db_sl": self.levels_db_sl,
                "foreign_level_db_sl": self.foreign_levels_db_sl,
            }
        )


@dataclass(frozen=True, eq=False)
class Vibration:
    """Vibration at all fingers, from one layer alone or from the signals of all ERAs.

    frequencies (f,) [Hz]: driven frequencies, empty for signals; fingers: indices of the targets;
    records: one per finger, in order; harmonics (f,) [Hz]: frequencies added by ERAs with
    harmonics.
    """

    frequencies: tuple[float, ...]
    fingers: tuple[int, ...]
    records: tuple[FingerRecord, ...]
    harmonics: tuple[float, ...] = ()

    @property
    def all_frequencies(self) -> list[float]:
        """Driven frequencies and harmonics [Hz], ascending."""
        return sorted({*self.frequencies, *self.harmonics})


@dataclass(frozen=True, eq=False)
class PlatePlayback:
    """Recorded vibration of all fingertips during the playback of layers, from rest at time 0.

    vibrations: each layer alone; a finger without a layer is quiet; settled [s]: end of the onsets;
    threshold: the threshold set of levels and contrasts (answers have the minimum over several
    sets). Steady levels of tones are fitted to the last 0.25 s, in which the plate has settled;
    steady levels of signals are their power in the last 0.25 s, whether settled or not.
    """

    vibrations: tuple[Vibration, ...]
    settled: float
    threshold: str = DEFAULT_THRESHOLD

    def __repr__(self) -> str:
        driven = ", ".join(f"{frequency:g} Hz" for frequency in self.frequencies) or "signals"
        felt = f"{counted(len(self.targets), 'target')} and {len(self.quiet)} quiet"
        return f"<Playback of {driven} for {self.targets[0].times[-1]:g} s at {felt}>"

    def to_frame(self) -> Any:
        """Time and mean acceleration of each fingertip as a pandas DataFrame; needs pandas."""
        columns = {"time_s": self.records[0].times}
        for name, records in (("target", self.targets), ("quiet", self.quiet)):
            for number, record in enumerate(records, start=1):
                columns[f"{name}_{number}_m_s2"] = record.accelerations @ record.weights
        return as_frame(columns)

    @property
    def frequencies(self) -> tuple[float, ...]:
        """Driven frequencies [Hz], ascending."""
        driven: set[float] = set()
        for vibration in self.vibrations:
            driven.update(vibration.frequencies)
        return tuple(sorted(driven))

    @cached_property
    def records(self) -> tuple[FingerRecord, ...]:
        """Record of each finger with all layers playing, in the given order of fingers."""
        records_by_layer = [vibration.records for vibration in self.vibrations]
        sums = []
        for records in zip(*records_by_layer, strict=True):
            total = np.sum([record.accelerations for record in records], axis=0)
            sums.append(replace(records[0], accelerations=total))
        return tuple(sums)

    @property
    def targets(self) -> tuple[FingerRecord, ...]:
        """Records of the fingers with a layer."""
        return tuple([self.records[number] for number in self._target_numbers])

    @property
    def quiet(self) -> tuple[FingerRecord, ...]:
        """Records of the fingers without a layer."""
        return tuple([self.records[number] for number in self._quiet_numbers])

    @property
    def _target_numbers(self) -> list[int]:
        """Indices of the fingers with a layer, ascending."""
        numbers: set[int] = set()
        for vibration in self.vibrations:
            numbers.update(vibration.fingers)
        return sorted(numbers)

    @property
    def _quiet_numbers(self) -> list[int]:
        """Indices of the fingers without a layer, ascending."""
        targets = self._target_numbers
        return [number for number in range(len(self.records)) if number not in targets]

    @cached_property
    def fingers(self) -> tuple[FeltFinger, ...]:
        """Vibration felt by each finger, in the given order."""
        numbers = range(len(self.records))
        levels = np.array([self._levels(number) for number in numbers])
        own_levels, foreign_levels = levels[:, 0], levels[:, 1]  # (fingers, 1 + w)
        contrasts = self._contrasts(own_levels[:, 0], foreign_levels[:, 0])
        count, step = self._window
        window_count = levels.shape[2] - 1
        times = self.records[0].times[count // 2 :: step][:window_count]
        felt = []
        for number, contrast in zip(numbers, contrasts.tolist(), strict=True):
            finger = FeltFinger(
                level_db_sl=float(own_levels[number, 0]),
                foreign_level_db_sl=float(foreign_levels[number, 0]),
                contrast_db=contrast if contrast < np.inf else None,
                times=times,
                levels_db_sl=own_levels[number, 1:],
                foreign_levels_db_sl=foreign_levels[number, 1:],
            )
            felt.append(finger)
        return tuple(felt)

    def _contrasts(self, own_levels: FloatArray, foreign_levels: FloatArray) -> FloatArray:
        """Steady contrast of each finger [dB] from its steady levels; inf or nan: none.

        A target compares its own level with its foreign level, or with the loudest quiet finger if
        it has no foreign level. A quiet finger compares the weakest target with its foreign level.
        """
        targets = self._target_numbers
        is_target = np.isin(range(len(own_levels)), targets)
        loudest_quiet = foreign_levels[~is_target].max(initial=-np.inf)
        signal = np.where(is_target, own_levels, own_levels[targets].min())
        disturbance = np.where(foreign_levels > -np.inf, foreign_levels, loudest_quiet)
        with np.errstate(invalid="ignore"):  # silence has no contrast to silence
            return np.asarray(signal - disturbance)

    @property
    def level_db_sl(self) -> float:
        """Steady level of a target's own layers [dB SL], mean over its fingertip; minimum over
        targets."""
        return min([self.fingers[number].level_db_sl for number in self._target_numbers])

    @property
    def quiet_level_db_sl(self) -> float | None:
        """Steady level at the loudest quiet point [dB SL]; None without a quiet finger."""
        levels = [self.fingers[number].foreign_level_db_sl for number in self._quiet_numbers]
        return max(levels, default=None)

    @property
    def contrast_db(self) -> float | None:
        """Lowest steady contrast of all fingers [dB]; None for a single finger."""
        contrasts = []
        for finger in self.fingers:
            if finger.contrast_db is not None:
                contrasts.append(finger.contrast_db)
        return min(contrasts, default=None)

    @property
    def transient_contrast_db(self) -> float | None:
        """Contrast [dB] between the peaks at targets and at quiet fingers over the first 100 ms;
        None without quiet fingers."""
        if not self.quiet or self.contrast_db is None:
            return None
        is_onset = self.records[0].times <= ONSET_WINDOW
        weights = [record.weights for record in self.targets]
        target_peaks = [_onset_peaks(record, is_onset) for record in self.targets]
        quiet_peaks = [_onset_peaks(record, is_onset) for record in self.quiet]
        return float(contrast_db(target_peaks, np.concatenate(quiet_peaks), weights))

    @property
    def _window(self) -> tuple[int, int]:
        """Number of samples of a level's window, and between windows."""
        times = self.records[0].times
        rate = (len(times) - 1) / (times[-1] - times[0])
        count = min(round(LEVEL_WINDOW * rate), len(times))
        return count, round(LEVEL_STEP * rate)

    def _levels(self, number: int) -> tuple[FloatArray, FloatArray]:
        """Levels (1 + w,) of a finger's own layers and of all others: steady, then over time."""
        powers_by_layer = []
        for vibration in self.vibrations:
            record = vibration.records[number]
            powers_by_layer.append(self._powers(record, vibration.all_frequencies))
        powers = np.array(powers_by_layer)
        is_own = np.array([number in vibration.fingers for vibration in self.vibrations])
        own_amplitude = np.sqrt(powers[is_own].sum(axis=0))
        foreign_amplitude = np.sqrt(powers[~is_own].sum(axis=0))
        own_level = decibels(own_amplitude @ self.records[number].weights)
        foreign_level = decibels(foreign_amplitude.max(axis=-1))
        return own_level, foreign_level

    def _powers(self, record: FingerRecord, frequencies: Sequence[float]) -> FloatArray:
        """Power to threshold at the points of a finger (1 + w, p): steady, then over time."""
        times = record.times
        sample_rate = 1 / (times[1] - times[0])
        felt = over_threshold(record.accelerations, sample_rate, self.threshold)
        is_steady = times >= max(self.settled, times[-1] - STEADY)
        if frequencies:
            steady = self._power_of_tones(record, is_steady, frequencies)
        else:
            steady = _power_of_signals(felt[is_steady])
        count, step = self._window
        weights = _hann(count)
        power = sliding_window_view(felt**2, count, axis=0)[::step] @ weights
        # The power of a tone is its squared amplitude, twice its mean square.
        return np.vstack([steady, 2 * power / weights.sum()])

    def _power_of_tones(
        self, record: FingerRecord, is_steady: NDArray[np.bool_], frequencies: Sequence[float]
    ) -> FloatArray:
        """Steady power to threshold (p,) of the tones that are fitted to a record."""
        times = record.times[is_steady]
        amplitudes = np.abs(fit_tones(times, record.accelerations[is_steady], frequencies))
        level = sensation_level(np.array(frequencies), amplitudes, self.threshold)
        return np.asarray(10 ** (level / 10))


def _power_of_signals(felt: FloatArray) -> FloatArray:
    """Power (p,) of samples (n, p) relative to the threshold, under a Hann window."""
    weights = _hann(len(felt))
    return np.asarray(2 * weights @ felt**2 / weights.sum())


def _hann(count: int) -> FloatArray:
    """A Hann window of this number of samples, without zeros at its ends."""
    return np.hanning(count + 2)[1:-1]


def _onset_peaks(record: FingerRecord, is_onset: NDArray[np.bool_]) -> FloatArray:
    """Peaks (p,) of a record during the onset."""
    return felt_peaks(record.times[is_onset], record.accelerations[is_onset])
