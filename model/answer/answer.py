"""What is played for fingers, and what each of them feels.

Stimuli of limited duration: what fingers feel of a drive over it, onset and ringing included.

A plate follows its drive late: over 40 ms the root mean square at a finger is several decibels
below, on a sharp resonance ten decibels below, that of the steady vibration, and it rings on. A
target counts by the mean of its demodulated acceleration over the duration, another fingertip by
its power, that after the end included; of a course both by its strongest moments. Tones near the
frequency of a drive stand for its envelope, whichever it is (`DriveEnvelope.shares_at`): by these
weights are searched and drawn plates judged.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy import fft

from model.answer.stimulus import (
    ANY_BAND,
    SHAPED_FROM,
    SILENCE,
    STRONGEST,
    Contents,
    Course,
    Finger,
    Placement,
    Tones,
)
from model.arrays import ComplexArray, Float32Array, FloatArray, IntArray, Point
from model.drive_modes import UNRESTRICTED, Drive, Forms
from model.files.csv_file import as_frame
from model.finger import decibels, detection_threshold
from model.structure.attachments import Source, fingertip_loads
from model.table.table import LocalizationTable, read_fingertips
from model.transients.base_motion import Envelopes, rise
from model.transients.excursions import CLICKS_APART, DECAYED, Swing
from model.transients.knots import RISE
from model.transients.time_response import enveloped_accelerations
from model.vibration import Excitation

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

_BESIDE_HZ, _LEAST_SHARE = 60.0, 1e-3
"""Distance of the frequencies beside its own that count of a drive, and the least share of one in
the power of its strongest moments."""

_PULSE_STEP, _MAX_PULSE_STEPS = 0.001, 48
"""Steps [s] of pulses, and how many one has at most within its duration."""

_RESOLUTION = 1.0  # Hz, at least; of the spectrum of an envelope
_TINY = 1e-30

FADE_RAMP = 0.020
"""Fade-out [s] under fingers that stay on the plate; a shorter one would feel like a tap."""


_LEAST_PERIODS = 1.7  # beyond that by the reciprocal of a pulse's duration is 1.4 % of its energy


def pulse_ramp(duration: float) -> float:
    """Plain ramp [s] of a vibration of this duration [s], a quarter of it.

    The vibration is even over its duration then: no 40 ms of a click of 40 ms are more than 0.8 dB
    (median) stronger than the first 40, along a ramp of half of it 1.5, as long as it 3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


@lru_cache
def swings_of_pulse(duration: float, ramp: float) -> tuple[Swing, Swing]:
    """Return the swings of pulses of a duration one after the other, along plain ramps [s].

    They end along their own, or along that of contents that end. Of a long one its first
    SHAPED_FROM: by then the onset has decayed as far as the end will.
    """
    length = min(duration, SHAPED_FROM)
    count = math.ceil((length + DECAYED) / _PULSE_STEP)
    times = np.asarray(_PULSE_STEP * np.arange(count), dtype=float)
    shares = [
        rise(times, ramp) - rise(np.asarray(times - length), end) for end in (ramp, FADE_RAMP)
    ]
    again = max(duration, CLICKS_APART)
    one, other = (Swing(tuple(each.tolist()), _PULSE_STEP, again) for each in shares)
    return one, other


def shaped_gain(duration: float) -> float:
    """Amplitude over a duration [s] relative to the steady one with a shaped onset.

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    return math.sqrt(1 - 5 / 8 * min(RISE, duration) / duration)


@dataclass(frozen=True, eq=False)
class OverDuration:
    """What k fingers feel of a drive over a duration on the nominal plate.

    gains (k,): mean amplitude relative to the steady one; heard (k, p): squared amplitude to
    threshold at each point over as long, at its strongest.
    """

    gains: FloatArray
    heard: FloatArray


@dataclass(frozen=True, eq=False)
class DriveEnvelope:
    """Envelope (n,) of a drive at even steps [s], as long as it is followed.

    within: steps over which it is felt, of a course the strongest, else the first; share: of the
    followed part in the duration, the rest of which is steady.
    """

    values: FloatArray
    step: float
    within: int
    share: float = 1.0
    is_course: bool = False

    @classmethod
    def of_pulse(cls, duration: float, ramp: float) -> "DriveEnvelope":
        """Along plain ramps [s], to beyond the end, where a quiet finger may feel most."""
        length = min(duration, SHAPED_FROM)  # the rest is steady
        count = min(_MAX_PULSE_STEPS, max(1, math.ceil(length / _PULSE_STEP)))
        step = length / count
        every = count + math.ceil(RINGING / step)
        times = np.asarray(step * (np.arange(every) + 0.5), dtype=float)
        values = rise(times, ramp) - rise(np.asarray(times - length), ramp)
        return cls(np.asarray(values), step, count, length / duration)

    @classmethod
    def of_course(cls, course: Course) -> "DriveEnvelope":
        """Along a course, or a plain ramp where it starts or ends above 0."""
        count = math.ceil((course.duration + RINGING) / course.step)
        times = np.asarray(course.step * np.arange(count), dtype=float)
        after, (first, *_, last) = np.asarray(times - course.duration), course.shares
        values = course.at(times) - first * (1 - rise(times, ONSET_RAMP))
        values += np.where(after > 0, last * (1 - rise(after, ONSET_RAMP)), 0.0)
        within = round(STRONGEST / course.step)
        return cls(np.maximum(values, SILENCE), course.step, within, is_course=True)

    @property
    def lasts(self) -> float:
        """How long it is felt [s], what is steady apart."""
        return self.within * self.step

    def moments(self, squares: FloatArray) -> FloatArray:
        """Means of squares (n, ...) over what is felt, from all times on, (n', ...)."""
        sums = np.cumsum(squares, axis=0, dtype=float)
        sums[self.within :] -= sums[: -self.within].copy()
        return np.asarray(sums[self.within - 1 :] / self.within)

    def felt(self, squares: FloatArray, weights: FloatArray) -> OverDuration:
        """From squared amplitudes to threshold (n + 1, k, p), the last of them steady.

        weights (k, p): of the points in the mean.
        """
        power = self.share * self.moments(squares[:-1]) + (1 - self.share) * squares[-1]
        own = power if self.is_course else power[:1]
        felt = (np.sqrt(own) * weights).sum(axis=2).max(axis=0)
        steady = (np.sqrt(squares[-1]) * weights).sum(axis=1)
        return OverDuration(felt / np.maximum(steady, 1e-30), power.max(axis=0))

    def shares_at(self, off: FloatArray) -> FloatArray:
        """Shares (b,) of the steady power of tones that are off its frequency (b,) [Hz].

        With the energy of the drive on any plate (Parseval); of a course that of the strongest
        moments of each. Of two tones each has more of what is nearer to it: beside the drive's own,
        at which a null may be, as its square.
        """
        count = max(len(self.values), math.ceil(1 / _RESOLUTION / self.step))
        count = fft.next_fast_len(count)
        transform, nu = fft.fft(self.values, count), fft.fftfreq(count, self.step)
        near = np.array([np.interp(nu, off, each) for each in np.eye(len(off))])
        own = int(np.argmin(np.abs(off)))
        is_beside = near[own] > 0
        near[:, is_beside] **= 2
        near[own, is_beside] += 1 - near[:, is_beside].sum(axis=0)
        squares = np.abs(fft.ifft((transform * np.sqrt(near)).astype(np.complex64))) ** 2
        if self.is_course:
            power, all_ = self.moments(squares.T).max(axis=0), self.moments(self.values**2).max()
            return np.asarray(power * (all_ / power.sum()))
        power = self.share * squares.sum(axis=1) / self.within
        power[own] += 1 - self.share
        return np.asarray(power)


def on_drawn_plates(
    energies: FloatArray, heard: FloatArray, factor: FloatArray | float
) -> FloatArray:
    """Power over a duration on drawn plates (..., 1 + d), from energies, nominal first.

    heard (...): over the duration on the nominal plate; factor: of power over the duration to
    energies, as at the target. What other plates add to the energy is felt by as much.
    """
    added = factor * (energies - energies[..., :1])
    return np.asarray(np.maximum(heard[..., None] + added, 0.0))


@dataclass(frozen=True, eq=False)
class RingingUnderFingers:
    """Drives along an envelope, under fingers at places [m] of a plate.

    loads: of each relative to the rig's fingertip, empty for 1.
    """

    table: LocalizationTable
    places: tuple[Point, ...]
    loads: tuple[float, ...]
    envelope: DriveEnvelope
    _solved: dict[tuple[tuple[int, bytes], ...], OverDuration] = field(default_factory=dict)

    @classmethod
    def of_streams(
        cls, table: LocalizationTable, contents: Contents
    ) -> list["RingingUnderFingers | None"]:
        """One for each content that has a duration, None for those that last or are shaped."""
        found: list[RingingUnderFingers | None] = []
        for stream in contents.streams:
            envelope: DriveEnvelope | None = None
            if stream.course is not None:
                envelope = DriveEnvelope.of_course(stream.course)
            elif stream.duration is not None and not contents.is_shaped:
                ramp = max(pulse_ramp(stream.duration), contents.least_ramp)
                envelope = DriveEnvelope.of_pulse(stream.duration, ramp)
            fingers = table, contents.places, contents.loads
            found.append(None if envelope is None else cls(*fingers, envelope))
        return found

    @cached_property
    def shares(self) -> FloatArray:
        """Shares (f, f) of the power at its own frequency, of tones at all of the table's.

        A row for each of the table's frequencies that a drive may have.
        """
        hertz, known = self.table.frequencies, dict[tuple[float, ...], FloatArray]()
        ends = (hertz <= hertz[0] + _BESIDE_HZ).sum(), (hertz >= hertz[-1] - _BESIDE_HZ).sum()
        beyond = int(max(ends)) - 1
        wide = np.pad(hertz, beyond, mode="reflect", reflect_type="odd")
        # Tones beyond the table count as those as far within it.
        rows = np.pad(np.arange(len(hertz)), beyond, mode="reflect")
        found = np.zeros((len(hertz), len(hertz)))
        for own, at in enumerate(hertz.tolist()):
            off = np.round(wide - at, 6)
            near = np.abs(off) <= _BESIDE_HZ
            key = tuple(off[near].tolist())
            if key not in known:
                known[key] = self.envelope.shares_at(off[near])
            np.add.at(found[own], rows[near], known[key])
        strongest = self.envelope.moments(self.envelope.values**2).max()
        found[found < _LEAST_SHARE * strongest] = 0.0
        return found

    def spectrum(self, drive: Drive) -> Drive:
        """Tones for the tones of a drive, near the frequency of each.

        They have together the energy of the drive on any plate (Parseval), but for what it excites
        far beside. Above the threshold at its own frequency.
        """
        found, thresholds = [], self.table.thresholds
        for own, weights in drive:
            for row in np.flatnonzero(self.shares[own]).tolist():
                factor = math.sqrt(self.shares[own, row]) * thresholds[row] / thresholds[own]
                found.append((row, np.asarray(factor * weights, dtype=np.complex64)))
        return found

    def forms(self, steady: Forms, some: IntArray) -> Forms:
        """Forms over the envelope at some of the table's frequencies, from steady ones at all."""
        shares, own = self.shares[some].astype(np.float32), np.sqrt(self.shares[some, some])
        size = (np.abs(steady.targets) ** 2).sum(axis=(0, 2))
        gain = np.sqrt(shares @ size / np.maximum(size[some], _TINY))
        found, by_carrier = steady.at(some), own.astype(np.float32)[:, None, None, None]
        return replace(
            found,
            targets=found.targets * gain[:, None],
            quiet=(shares @ steady.quiet.reshape(len(steady.quiet), -1)).reshape(found.quiet.shape),
            level_margin=0.0,
            few=None if found.few is None else found.few * by_carrier,
            fine=None if found.fine is None else found.fine * by_carrier,
        )

    def lasting_long_enough(self, some: IntArray) -> IntArray:
        """Those of some of the table's frequencies whose spectrum does not reach 0; all, if none.

        A drive of fewer periods moves the plate as a whole, which no frequency of a table tells.
        """
        hertz, envelope = self.table.frequencies[some], self.envelope
        long = some if envelope.is_course else some[hertz * envelope.lasts >= _LEAST_PERIODS]
        return long if len(long) else some

    def over_drive(self, drive: Drive) -> OverDuration:
        """What fingers feel of a drive, as `over`; solved once."""
        hertz, drives = self.table.frequencies, self.table.highest_drives
        key = tuple([(row, weights.tobytes()) for row, weights in drive])
        if key not in self._solved:
            self._solved[key] = self.over(
                [
                    (float(hertz[row]), np.multiply(weights, drives[row], dtype=complex))
                    for row, weights in drive
                ]
            )
        return self._solved[key]

    def over(self, tones: Iterable[tuple[float, ComplexArray]]) -> OverDuration:
        """What fingers feel at their fine points of tones together.

        Of each its frequency [Hz] and the motions of the bases (eras,) [m].
        """
        table, tips = self.table, read_fingertips(self.table, self.places)
        k, p, r = tips.fine.shape
        loads = fingertip_loads(table.fingertip, self.places, self.loads)
        centres = tips.fine[: len(loads), 0].astype(float)
        fingers = [(at, load.fingertip) for at, load in zip(centres, loads, strict=True)]
        squares = np.zeros(())
        for frequency, bases in tones:
            found = enveloped_accelerations(
                table.in_time,
                bases,
                float(frequency),
                points=tips.fine.reshape(-1, r).astype(float),
                fingers=fingers,
                envelope=self.envelope.values,
                step=self.envelope.step,
            )
            threshold = detection_threshold(np.array(frequency), table.threshold)
            squares = squares + (found.real**2 + found.imag**2) / threshold**2
        return self.envelope.felt(squares.reshape(-1, k, p), tips.fine_weights.astype(float))


MIN_CONTRAST_DB, OWN_CONTRAST_DB = 6.0, 12.0
"""Promised contrast from which a vibration is served, and from which it is a finger's own."""

IMPERCEPTIBLE_DB_SL = -10.0
"""Level at which a finger stays unaware: ten decibels for the differences between people."""

SAME_LEVEL = 0.1
"""Difference of two levels that are one [dB]."""

_SHORT_OF = 0.05  # dB; a level closer to the wanted one is reached

OWN, MIXED, SHARED, HELD_BACK, QUIET = "own", "mixed", "shared", "held back", "quiet"


@dataclass(frozen=True)
class Sensation:
    """What a finger gets.

    Promised measures are those that nine of ten plates within the rig's uncertainty reach, or do
    not exceed; the others those of the plate as modelled, with the fingers on it.

    - verdict: `own`, `mixed` (below OWN_CONTRAST_DB, or what pauses beside others that are felt),
      `shared` (the vibration of another finger), `held back`, with the contrast that it would have
      had, or `quiet`
    - layer: number of the layer that plays it, None without one
    - level_db_sl, promised_level_db_sl: of its stimulus, over the duration if that is limited
    - contrast_db, median_contrast_db, promised_contrast_db: its level above that of all other
      vibrations here, or of an only one above its own at the loudest quiet finger; of a quiet
      finger the weakest vibration at its own finger above all of them here. As modelled, of half
      and of nine of ten plates, each the least over the rig's sets of thresholds; None where there
      is nothing to compare with
    - foreign_level_db_sl: of all other vibrations here, promised, not nominal as level_db_sl: the
      greatest over the sets
    - pauses: whether it ends, or comes and goes
    - lowered_db: by how much it is weaker than its stimulus asks
    - is_disturbing: whether it is held back because of a finger's max_foreign_db_sl
    """

    finger: Finger
    verdict: str
    layer: int | None = None
    level_db_sl: float = -math.inf
    promised_level_db_sl: float = -math.inf
    contrast_db: float | None = None
    median_contrast_db: float | None = None
    promised_contrast_db: float | None = None
    foreign_level_db_sl: float | None = None
    lowered_db: float = 0.0
    is_disturbing: bool = False
    pauses: bool = False

    @property
    def is_foreign_felt(self) -> bool:
        """Whether other vibrations here may be felt."""
        return is_felt(self.foreign_level_db_sl)


@dataclass(frozen=True)
class Layer:
    """What is played at once for the fingers of one vibration, by number.

    excitation: of all ERAs; side_bands: excitations beside it where its strength comes and goes;
    ramp [s]; onset, ending: envelopes that replace it; swings: ways in which its level comes and
    goes, without any it lasts; contrast_to_plate_db: level above that of
    the plate farther than 50 mm, root mean square, where no other finger is there.
    """

    excitation: Excitation
    fingers: tuple[int, ...] = (0,)
    side_bands: tuple[Excitation, ...] = ()
    ramp: float = ONSET_RAMP
    onset: Envelopes | None = None
    ending: Envelopes | None = None
    drive_mode: str = UNRESTRICTED
    contrast_to_plate_db: float | None = None
    swings: tuple[Swing, ...] = ()

    @property
    def frequency(self) -> float | None:
        """Its frequency, without those of side bands [Hz]; None of several or where it is empty."""
        frequencies = {tone.frequency for tone in self.excitation.values()}
        return frequencies.pop() if len(frequencies) == 1 else None

    @property
    def excitations(self) -> tuple[Excitation, ...]:
        """The excitation and its side bands."""
        return (self.excitation, *self.side_bands)

    @property
    def drives(self) -> list[tuple[Excitation, tuple[Swing, ...]]]:
        """The same, each with the swings of its level."""
        return [(each, self.swings) for each in self.excitations]

    @property
    def voices(self) -> tuple["Layer", ...]:
        """It without side bands, and each of them as a layer, along its ramp."""
        beside = [
            Layer(
                each,
                self.fingers,
                ramp=self.ramp,
                drive_mode=self.drive_mode,
                swings=self.swings,
            )
            for each in self.side_bands
        ]
        return (replace(self, side_bands=()), *beside)

    def scaled(self, gain_db: float) -> "Layer":
        """The layer louder by so much [dB], its envelopes too: contrasts stay."""
        factor = 10 ** (gain_db / 20)
        louder = [
            {n: replace(tone, amplitude=tone.amplitude * factor) for n, tone in each.items()}
            for each in self.excitations
        ]
        onset, ending = [
            each and {name: one.scaled(factor) for name, one in each.items()}
            for each in (self.onset, self.ending)
        ]
        return replace(
            self,
            excitation=louder[0],
            side_bands=tuple(louder[1:]),
            onset=onset,
            ending=ending,
        )


@dataclass(frozen=True)
class Limits:
    """Limits of the amplifiers.

    frequencies: lowest and highest [Hz]; amplitudes: largest ones [m], by ERA, None for the
    strokes; power: sum of squared levels of all ERAs; slew [1/s]: highest rise of one; excursion:
    part of the magnets' that may be used.
    """

    frequencies: tuple[float, float] = ANY_BAND
    amplitudes: Mapping[str, float] | None = None
    power: float = math.inf
    slew: float = math.inf
    excursion: float = 1.0

    def factor_within(self, layers: Sequence[Layer], table: LocalizationTable) -> float:
        """Return the factor, 1 at most, by which layers of a table are within together."""
        drives = [each for layer in layers for each in layer.drives]
        share, power = table.excursion_of(drives) / self.excursion, 0.0
        strokes = table.full_levels
        highest = self.amplitudes or strokes
        for name, amplitude in amplitudes_of([each for each, _ in drives]).items():
            share = max(share, amplitude / highest[name])
            power += (amplitude / strokes[name]) ** 2
        return 1.0 / max(1.0, share, math.sqrt(power / self.power))


NO_LIMITS = Limits()


@dataclass(frozen=True, eq=False)
class Answer:
    """What is played for fingers, and what each of them feels.

    asked: the fingers; contents: that are played, and who is kept quiet; tones: of these; held:
    vibrations given up, by finger, with the contrast that they would have had, and whether they
    would disturb a finger; applied: what was changed, in words; envelopes: onset and ending of each
    layer, if shaped; eras, frequencies [Hz], highest_drives (f, eras), thresholds [m/s²]: of the
    table.
    """

    asked: tuple[Finger, ...]
    contents: Contents
    tones: Tones
    held: tuple[tuple[int, float, bool], ...]
    applied: tuple[str, ...]
    eras: tuple[Source, ...]
    frequencies: FloatArray
    highest_drives: FloatArray
    thresholds: Float32Array
    envelopes: tuple[tuple[Envelopes | None, Envelopes | None], ...] = ()

    def __repr__(self) -> str:
        """What each finger gets, without the numbers that it follows from."""
        return f"Answer(fingers={self.fingers}, applied={self.applied})"

    @cached_property
    def fingers(self) -> tuple[Sensation, ...]:
        """What each finger gets, in the order in which they were given."""
        found, tones = dict[int, Sensation](), self.tones
        known = [  # None for what there is not
            [None if each != each else each for each in (*contrasts, max(of_others))]
            for contrasts, of_others in zip(tones.contrast_db, tones.foreign_db_sl, strict=True)
        ]
        for number, stream in enumerate(self.contents.streams):
            lowered, pauses = self.lowered_db(number), self.pauses(number)
            for finger in stream.targets:
                contrast, median, promised, of_others = known[finger]
                level, promised_level = self.levels_db_sl(number, finger)
                found[finger] = Sensation(
                    self.asked[finger],
                    SHARED
                    if finger != stream.targets[0]
                    else verdict_of(promised, of_others, pauses=pauses),
                    number,
                    level,
                    promised_level,
                    contrast,
                    median,
                    promised,
                    of_others,
                    lowered,
                    pauses=pauses,
                )
        for finger, had, is_disturbing in self.held:
            found[finger] = Sensation(
                self.asked[finger],
                HELD_BACK,
                promised_contrast_db=had,
                foreign_level_db_sl=known[finger][-1],
                is_disturbing=is_disturbing,
            )
        for finger, each in enumerate(self.asked):
            if each.stimulus is None:
                contrast, median, promised, of_others = known[finger]
                found[finger] = Sensation(
                    each,
                    QUIET,
                    contrast_db=contrast,
                    median_contrast_db=median,
                    promised_contrast_db=promised,
                    foreign_level_db_sl=of_others,
                )
        return tuple([found[number] for number in range(len(self.asked))])

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """What is played, a layer for each vibration."""
        layers, least = [], self.contents.least_ramp
        for number, stream in enumerate(self.contents.streams):
            excitation, *sides = self.tones.excitations(
                number, self.eras, self.frequencies, self.highest_drives
            )
            if self.contents.drive_mode != UNRESTRICTED:  # all tones are one excitation
                every = (excitation, *sides)
                excitation = {name: tone for each in every for name, tone in each.items()}
                sides = []
            is_plain = not self.contents.is_shaped and stream.course is None
            duration = stream.duration if is_plain else None
            ramp = ONSET_RAMP if duration is None else max(pulse_ramp(duration), least)
            swings: tuple[Swing, ...] = ()
            if stream.course is not None:
                swings = stream.course.swings
            elif duration is not None:
                swings = swings_of_pulse(duration, ramp)
            onset, ending = self.envelopes[number] if self.envelopes else (None, None)
            layers.append(
                Layer(
                    excitation,
                    stream.targets,
                    tuple(sides),
                    ramp,
                    onset,
                    ending,
                    self.contents.drive_mode,
                    None if self.contents.background is None else self._contrast_to_plate_db,
                    swings,
                )
            )
        return tuple(layers)

    def placement(self, layer: Layer) -> Placement:
        """Where the fingers of a layer are, and all others."""
        own, others, loads = [], [], []
        for number in layer.fingers:
            own.append(self.asked[number].at)
            loads.append(self.asked[number].load)
        for number, finger in enumerate(self.asked):
            if number not in layer.fingers:
                others.append(finger.at)
                loads.append(finger.load)
        return Placement(tuple(own), tuple(others), tuple(loads))

    def levels_db_sl(self, number: int, finger: int) -> tuple[float, float]:
        """Level of a layer at a finger, both by number, and the promised one; of a course at 1."""
        course = self.contents.streams[number].course
        level, promised = self.tones.level_db_sl[finger]
        strongest_db = 0.0 if course is None else course.strongest_db
        return level - strongest_db, promised - strongest_db

    def lowered_db(self, number: int) -> float:
        """By how much a layer, by its number, is weaker than its stimulus asks [dB]."""
        stream = self.contents.streams[number]
        lasts, short = stream.duration is None, -math.inf
        for finger in stream.targets:
            stimulus = self.asked[finger].stimulus
            if stimulus is not None:
                given = self.levels_db_sl(number, stream.targets[0])[lasts]
                short = max(short, stimulus.level_db_sl - given)
        return short if short > SAME_LEVEL else 0.0

    def pauses(self, number: int) -> bool:
        """Whether a layer, by its number, ends or comes and goes, and with it what it masks."""
        stream = self.contents.streams[number]
        stimulus = self.asked[stream.targets[0]].stimulus
        is_modulated = stimulus is not None and stimulus.modulation_hz is not None
        return stream.duration is not None or (
            is_modulated and list(self.tones.owners).count(number) > 1
        )

    @property
    def is_reached(self) -> bool:
        """Whether all vibrations have their levels on the plate as modelled."""
        return all(
            self.tones.level_db_sl[finger][0] >= stream.level_db_sl - _SHORT_OF
            for stream in self.contents.streams
            for finger in stream.targets
        )

    @property
    def excitations(self) -> list[Excitation]:
        """All that plays together."""
        return [each for layer in self.layers for each in layer.excitations]

    @property
    def amplitudes(self) -> dict[str, float]:
        """Amplitude of each ERA [m], of all that plays together."""
        return amplitudes_of(self.excitations)

    @property
    def promised_worst_db(self) -> float | None:
        """The least contrast of all fingers, on nine of ten plates; None for one finger alone."""
        worst = self.tones.worst_db
        return None if math.isnan(worst) else worst

    @property
    def lacks_contrast(self) -> bool:
        """Whether a finger has less contrast to others' vibrations than it asks for."""
        targets = [finger for stream in self.contents.streams for finger in stream.targets]
        found, asked = self.tones.contrast_db, self.asked
        return any(found[each][2] < asked[each].min_contrast_db for each in targets)

    @property
    def disturbed(self) -> list[int]:
        """Fingers, by number, that would feel more of others' vibrations than they allow."""
        levels = enumerate(zip(self.tones.foreign_db_sl, self.asked, strict=True))
        return [finger for finger, (by, each) in levels if by[0] > each.max_foreign_db_sl]

    @property
    def stroke_factor(self) -> float:
        """Of the requested levels what the ERAs' stroke allows, 1 for all."""
        return self.tones.stroke_factor

    @property
    def _contrast_to_plate_db(self) -> float | None:
        """Level of the weakest target above that of the rest of the plate; None beside others."""
        background, tones = self.contents.background, self.tones
        if background is None:
            return None
        power = 1e-60
        every = zip(tones.rows, tones.weights, tones.gains, strict=True)
        for row, weights, gain in every:
            w = np.multiply(gain, weights)
            around = max(float(np.vdot(w, background[row] @ w).real), 0.0)
            power += around / float(self.thresholds[row]) ** 2
        (stream,) = self.contents.streams
        level = min([tones.level_db_sl[finger][0] for finger in stream.targets])
        return level - float(decibels(math.sqrt(power)))

    def to_frame(self) -> Any:
        """What each finger feels as a pandas DataFrame, a row a finger; needs pandas.

        worst_foreign_level_db_sl is `Sensation.foreign_level_db_sl`: what others' vibrations reach
        at the loudest point of the fingertip, which nine of ten plates do not exceed, above the
        lowest thresholds known. The finger's own level is above the rig's, up to 30 dB higher, so
        that 20 dB SL of its own with 34 of others' is no contradiction: compare by the contrast.
        """
        at, found = np.array([each.at for each in self.asked]), self.fingers
        frequencies = [layer.frequency or math.nan for layer in self.layers]
        none = math.nan
        return as_frame(
            {
                "x_m": at[:, 0],
                "y_m": at[:, 1],
                "verdict": [each.verdict for each in found],
                "frequency_hz": [
                    none if each.layer is None else frequencies[each.layer] for each in found
                ],
                "promised_level_db_sl": [each.promised_level_db_sl for each in found],
                "promised_contrast_db": [each.promised_contrast_db for each in found],
                "worst_foreign_level_db_sl": [each.foreign_level_db_sl for each in found],
            }
        )


def verdict_of(
    promised_contrast_db: float | None, foreign_level_db_sl: float | None, *, pauses: bool
) -> str:
    """Return whether a vibration of a contrast is a finger's own or mixed with others.

    A vibration masks what is weaker while it lasts: of one that pauses nothing foreign may be felt.
    """
    is_own = promised_contrast_db is None or promised_contrast_db >= OWN_CONTRAST_DB
    return OWN if is_own and not (pauses and is_felt(foreign_level_db_sl)) else MIXED


def is_felt(level_db_sl: float | None) -> bool:
    """Return whether a level, None for none, is above the threshold."""
    return level_db_sl is not None and level_db_sl > 0


def verdict_shown(verdict: str | None, *, is_foreign_felt: bool) -> str | None:
    """Return a verdict in words, with what a finger feels beside its own vibration."""
    return f"{verdict}, others faintly felt" if verdict == OWN and is_foreign_felt else verdict


def amplitudes_of(excitations: Iterable[Excitation]) -> dict[str, float]:
    """Return the amplitudes [m] of excitations together, by ERA."""
    total = defaultdict[str, float](float)
    for tones in excitations:
        for name, tone in tones.items():
            total[name] += tone.amplitude
    return total
