"""Play layers on the plate in the time domain, without wires and amplifiers.

From rest the bases move exactly as commanded, along shaped onsets or a ramp.
"""

from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np

from model.answer.answer import Layer
from model.answer.stimulus import Finger, check_fingers
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import fingertip_points, fingertip_weights
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Rig
from model.structure.sources import Source
from model.transients.base_motion import Bases, ramped_onset, shaped
from model.transients.sampled_response import from_rest
from model.vibration import base_amplitudes
from sim.plant.era_motions import harmonics_of_layer, realised
from sim.plant.fingers import FingerRecord
from sim.plant.imperfections import Imperfections
from sim.plant.loaded_plate import LoadedPlate
from sim.plant.plant import PLANT_SAMPLE_RATE, Plant
from sim.plant.plate_playback import PlatePlayback, Vibration

_RINGING = 3.0
"""Settling time in time constants of the slowest vibration: 5 % of its start remain."""

_MIN_DURATION = 1.0
"""Default playback time [s], unless the plate rings longer."""

MIN_SIGNAL = 0.01
"""Shortest signals [s]; shorter ones are followed by zeros."""

_MAX_DURATION = 10.0
"""Longest playback [s]; ten fingers take 150 MB for each layer."""


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
    on the plates of the examples), or _MAX_DURATION; None: this minimum, and at least 1 s.

    Each finger loads the plate with its load times the rig's fingertip. reduced: the rig's plate
    with the imperfections, reduced for forces at its ERAs and loads. Each layer starts along its
    onset or ramp. Latency, skew and noise are left out. Raises InputError for fingers off the
    plate, layers that the rig cannot play, and a duration out of range.
    """
    check_fingers(fingers, rig.plate)
    harmonics = {era.name: imperfections.errors_of(era.name, rig).harmonic for era in rig.eras}
    bases_by_layer = [_bases(layer, rig.eras, harmonics) for layer in layers]
    settled = _last_start(bases_by_layer)
    loaded = _plant_under(rig, reduced, fingers, imperfections).loaded
    duration = _playing_time(duration, settled, loaded)
    vibrations = []
    for layer, bases in zip(layers, bases_by_layer, strict=True):
        plant = _plant_under(rig, reduced, fingers, imperfections, loaded)
        for number, era in enumerate(rig.eras):
            errors = imperfections.errors_of(era.name, rig)
            plant.set_input(number, realised(bases[number], errors))
        shapes = plant.reduced.at(_points(rig, fingers))
        times, felt = plant.advance(duration, sample_rate=PLANT_SAMPLE_RATE, shapes=shapes)
        records = _records(rig, fingers, times, felt)
        frequencies, _ = base_amplitudes(layer.excitation, rig.eras, *layer.side_bands)
        driven = tuple(frequencies.tolist())
        doubled = tuple([2 * frequency for frequency in driven])
        heard_harmonics = doubled if any(harmonics.values()) else ()
        vibrations.append(Vibration(driven, layer.fingers, records, heard_harmonics))
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
    times = np.arange(len(felt)) / sample_rate
    records = _records(rig, fingers, times, felt)
    targets = tuple([number for number, finger in enumerate(fingers) if finger.stimulus])
    return PlatePlayback((Vibration((), targets, records),), 0.0, rig.threshold)


def _last_start(bases_by_layer: Sequence[Bases]) -> float:
    """Time [s] at which the last term of all bases starts: the steady one of the last onset."""
    starts = []
    for motion in chain.from_iterable(bases_by_layer):
        starts.extend([term.start for term in motion])
    return max(starts, default=0.0)


def _playing_time(duration: float | None, settled: float, loaded: LoadedPlate) -> float:
    """A duration [s] that lets the plate settle, the requested one if given; InputError if not."""
    slowest_decay = -float(loaded.plate.decay.real.max())
    ringing = _RINGING / max(slowest_decay, _RINGING / _MAX_DURATION)
    min_duration = min(settled + ringing, _MAX_DURATION)
    if duration is None:
        duration = max(min_duration, _MIN_DURATION)
    if not min_duration <= duration <= _MAX_DURATION:  # also rejects NaN
        raise InputError(
            f"duration must be at least {min_duration:.3g} s, the onset and until the plate rings "
            f"no more, and at most {_MAX_DURATION:g} s, got {duration:g} s; None is long enough"
        )
    return duration


def _plant_under(
    rig: Rig,
    reduced: ReducedPlate,
    fingers: Sequence[Finger],
    imperfections: Imperfections,
    loaded: LoadedPlate | None = None,
) -> Plant:
    """The plate at rest under fingers; loaded: if already solved."""
    plant = Plant(reduced, imperfections.plate.realised(rig).eras, loads=rig.masses)
    contacts = {}
    for number, contact in enumerate(imperfections.resting(rig, fingers)):
        contacts[str(number)] = contact
    plant.set_contacts(contacts, loaded=loaded)
    return plant


def _points(rig: Rig, fingers: Sequence[Finger]) -> FloatArray:
    """Points (p, 2) of all fingertips, in order."""
    return np.concatenate([fingertip_points(*finger.at, rig.plate) for finger in fingers])


def _records(
    rig: Rig, fingers: Sequence[Finger], times: FloatArray, felt: FloatArray
) -> tuple[FingerRecord, ...]:
    """Accelerations (n, p) at the points of all fingertips as a record of each finger."""
    records = []
    accelerations_by_finger = np.split(felt, len(fingers), axis=1)
    for finger, accelerations in zip(fingers, accelerations_by_finger, strict=True):
        points = fingertip_points(*finger.at, rig.plate)
        weights = fingertip_weights(*finger.at, rig.plate)
        records.append(FingerRecord(points, weights, times, accelerations))
    return tuple(records)


def _bases(layer: Layer, eras: Sequence[Source], harmonics: Mapping[str, complex]) -> Bases:
    """Motion of the bases when a layer starts, including its side bands.

    harmonics: second harmonic of each ERA, relative to its motion, by name.
    """
    bases_by_voice = []
    for voice in (*layer.voices, *harmonics_of_layer(layer, harmonics)):
        if voice.onset:
            bases_by_voice.append(shaped(voice.onset, eras))
        else:
            bases_by_voice.append(ramped_onset(voice.excitation, eras, ramp=voice.ramp))
    motions_by_era = zip(*bases_by_voice, strict=True)
    return tuple([tuple(chain.from_iterable(motions)) for motions in motions_by_era])
