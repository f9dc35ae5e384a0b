"""Play layers on the plate in the time domain, without wires and amplifiers.

From rest the bases move exactly as commanded, along shaped onsets or a ramp. The plate is linear:
each layer is played alone, which separates a finger's own layers from other fingers' layers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from model.answer.answer import Layer
from model.answer.stimulus import Finger, check_fingers
from model.arrays import FloatArray
from model.errors import InputError
from model.files.csv_file import as_frame
from model.finger import (
    DEFAULT_THRESHOLD,
    contrast_db,
    decibels,
    fingertip_points,
    fingertip_weights,
    over_threshold,
    sensation_level,
)
from model.quantities import counted
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Rig
from model.structure.attachments import Source
from model.transients.base_motion import Bases, ramped_onset, shaped
from model.transients.shaping import ONSET_WINDOW
from model.transients.time_response import from_rest
from model.vibration import base_amplitudes
from sim.plant import imperfections
from sim.plant.fingers import FingerRecord, felt_peaks, fit_tones
from sim.plant.imperfections import Imperfections, realised
from sim.plant.plant import PLANT_SAMPLE_RATE, LoadedPlate, Plant

STEADY = 0.25
"""Length [s] of the final window for fitting steady amplitudes; resolves 10 Hz."""

LEVEL_WINDOW, LEVEL_STEP = 0.03, 0.005
"""Length and step [s] of the Hann window for the RMS level over time."""

_RINGING = 3.0
"""Settling time in time constants of the slowest vibration: 5 % of its start remain."""

_MIN_DURATION = 1.0
"""Default playback time [s], unless the plate rings longer."""

MIN_SIGNAL = 0.01
"""Shortest signals [s]; shorter ones are followed by zeros."""

_MAX_DURATION = 10.0
"""Longest playback [s]; ten fingers take 150 MB for each layer."""


@dataclass(frozen=True, eq=False)
class FeltFinger:
    """Vibration felt by a finger during playback, steady and over time; without promises.

    level_db_sl: level of its own layers, mean over the fingertip; foreign_level_db_sl: level of all
    other layers at its loudest point; both -inf without layers. levels_db_sl, foreign_levels_db_sl
    (w,): RMS levels under a Hann window of 30 ms, at times (w,) [s]. All levels are relative to the
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

    frequencies (f,) [Hz], empty for signals; fingers: indices of its targets; records: of all
    fingers in order; harmonics (f,) [Hz]: of ERAs with harmonics.
    """

    frequencies: tuple[float, ...]
    fingers: tuple[int, ...]
    records: tuple[FingerRecord, ...]
    harmonics: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class PlatePlayback:
    """Records of fingertips while layers played, from rest at time 0.

    vibrations: each layer alone; a finger without a layer is quiet; settled [s]: end of the onsets;
    threshold: of levels and contrasts, by one set, where answers have the least over several.
    Steady measures are fitted to the last 0.25 s, after the plate has settled, which `play` sees
    to; those of signals are of the power in these, settled or not.
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
        fingers = {"target": self.targets, "quiet": self.quiet}
        means = {
            f"{name}_{number}_m_s2": record.accelerations @ record.weights
            for name, records in fingers.items()
            for number, record in enumerate(records, start=1)
        }
        return as_frame({"time_s": self.records[0].times, **means})

    @property
    def frequencies(self) -> tuple[float, ...]:
        """Driven frequencies [Hz], ascending."""
        return tuple(sorted({each for one in self.vibrations for each in one.frequencies}))

    @cached_property
    def records(self) -> tuple[FingerRecord, ...]:
        """Record of each finger with all layers playing, in the given order of fingers."""
        return tuple(
            replace(alone[0], accelerations=np.sum([one.accelerations for one in alone], axis=0))
            for alone in zip(*[each.records for each in self.vibrations], strict=True)
        )

    @property
    def targets(self) -> tuple[FingerRecord, ...]:
        """Records of the fingers with a layer."""
        return tuple([self.records[number] for number in self._own])

    @property
    def quiet(self) -> tuple[FingerRecord, ...]:
        """Records of the fingers without a layer."""
        return tuple([each for number, each in enumerate(self.records) if number not in self._own])

    @property
    def _own(self) -> list[int]:
        """Indices of the fingers with a layer, ascending."""
        return sorted({number for each in self.vibrations for number in each.fingers})

    @cached_property
    def fingers(self) -> tuple[FeltFinger, ...]:
        """Vibration felt by each finger, in the given order."""
        numbers, (count, step), own = range(len(self.records)), self._window, self._own
        levels = np.array([self._levels(number) for number in numbers])
        mine, others = levels[:, :, 0].T
        has_own = np.isin(numbers, own)
        loudest = others[~has_own].max(initial=-np.inf)
        above = np.where(has_own, mine, mine[own].min())
        with np.errstate(invalid="ignore"):  # of silence to silence, which has no contrast
            contrasts = above - np.where(others > -np.inf, others, loudest)
        times = self.records[0].times[count // 2 :: step][: levels.shape[2] - 1]
        return tuple(
            FeltFinger(
                float(each[0, 0]),
                float(each[1, 0]),
                float(contrast) if contrast < np.inf else None,
                times,
                *each[:, 1:],
            )
            for each, contrast in zip(levels, contrasts, strict=True)
        )

    @property
    def level_db_sl(self) -> float:
        """Steady level of a target's own layers [dB SL], mean over its fingertip; minimum over
        targets."""
        return min([self.fingers[number].level_db_sl for number in self._own])

    @property
    def quiet_level_db_sl(self) -> float | None:
        """Steady level at the loudest quiet point [dB SL]; None without a quiet finger."""
        felt = [each for number, each in enumerate(self.fingers) if number not in self._own]
        return max([each.foreign_level_db_sl for each in felt], default=None)

    @property
    def contrast_db(self) -> float | None:
        """Lowest steady contrast of all fingers [dB]; None for a single finger."""
        found = [each.contrast_db for each in self.fingers if each.contrast_db is not None]
        return min(found, default=None)

    @property
    def transient_contrast_db(self) -> float | None:
        """Contrast [dB] of the peaks over the first 100 ms to quiet fingers; None without quiet
        fingers."""
        targets, quiet = self.targets, self.quiet
        if not quiet or self.contrast_db is None:
            return None
        inside = targets[0].times <= ONSET_WINDOW
        first = [
            felt_peaks(record.times[inside], record.accelerations[inside])
            for record in (*targets, *quiet)
        ]
        count, weights = len(targets), [record.weights for record in targets]
        return float(contrast_db(first[:count], np.concatenate(first[count:]), weights))

    @property
    def _window(self) -> tuple[int, int]:
        """Number of samples of a level's window, and between windows."""
        times = self.records[0].times
        rate = (len(times) - 1) / (times[-1] - times[0])
        return min(round(LEVEL_WINDOW * rate), len(times)), round(LEVEL_STEP * rate)

    def _levels(self, number: int) -> tuple[FloatArray, FloatArray]:
        """Levels (1 + w,) of a finger's own layers and of all others: steady, then over time."""
        powers = np.array(
            [
                self._powers(each.records[number], sorted({*each.frequencies, *each.harmonics}))
                for each in self.vibrations
            ]
        )
        is_own = np.array([number in each.fingers for each in self.vibrations])
        own, others = (np.sqrt(powers[some].sum(axis=0)) for some in (is_own, ~is_own))
        return decibels(own @ self.records[number].weights), decibels(others.max(axis=-1))

    def _powers(self, record: FingerRecord, frequencies: Sequence[float]) -> FloatArray:
        """Power to threshold at the points of a finger (1 + w, p): steady, then over time."""
        times, (count, step) = record.times, self._window
        inside = times >= max(self.settled, times[-1] - STEADY)
        felt = over_threshold(record.accelerations, 1 / (times[1] - times[0]), self.threshold)
        weights = np.hanning(count + 2)[1:-1]
        power = sliding_window_view(felt**2, count, axis=0)[::step] @ weights
        if frequencies:
            fitted = np.abs(fit_tones(times[inside], record.accelerations[inside], frequencies))
            level = sensation_level(np.array(frequencies), fitted, self.threshold)
            steady = 10 ** (level / 10)
        else:
            last = np.hanning(inside.sum() + 2)[1:-1]
            steady = 2 * last @ felt[inside] ** 2 / last.sum()
        # The power of a tone is its squared amplitude, twice its mean square.
        return np.vstack([steady, 2 * power / weights.sum()])


def play(
    rig: Rig,
    reduced: ReducedPlate,
    layers: Sequence[Layer],
    fingers: Sequence[Finger],
    *,
    duration: float | None,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> PlatePlayback:
    """Play layers for a duration [s] on a plate at rest, under fingers, by number in the layers.

    duration: at least the onsets and _RINGING time constants of the slowest vibration (0.2 to 0.9 s
    on the plates of the examples), or _MAX_DURATION; so long, and a second, for None.

    Each finger loads the plate with its load times the rig's fingertip. reduced: the plate that the
    imperfections make of the rig's, for forces at its ERAs and loads. Each layer starts along its
    onset or ramp. Latency, skew and noise are left out. Raises InputError for fingers off the
    plate, layers that the rig cannot play, and a duration out of range.
    """
    check_fingers(fingers, rig.plate)
    shares = {era.name: imperfections.errors_of(era.name, rig).harmonic for era in rig.eras}
    driven = [_bases(layer, rig.eras, shares) for layer in layers]
    terms = [term for bases in driven for motion in bases for term in motion]
    settled = max([term.start for term in terms], default=0.0)  # of the last, which goes on
    loaded = _plant_under(rig, reduced, fingers, imperfections).loaded
    slowest = max(-float(loaded.plate.decay.real.max()), _RINGING / _MAX_DURATION)
    least = min(settled + _RINGING / slowest, _MAX_DURATION)
    if duration is None:
        duration = max(least, _MIN_DURATION)
    if not least <= duration <= _MAX_DURATION:  # false for NaN, too
        raise InputError(
            f"duration must be at least {least:.3g} s, the onset and until the plate rings no "
            f"more, and at most {_MAX_DURATION:g} s, got {duration:g} s; None is long enough"
        )
    points, vibrations = _points(rig, fingers), []
    for layer, bases in zip(layers, driven, strict=True):
        frequencies, _ = base_amplitudes(layer.excitation, rig.eras, *layer.side_bands)
        plant = _plant_under(rig, reduced, fingers, imperfections, loaded)
        for number, (era, motion) in enumerate(zip(rig.eras, bases, strict=True)):
            plant.set_input(number, realised(motion, imperfections.errors_of(era.name, rig)))
        times, felt = plant.advance(
            duration, sample_rate=PLANT_SAMPLE_RATE, shapes=plant.reduced.at(points)
        )
        records = _records(rig, fingers, times, felt)
        driven_at = tuple(frequencies.tolist())
        harmonics = tuple([2 * each for each in driven_at]) if any(shares.values()) else ()
        vibrations.append(Vibration(driven_at, layer.fingers, records, harmonics))
    return PlatePlayback(tuple(vibrations), settled, rig.threshold)


def play_signals(
    rig: Rig,
    reduced: ReducedPlate,
    signals: FloatArray,
    fingers: Sequence[Finger],
    *,
    sample_rate: float,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> PlatePlayback:
    """Play signals (eras, n) in full strokes on a plate at rest, for all fingers with a stimulus.

    Records have the sample rate of the signals [Hz]; otherwise see `play`.
    """
    check_fingers(fingers, rig.plate)
    duration = signals.shape[1] / sample_rate
    if not MIN_SIGNAL <= duration <= _MAX_DURATION:
        raise InputError(
            f"signals must last from {MIN_SIGNAL:g} to {_MAX_DURATION:g} s, got {duration:g} s"
        )
    plant = _plant_under(rig, reduced, fingers, imperfections)
    felt = from_rest(
        plant.loaded.plate,
        signals,
        plant.reduced.at(_points(rig, fingers)),
        sample_rate=sample_rate,
        factors=imperfections.factors(rig),
    )
    records = _records(rig, fingers, np.arange(len(felt)) / sample_rate, felt)
    own = tuple([number for number, each in enumerate(fingers) if each.stimulus])
    return PlatePlayback((Vibration((), own, records),), 0.0, rig.threshold)


def _plant_under(
    rig: Rig,
    reduced: ReducedPlate,
    fingers: Sequence[Finger],
    imperfections: Imperfections,
    loaded: LoadedPlate | None = None,
) -> Plant:
    """The plate at rest under fingers; loaded: if already solved."""
    plant = Plant(reduced, imperfections.plate.realised(rig).eras, loads=rig.masses)
    resting = imperfections.resting(rig, fingers)
    plant.set_contacts({str(n): each for n, each in enumerate(resting)}, loaded=loaded)
    return plant


def _points(rig: Rig, fingers: Sequence[Finger]) -> FloatArray:
    """Points (p, 2) of all fingertips, in order."""
    return np.concatenate([fingertip_points(*each.at, rig.plate) for each in fingers])


def _records(
    rig: Rig, fingers: Sequence[Finger], times: FloatArray, felt: FloatArray
) -> tuple[FingerRecord, ...]:
    """Accelerations (n, p) at the points of all fingertips as a record of each finger."""
    plate, split = rig.plate, np.split(felt, len(fingers), axis=1)
    return tuple(
        FingerRecord(
            fingertip_points(*each.at, plate), fingertip_weights(*each.at, plate), times, part
        )
        for each, part in zip(fingers, split, strict=True)
    )


def _bases(layer: Layer, eras: Sequence[Source], harmonics: Mapping[str, complex]) -> Bases:
    """Motion of the bases when a layer starts, its side bands included.

    harmonics: second harmonic of each ERA, relative to its motion, by name.
    """
    voices = [
        shaped(each.onset, eras)
        if each.onset
        else ramped_onset(each.excitation, eras, ramp=each.ramp)
        for each in (*layer.voices, *imperfections.of_layer(layer, harmonics))
    ]
    return tuple(tuple(chain.from_iterable(each)) for each in zip(*voices, strict=True))
