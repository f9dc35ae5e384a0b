"""Play layers on the plate in the time domain, without wires and amplifiers.

From rest the bases move exactly as commanded, along shaped onsets or a ramp. The plate is linear:
each frequency of each layer is played alone, which keeps a finger's own apart from those of others.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from model.answer.answer import Layer
from model.answer.fingers import Finger, check_fingers
from model.arrays import FloatArray
from model.counting import counted
from model.errors import InputError
from model.files.csv_file import as_frame
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import (
    DEFAULT_THRESHOLD,
    contrast_db,
    decibels,
    detection_threshold,
)
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Rig
from model.structure.attachments import Era, fingertip_loads
from model.transients.base_motion import Bases, ramped_onset, shaped
from model.transients.measures import ONSET_WINDOW
from model.vibration.excitation import base_amplitudes, by_frequency
from sim.plant.fingers import Record, felt_peaks, fit_tones
from sim.plant.imperfections import Imperfections, realised
from sim.plant.plant import SAMPLE_RATE, Plant

STEADY = 0.25
"""Length [s] of the last part, in which steady amplitudes are fitted."""

LEVEL_WINDOW, LEVEL_STEP = 0.03, 0.005
"""Hann window under which a level over time is a root mean square, and the steps of both [s]."""

MAX_DURATION = 10.0
"""Longest playback [s]; ten fingers take 150 MB for each frequency of a layer."""


@dataclass(frozen=True, eq=False)
class FeltFinger:
    """What one finger felt, steady as of a `Sensation`, and over time.

    level_db_sl: of its own layers, mean over the fingertip, -inf without one; foreign_level_db_sl:
    of all others at its loudest point, None without one; contrast_db: of its own above these, or
    where there are no others above its own at the loudest quiet finger; of a quiet finger the
    weakest level at another one's own finger above all of them here. times (w,) [s], and at these
    levels_db_sl and foreign_levels_db_sl (w,): root mean square under a Hann window of 30 ms.
    """

    level_db_sl: float
    foreign_level_db_sl: float | None
    contrast_db: float | None
    times: FloatArray
    levels_db_sl: FloatArray
    foreign_levels_db_sl: FloatArray

    def __repr__(self) -> str:
        contrast = "alone" if self.contrast_db is None else f"contrast {self.contrast_db:.1f} dB"
        return f"<FeltFinger at {self.level_db_sl:.1f} dB SL, {contrast}>"

    def to_frame(self) -> Any:
        """Time, its own level and that of the others as a pandas DataFrame; needs pandas."""
        return as_frame(
            {
                "time_s": self.times,
                "level_db_sl": self.levels_db_sl,
                "foreign_level_db_sl": self.foreign_levels_db_sl,
            }
        )


@dataclass(frozen=True, eq=False)
class Vibration:
    """One frequency [Hz] of a layer, by number, and the records of all fingers under it alone."""

    layer: int
    frequency: float
    records: tuple[Record, ...]


@dataclass(frozen=True, eq=False)
class Playback:
    """Records of fingertips while layers played, from rest at time 0.

    vibrations: each frequency of each layer alone; own: of each finger the numbers of the layers
    that are for it, none of a quiet one; settled [s]: end of the onsets; threshold: name of the set
    that levels are above. Measures are named as those of a `Sensation`; steady ones are fitted to
    the last STEADY seconds, after the plate has settled (50 ms to 1 s).
    """

    vibrations: tuple[Vibration, ...]
    own: tuple[tuple[int, ...], ...]
    settled: float
    threshold: str = DEFAULT_THRESHOLD

    def __repr__(self) -> str:
        driven = ", ".join(f"{frequency:g}" for frequency in self.frequencies)
        felt = f"{counted(len(self.targets), 'target')} and {len(self.quiet)} quiet"
        return f"<Playback of {driven} Hz for {self.targets[0].times[-1]:g} s at {felt}>"

    def to_frame(self) -> Any:
        """Time and mean acceleration of each fingertip as a pandas DataFrame; needs pandas."""
        fingers = {"target": self.targets, "quiet": self.quiet}
        means = {
            f"{name}_{number}_m_s2": record.accelerations @ record.weights
            for name, records in fingers.items()
            for number, record in enumerate(records, start=1)
        }
        return as_frame({"time_s": self.vibrations[0].records[0].times, **means})

    @property
    def frequencies(self) -> tuple[float, ...]:
        """Frequencies that are driven [Hz], ascending."""
        return tuple(sorted({each.frequency for each in self.vibrations}))

    @cached_property
    def records(self) -> tuple[Record, ...]:
        """Of each finger, of all layers together, in the order in which they were given."""
        return tuple(
            replace(alone[0], accelerations=np.sum([one.accelerations for one in alone], axis=0))
            for alone in zip(*[each.records for each in self.vibrations], strict=True)
        )

    @property
    def targets(self) -> tuple[Record, ...]:
        """Records of the fingers that have a layer."""
        return tuple(each for each, own in zip(self.records, self.own, strict=True) if own)

    @property
    def quiet(self) -> tuple[Record, ...]:
        """Records of the fingers that have none."""
        return tuple(each for each, own in zip(self.records, self.own, strict=True) if not own)

    @cached_property
    def fingers(self) -> tuple[FeltFinger, ...]:
        """What each finger felt, in the order in which they were given."""
        found, steady = [], self._steady
        for number, (level, foreign) in enumerate(steady):
            others = foreign if foreign > -np.inf else self.quiet_level_db_sl
            above = level if self.own[number] else self.level_db_sl
            found.append(
                FeltFinger(
                    level,
                    foreign if foreign > -np.inf else None,
                    None if others is None else above - others,
                    *self._over_time(number),
                )
            )
        return tuple(found)

    @property
    def level_db_sl(self) -> float:
        """Steady level of a target's own [dB SL], mean over its fingertip; minimum over targets."""
        return min(level for (level, _), own in zip(self._steady, self.own, strict=True) if own)

    @property
    def quiet_level_db_sl(self) -> float | None:
        """Steady level at the loudest quiet point [dB SL]; None where a finger is alone."""
        quiet = [level for (_, level), own in zip(self._steady, self.own, strict=True) if not own]
        return max(quiet, default=None)

    @property
    def contrast_db(self) -> float | None:
        """The least steady contrast of all fingers [dB]; None if alone."""
        found = [each.contrast_db for each in self.fingers if each.contrast_db is not None]
        return min(found, default=None)

    @property
    def transient_contrast_db(self) -> float | None:
        """Contrast [dB] of the peaks over the first 100 ms to quiet fingers; None without these."""
        targets, quiet = self.targets, self.quiet
        if not quiet:
            return None
        inside = targets[0].times <= ONSET_WINDOW
        first = [
            felt_peaks(record.times[inside], record.accelerations[inside])
            for record in (*targets, *quiet)
        ]
        count, weights = len(targets), [record.weights for record in targets]
        return float(contrast_db(first[:count], np.concatenate(first[count:]), weights))

    @cached_property
    def _steady(self) -> tuple[tuple[float, float], ...]:
        """Steady level of each finger's own layers, and of all others at its loudest point."""
        times = self.vibrations[0].records[0].times
        inside = times >= max(self.settled, times[-1] - STEADY)
        found = []
        for number in range(len(self.own)):
            powers = []
            for each in self.vibrations:
                samples = each.records[number].accelerations[inside] / self._threshold_of(each)
                fitted = fit_tones(times[inside] - times[0], samples, [each.frequency])
                powers.append((each.layer, np.abs(fitted[0]) ** 2))
            own, others = self._levels(number, powers)
            found.append((float(own), float(others)))
        return tuple(found)

    def _over_time(self, number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times (w,) [s], and at these levels of a finger's own layers and of all others (w,)."""
        times, signals = self.vibrations[0].records[0].times, dict[int, FloatArray]()
        for each in self.vibrations:
            samples = each.records[number].accelerations / self._threshold_of(each)
            signals[each.layer] = signals.get(each.layer, 0) + samples
        count, step = (round(each * SAMPLE_RATE) for each in (LEVEL_WINDOW, LEVEL_STEP))
        count = min(count, len(times))
        weights = np.hanning(count + 2)[1:-1]
        powers = [
            (layer, sliding_window_view(each**2, count, axis=0)[::step] @ (2 * weights))
            for layer, each in signals.items()
        ]
        means = [(layer, power / weights.sum()) for layer, power in powers]
        own, others = self._levels(number, means)
        return times[count // 2 :][: len(own) * step : step], own, others

    def _levels(
        self, number: int, powers: Sequence[tuple[int, FloatArray]]
    ) -> tuple[FloatArray, FloatArray]:
        """Levels of a finger's own layers and of all others, from powers (..., p) of each layer."""
        record, both = self.records[number], [0 * powers[0][1], 0 * powers[0][1]]
        for layer, power in powers:
            both[layer in self.own[number]] += power
        others, own = np.sqrt(both)
        return decibels(own @ record.weights), decibels(others.max(axis=-1))

    def _threshold_of(self, vibration: Vibration) -> float:
        return float(detection_threshold(np.array(vibration.frequency), self.threshold))


def play(
    rig: Rig,
    reduced: ReducedPlate,
    layers: Sequence[Layer],
    fingers: Sequence[Finger],
    own: Sequence[tuple[int, ...]] | None = None,
    *,
    duration: float,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> Playback:
    """Play layers for a duration [s] on a plate at rest, under these fingers.

    The fingers load the plate as the rig's fingertip, by their loads; own: of each the numbers of
    the layers for it, by default all where it has a stimulus. reduced: the plate that the imperfections make of the rig's, for forces at
    its ERAs and loads. Each layer starts along its onset, or its ramp. Latency, skew and noise are
    left out. Raises InputError for fingers off the plate, layers that the rig cannot play, and a
    duration out of range.
    """
    check_fingers(fingers, rig.plate)
    if own is None:
        every = tuple(range(len(layers)))
        own = [every if each.stimulus else () for each in fingers]
    voices = [(number, each) for number, one in enumerate(layers) for each in one.voices]
    ends = [0.0]
    for _, each in voices:
        base_amplitudes(each.excitation, rig.eras)  # refuses ERAs that the rig does not have
        onsets = each.onset.values() if each.onset else ()
        ends.append(max([envelope.duration for envelope in onsets], default=each.ramp))
    settled = max(ends)
    if not settled < duration <= MAX_DURATION:  # false for NaN, too
        raise InputError(
            f"duration must be above {settled:g} s (the onset) and at most {MAX_DURATION:g} s, got "
            f"{duration:g} s; one second suffices for most plates"
        )
    contacts = [each.at for each in fingers]
    resting = fingertip_loads(rig.fingertip, contacts, [each.load for each in fingers])
    loads = {
        str(n): replace(each, fingertip=imperfections.load_of(str(n), each.fingertip))
        for n, each in enumerate(resting)
    }
    discs = [fingertip_points(*at, rig.plate) for at in contacts]
    weights = [fingertip_weights(*at, rig.plate) for at in contacts]
    splits, loaded = np.cumsum([len(disc) for disc in discs])[:-1], None
    vibrations = []
    for number, frequency, bases in _parts(voices, rig.eras):
        plant = Plant(reduced, imperfections.plate.realised(rig).eras, loads=rig.masses)
        plant.set_contacts(loads, loaded=loaded)
        loaded = plant.loaded
        for at, (era, terms) in enumerate(zip(rig.eras, bases, strict=True)):
            plant.set_input(at, realised(terms, imperfections.errors_of(era.name, rig)))
        shapes = plant.reduced.at(np.concatenate(discs))
        times, felt = plant.advance(duration, sample_rate=SAMPLE_RATE, shapes=shapes)
        parts = np.split(felt, splits, axis=1)
        records = [Record(*each) for each in zip(discs, weights, [times] * len(discs), parts)]
        vibrations.append(Vibration(number, frequency, tuple(records)))
    return Playback(tuple(vibrations), tuple(own), settled, rig.threshold)


def _parts(
    voices: Sequence[tuple[int, Layer]], eras: Sequence[Era]
) -> Iterator[tuple[int, float, Bases]]:
    """Layer, frequency [Hz] and motion of the bases of each frequency of each voice."""
    for number, layer in voices:
        for frequency, tones in by_frequency(layer.excitation):
            if layer.onset:
                envelopes = layer.onset.items()
                own = {name: each for name, each in envelopes if each.frequency == frequency}
                yield number, frequency, shaped(own, eras)
            else:
                yield number, frequency, ramped_onset(tones, eras, ramp=layer.ramp)
