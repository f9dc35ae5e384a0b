"""Play an excitation on the plate in the time domain, without wires and amplifiers.

From rest the bases move exactly as commanded, along shaped onsets or a ramp.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from model.answer.fingers import Placement, Stimulus, check_fingers, together
from model.answer.over_duration import ONSET_RAMP
from model.arrays import FloatArray
from model.counting import counted
from model.errors import InputError
from model.files.csv_file import as_frame
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import (
    DEFAULT_THRESHOLD,
    contrast_db,
    mean_level_db_sl,
    sensation_level,
)
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Rig
from model.transients.base_motion import Envelopes, ramped_onset, shaped
from model.transients.from_rest import from_rest
from model.transients.measures import ONSET_WINDOW
from model.vibration.excitation import Excitation, base_amplitudes
from sim.plant.fingers import Felt, Record, felt_peaks, measure_vibration
from sim.plant.imperfections import Imperfections, realised
from sim.plant.plant import SAMPLE_RATE, Plant

STEADY = 0.25
"""Length [s] of the last part, in which steady amplitudes are fitted; resolves 10 Hz."""

MIN_SIGNAL = 0.01
"""Shortest signals [s]; shorter ones are followed by zeros."""

MAX_DURATION = 10.0
"""Longest playback [s]; ten fingers take 150 MB."""


@dataclass(frozen=True, eq=False)
class Playback:
    """Records of fingertips while an excitation played, from rest at time 0.

    frequencies (f,) [Hz]: driven; targets, quiet: records of the fingers; settled [s]: end of the
    onset; threshold: name of the set that levels are above. Measures are named as those of a
    `Sensation`; steady ones are fitted to the last STEADY seconds, after the plate has settled
    (50 ms to 1 s). is_of_signals: whether these are tapered first, so that what is between the
    frequencies does not leak.
    """

    frequencies: tuple[float, ...]
    targets: tuple[Record, ...]
    quiet: tuple[Record, ...]
    settled: float
    threshold: str = DEFAULT_THRESHOLD
    is_of_signals: bool = False

    def __repr__(self) -> str:
        named = [f"{frequency:g}" for frequency in self.frequencies]
        driven = ", ".join(named) if len(named) < 9 else f"{named[0]} to {named[-1]}"
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
        return as_frame({"time_s": self.targets[0].times, **means})

    @property
    def level_db_sl(self) -> float:
        """Steady level at the target [dB SL], mean over its fingertip; minimum over targets."""
        return min(
            mean_level_db_sl(*_tones(felt), felt.weights, self.threshold)
            for felt in self._felt[: len(self.targets)]
        )

    @property
    def quiet_level_db_sl(self) -> float | None:
        """Steady level at the loudest quiet point [dB SL]; None where a finger is alone."""
        quiet = self._felt[len(self.targets) :]
        loudest = [sensation_level(*_tones(felt), self.threshold).max() for felt in quiet]
        return float(max(loudest)) if loudest else None

    @property
    def contrast_db(self) -> float | None:
        """Steady level of the target above that of the loudest quiet point [dB]; None if alone."""
        quiet = self.quiet_level_db_sl
        return None if quiet is None else self.level_db_sl - quiet

    @property
    def transient_contrast_db(self) -> float | None:
        """Contrast [dB] of the peaks over the first 100 ms; None where a finger is alone."""
        inside = self.targets[0].times <= ONSET_WINDOW
        first = [
            felt_peaks(record.times[inside], record.accelerations[inside])
            for record in (*self.targets, *self.quiet)
        ]
        return self._contrast(first)

    def _contrast(self, peaks: list[FloatArray]) -> float | None:
        count = len(self.targets)
        if len(peaks) == count:
            return None
        weights = [record.weights for record in self.targets]
        return float(contrast_db(peaks[:count], np.concatenate(peaks[count:]), weights))

    @cached_property
    def _felt(self) -> tuple[Felt, ...]:
        """Steady vibration of each finger, targets first."""
        return tuple(
            measure_vibration(self._last(record), self.frequencies)
            for record in (*self.targets, *self.quiet)
        )

    def _last(self, record: Record) -> Record:
        since = max(self.settled, record.times[-1] - STEADY)
        inside = record.times >= since
        times, accelerations = record.times[inside], record.accelerations[inside]
        if self.is_of_signals:
            accelerations = accelerations * _taper(len(times))[:, None]
        return Record(record.points, record.weights, times, accelerations)


def play(
    rig: Rig,
    reduced: ReducedPlate,
    excitation: Excitation,
    fingers: Placement,
    *,
    duration: float,
    ramp: float = ONSET_RAMP,
    onset: Envelopes | None = None,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> Playback:
    """Play an excitation for a duration [s] on a plate at rest, under these fingers.

    The fingers load the plate as the rig's fingertip, by their loads. reduced: the plate that the
    imperfections make of the rig's, for forces at its ERAs and loads; ramp [s], or onset in its
    place. Latency, skew and noise are left out. Raises InputError for fingers off the plate, an
    excitation that the rig cannot play, and a duration out of range.
    """
    check_fingers(together(fingers, Stimulus()), rig.plate)
    frequencies, _ = base_amplitudes(excitation, rig.eras)
    settled = max(envelope.duration for envelope in onset.values()) if onset else ramp
    if not settled < duration <= MAX_DURATION:  # false for NaN, too
        raise InputError(
            f"duration must be above {settled:g} s (the onset) and at most {MAX_DURATION:g} s, got "
            f"{duration:g} s; one second suffices for most plates"
        )
    plant, discs = _touched(rig, reduced, fingers, imperfections)
    bases = shaped(onset, rig.eras) if onset else ramped_onset(excitation, rig.eras, ramp=ramp)
    for number, (era, terms) in enumerate(zip(rig.eras, bases, strict=True)):
        plant.set_input(number, realised(terms, imperfections.errors_of(era.name, rig)))
    times, felt = plant.advance(
        duration, sample_rate=SAMPLE_RATE, shapes=plant.reduced.at(np.concatenate(discs))
    )
    return _recorded(rig, fingers, discs, times, felt, frequencies, settled=settled)


def play_signals(
    rig: Rig,
    reduced: ReducedPlate,
    signals: FloatArray,
    fingers: Placement,
    *,
    sample_rate: float,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> Playback:
    """Play signals (eras, n) in full strokes on a plate at rest; the rest as of `play`.

    Records have the signals' samples. Steady measures are those of all frequencies within the rig's
    limits, as far as the last STEADY seconds resolve them.
    """
    check_fingers(together(fingers, Stimulus()), rig.plate)
    duration = signals.shape[1] / sample_rate
    if not MIN_SIGNAL <= duration <= MAX_DURATION:
        raise InputError(
            f"signals must last from {MIN_SIGNAL:g} to {MAX_DURATION:g} s, got {duration:g} s"
        )
    plant, discs = _touched(rig, reduced, fingers, imperfections)
    felt = from_rest(
        plant.loaded.plate,
        signals,
        plant.reduced.at(np.concatenate(discs)),
        sample_rate=sample_rate,
        factors=np.array([imperfections.errors_of(era.name, rig).factor for era in rig.eras]),
    )
    times, step = np.arange(len(felt)) / sample_rate, 1 / min(duration, STEADY)
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    frequencies = step * np.arange(max(1, math.floor(low / step)), math.ceil(high / step) + 1)
    found = _recorded(rig, fingers, discs, times, felt, frequencies, settled=0.0)
    return replace(found, is_of_signals=True)


def _touched(
    rig: Rig, reduced: ReducedPlate, fingers: Placement, imperfections: Imperfections
) -> tuple[Plant, list[FloatArray]]:
    """The plate at rest under fingers, and the points of each fingertip."""
    plant = Plant(reduced, imperfections.plate.realised(rig).eras, loads=rig.masses)
    resting = imperfections.resting(rig, fingers.contacts, fingers.loads)
    plant.set_contacts({str(n): each for n, each in enumerate(resting)})
    return plant, [fingertip_points(*at, rig.plate) for at in fingers.contacts]


def _recorded(
    rig: Rig,
    fingers: Placement,
    discs: list[FloatArray],
    times: FloatArray,
    felt: FloatArray,
    frequencies: FloatArray,
    *,
    settled: float,
) -> Playback:
    """The accelerations (n, points) as records of each finger."""
    ends = np.cumsum([len(disc) for disc in discs])[:-1]
    records = tuple(
        Record(disc, fingertip_weights(*at, rig.plate), times, part)
        for at, disc, part in zip(
            fingers.contacts, discs, np.split(felt, ends, axis=1), strict=True
        )
    )
    count = len(fingers.targets)
    return Playback(
        tuple(frequencies.tolist()), records[:count], records[count:], settled, rig.threshold
    )


def _taper(count: int) -> FloatArray:
    """Hann's window (count,) of mean square 1, which keeps the power of a steady vibration."""
    return np.asarray(math.sqrt(8 / 3) * np.hanning(count + 2)[1:-1])


def _tones(felt: Felt) -> tuple[FloatArray, FloatArray]:
    """Frequencies (f,) [Hz] and steady amplitudes (f, p) [m/s²]."""
    return np.array(felt.frequencies), felt.amplitude
