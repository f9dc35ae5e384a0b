"""Play an excitation on the plate in the time domain, without wires and amplifiers.

From rest the bases move exactly as commanded, along shaped onsets or a ramp.
"""

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
from model.structure.attachments import fingertip_loads
from model.transients.base_motion import Envelopes, ramped_onset, shaped
from model.transients.measures import ONSET_WINDOW
from model.vibration.excitation import Excitation, base_amplitudes
from sim.plant.fingers import Felt, Record, felt_peaks, measure_vibration
from sim.plant.imperfections import Imperfections, realised
from sim.plant.plant import SAMPLE_RATE, Plant

STEADY = 0.25
"""Length [s] of the last part, in which steady amplitudes are fitted; resolves 10 Hz."""

MAX_DURATION = 10.0
"""Longest playback [s]; ten fingers take 150 MB."""


@dataclass(frozen=True, eq=False)
class Playback:
    """Records of fingertips while an excitation played, from rest at time 0.

    frequencies (f,) [Hz]: driven; targets, quiet: records of the fingers; settled [s]: end of the
    onset; threshold: name of the set that levels are above. Measures are named as those of a
    `Sensation`; steady ones are fitted to the last STEADY seconds, after the plate has settled
    (50 ms to 1 s).
    """

    frequencies: tuple[float, ...]
    targets: tuple[Record, ...]
    quiet: tuple[Record, ...]
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
    plant = Plant(reduced, imperfections.plate.realised(rig).eras, loads=rig.masses)
    contacts = fingers.contacts
    resting = fingertip_loads(rig.fingertip, contacts, fingers.loads)
    plant.set_contacts(
        {
            str(n): replace(each, fingertip=imperfections.load_of(str(n), each.fingertip))
            for n, each in enumerate(resting)
        }
    )
    bases = shaped(onset, rig.eras) if onset else ramped_onset(excitation, rig.eras, ramp=ramp)
    for number, (era, terms) in enumerate(zip(rig.eras, bases, strict=True)):
        plant.set_input(number, realised(terms, imperfections.errors_of(era.name, rig)))
    discs = [fingertip_points(*at, rig.plate) for at in contacts]
    times, felt = plant.advance(
        duration, sample_rate=SAMPLE_RATE, shapes=plant.reduced.at(np.concatenate(discs))
    )
    ends = np.cumsum([len(disc) for disc in discs])[:-1]
    records = tuple(
        Record(disc, fingertip_weights(*at, rig.plate), times, part)
        for at, disc, part in zip(contacts, discs, np.split(felt, ends, axis=1), strict=True)
    )
    count = len(fingers.targets)
    return Playback(
        tuple(frequencies.tolist()), records[:count], records[count:], settled, rig.threshold
    )


def _tones(felt: Felt) -> tuple[FloatArray, FloatArray]:
    """Frequencies (f,) [Hz] and steady amplitudes (f, p) [m/s²]."""
    return np.array(felt.frequencies), felt.amplitude
