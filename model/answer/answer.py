"""Answer of a query: layers to play, and the resulting sensation at each finger.

`Contents` is a query: K contents, each meant for its own fingers and kept from all others. Content
j alone is a query with its fingers as targets and all others quiet, so K contents are K searches
over one loaded plate; weights shared between contents gain 0.3 dB at most. Contents have different
frequencies, so their powers add. From a few candidates for each content, the combination is chosen
that has the best contrast at the worst finger on drawn plates. Promises are computed on other
draws, the same for all tones. The contrast at finger k is

    C_k = g_k own_k / sqrt(max_p sum_j g_j^2 power_j(p)),  j other contents, p points of finger k,

and at a quiet finger the ratio of the weakest content to all contents together. A single content
uses the tone with the highest contrast at its level. Since contents differ in frequency, a contrast
depends on the thresholds: the lowest over the table's threshold sets counts, in the choice and in
the promise. The weights of a content do not depend on the threshold set. Its second harmonics do,
and candidates are judged by the set with the loudest harmonics.

`Tones` is the result of `model.answer.tone_search`. `Answer` combines query and tones: a `Layer`
per content, and a `Sensation` per finger.
"""

import cmath
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from model.answer.stimulus import (
    ANY_BAND,
    ONSET_RAMP,
    Course,
    Finger,
    Placement,
    pulse_ramp,
    swings_of_pulse,
)
from model.arrays import NEARLY, Complex64Array, Float32Array, FloatArray, IntArray, Point
from model.drive_modes import UNRESTRICTED
from model.files.csv_file import as_frame
from model.finger import decibels
from model.structure.attachments import Source
from model.table.table import LocalizationTable
from model.transients.base_motion import Envelopes
from model.transients.excursions import Swing
from model.vibration import Excitation, Tone

PROMISED_PERCENTILE = 9
"""Percentile of the drawn plates that is promised.

Corresponds to about the tenth percentile of exactly solved plates: effects beyond first order in
parameters other than the thickness cost some tenths of a decibel.
"""

REACHED = 1 - 1e-5
"""Fraction of a level that counts as reached."""

KEPT, MISSING = 16, 4
"""Number of frequencies searched for a single content, and how many can miss the level.

The first is a multiple of the kernels' batch size. Frequencies with the highest bounds |c^H w| /
sqrt(w^H R w) of w = R^-1 c are searched, with R the mean over the quiet fingers: a bound takes one
system of equations, a search several.
"""

MIN_CANDIDATES, MAX_CANDIDATES = 4, 32
"""Number of candidates for a single content, and the maximum over all bands of any content.

This many according to the mean over fingertips, and as many according to their points.
"""

MAX_COMBINATIONS, PRUNING_STEP = 200, 4
"""Combinations of candidates kept for the next content, and the step of draws in between.

Fewer are kept for more than four contents, so that time grows with the square of their number.
"""

APART_HZ = 30.0
"""Minimum distance between the frequencies of two contents [Hz]; closer ones feel like beating."""


@dataclass(frozen=True)
class Stream:
    """Content for some fingers."""

    targets: tuple[int, ...]
    """Its fingers, by index."""
    level_db_sl: float
    bands: tuple[tuple[int, int], ...]
    """First row of the table's frequencies and one past the last, for each allowed band.

    There is one band unless contents can swap theirs.
    """
    priority: int = 0
    """Higher priorities get the stroke first."""
    duration: float | None = None
    """Time over which the level is felt [s], None for a continuous content."""
    limit_db_sl: float | None = None
    """Upper limit of a level that the other fingers set, None for a fixed level."""
    course: Course | None = None
    """Envelope over the duration, whose maximum has the level."""


@dataclass(frozen=True, eq=False)
class Contents:
    """Query of K contents for k fingers on a plate."""

    places: tuple[Point, ...]
    """Positions of all fingers [m], then of the additional patches of hands."""
    loads: tuple[float, ...]
    """Load of each finger relative to the rig's fingertip, empty for 1 each."""
    streams: tuple[Stream, ...]
    """The contents."""
    quiet: tuple[int, ...]
    """Indices of fingers that should feel nothing; others without a content are unprotected."""
    apart_hz: float = 0.0
    """Minimum distance between the contents' frequencies [Hz], if their bands allow it."""
    background: Complex64Array | None = None
    """Form of the rest of the plate at all of the table's frequencies; None if there are other
    fingers."""
    drive_mode: str = UNRESTRICTED
    """Drive mode; all except UNRESTRICTED play a single content."""
    is_shaped: bool = False
    """Whether onsets are shaped, which leaves no ringing."""
    least_ramp: float = 0.0
    """Minimum ramp of short contents [s], whose ramp is otherwise a quarter of their duration."""
    avoided: tuple[int, ...] = ()
    """Rows of the table's frequencies that no content can use."""

    @property
    def is_ranked(self) -> bool:
        """Whether only KEPT frequencies are searched first: for a single content of a single
        finger."""
        first = self.streams[0]
        return len(self.streams) == len(first.targets) == len(first.bands) == 1 <= len(self.quiet)

    @property
    def candidates(self) -> int:
        """Number of candidates per content and band, by means and by points."""
        count, bands = len(self.streams), len(self.streams[0].bands)
        return max(1, min(MIN_CANDIDATES + count // 2, MAX_CANDIDATES // bands))

    @property
    def combinations(self) -> int:
        """Number of combinations of candidates that are kept."""
        return min(MAX_COMBINATIONS, 4 * MAX_COMBINATIONS // len(self.streams))

    @property
    def rows(self) -> IntArray:
        """Rows of the table's frequencies that contents can use, ascending, (f,)."""
        bands = [np.arange(*band) for stream in self.streams for band in stream.bands]
        return np.setdiff1d(np.concatenate(bands), self.avoided)

    def others(self, number: int) -> list[int]:
        """Return the fingers from which the content with a given number is kept."""
        every = {*self.quiet}.union(*(stream.targets for stream in self.streams))
        return sorted(every - {*self.streams[number].targets})

    def of_first(self, count: int) -> Self:
        """Return only the contents of the first `count` fingers."""
        return replace(
            self,
            places=self.places[:count],
            loads=self.loads[:count],
            streams=tuple(
                replace(each, targets=tuple(one for one in each.targets if one < count))
                for each in self.streams
            ),
            quiet=tuple(each for each in self.quiet if each < count),
        )

    @property
    def levels(self) -> Float32Array:
        """Amplitude of each content relative to the threshold, (K,)."""
        levels = [10 ** (stream.level_db_sl / 20) for stream in self.streams]
        return np.array(levels, dtype=np.float32)


_ROUNDING = 1e-6  # of single precision


@dataclass(frozen=True, eq=False)
class Tones:
    """m tones of K contents, one or more each, and the resulting sensation of k fingers.

    For s sets of thresholds, the rig's own first.
    """

    rows: list[int]
    """Row (m,) of each tone's frequency in the table."""
    weights: Sequence[Sequence[complex]]
    """Weights of the ERAs (m, n), up to full stroke."""
    gains: list[float]
    """Gain (m,) of each tone for its level, within the stroke."""
    owners: Sequence[int]
    """Content (m,) of each tone."""
    contrast_db: Sequence[Sequence[float]]
    """Contrast (k, 3): nominal, median of the drawn plates, and promised.

    The lowest over the threshold sets; NaN without other contents or fingers.
    """
    level_db_sl: Sequence[Sequence[float]]
    """Level (k, 2) of a finger's own content relative to the rig's own threshold set: nominal and
    promised."""
    foreign_db_sl: Sequence[Sequence[float]]
    """Upper bound of the level (k, s) of other contents on 90 % of plates, by each threshold set.

    NaN at fingers that neither feel a content nor are quiet.
    """
    worst_db: float
    """Promised contrast of the worst finger, NaN for a single finger."""
    stroke_factor: float
    """Smallest factor on the gains to fit the stroke, 1 for none."""
    is_apart: bool
    """Whether the frequencies keep the minimum distance."""

    def excitations(
        self,
        content: int,
        eras: Sequence[Source],
        frequencies: FloatArray,
        highest_drives: FloatArray,
    ) -> list[Excitation]:
        """Return the excitations of a content, one per tone, the carrier first.

        frequencies (f,) [Hz] and highest_drives (f, eras) are the table's. The strongest ERA, or
        the first ERA nearly as strong, has phase zero.
        """
        found = list[Excitation]()
        every = zip(self.rows, self.weights, self.gains, self.owners, strict=True)
        for row, values, gain, owner in every:
            if owner != content:
                continue
            frequency, tones = float(frequencies[row]), dict[str, Tone]()
            # Python's own numbers: one by one, numpy's are ten times slower.
            enough = (1 - NEARLY) * max(map(abs, values))
            (strongest, *_) = [value for value in values if abs(value) >= enough]
            factor = strongest.conjugate() / abs(strongest)
            for era, highest, value in zip(eras, highest_drives[row].tolist(), values, strict=True):
                if value != 0:
                    w = value * factor
                    if w.real > 0 and abs(w.imag) < _ROUNDING * w.real:
                        w = w.real
                    amplitude = gain * min(abs(w), 1.0) * highest
                    tones[era.name] = Tone(frequency, amplitude, cmath.phase(w))
            found.append(tones)
        return found

    @classmethod
    def none(cls, fingers: int, sets: int) -> "Tones":
        """Return no tones, for `fingers` fingers and `sets` threshold sets."""
        contrast, level = [(math.inf,) * 3] * fingers, [(-math.inf,) * 2] * fingers
        heard = [(-math.inf,) * sets] * fingers
        return cls([], [], [], [], contrast, level, heard, math.nan, 1.0, is_apart=True)


MIN_CONTRAST_DB, OWN_CONTRAST_DB = 6.0, 12.0
"""Promised contrast [dB] above which a vibration is served, and above which it is a finger's
own."""

IMPERCEPTIBLE_DB_SL = -10.0
"""Imperceptible level: ten decibels below the threshold allow for differences between people."""

SAME_LEVEL = 0.1
"""Difference [dB] below which two levels count as equal."""

_SHORT_OF = 0.05  # dB below the wanted level that counts as reached

OWN, MIXED, SHARED, HELD_BACK, QUIET = "own", "mixed", "shared", "held back", "quiet"


@dataclass(frozen=True)
class Sensation:
    """Vibration that a finger feels.

    Promised values are reached (or for foreign levels, not exceeded) by 90 % of plates within the
    rig's uncertainty. All others are nominal values of the modeled plate with the fingers on it.
    Levels are relative to the rig's own threshold set, except for `foreign_level_db_sl`.
    """

    finger: Finger
    verdict: str
    """`own`; `mixed`; `shared`; `held back`; or `quiet`.

    A vibration is mixed below OWN_CONTRAST_DB, or if it pauses while others are felt. `shared`: the
    vibration of another finger. `held back`: not played; the contrast is what it would have had.
    """
    layer: int | None = None
    """Number of the layer that plays the finger's vibration, None if no layer does."""
    level_db_sl: float = -math.inf
    """Level of the finger's stimulus; averaged over the duration if it has one."""
    promised_level_db_sl: float = -math.inf
    contrast_db: float | None = None
    """Level relative to all other vibrations here, None without other vibrations.

    For a single vibration: relative to its own level at the loudest quiet finger. For a quiet
    finger: the weakest vibration at its own finger, relative to all vibrations here. Every contrast
    is the lowest over the rig's threshold sets.
    """
    median_contrast_db: float | None = None
    """Median of the same contrast over the plates."""
    promised_contrast_db: float | None = None
    foreign_levels_db_sl: tuple[float, ...] = ()
    """Promised level of all other vibrations at the loudest point here, for each threshold set.

    In the order of `table.threshold_sets`: `dict(zip(table.threshold_sets, levels))`. Empty for a
    finger that neither feels a vibration nor is kept quiet.
    """
    lowered_db: float = 0.0
    """Reduction below the requested level [dB]."""
    is_disturbing: bool = False
    """Whether the vibration is held back because of another finger's max_foreign_db_sl."""
    pauses: bool = False
    """Whether the vibration ends or is modulated."""

    @property
    def foreign_level_db_sl(self) -> float | None:
        """Promised level of all other vibrations at the loudest point here, relative to the lowest
        threshold.

        The highest over the rig's threshold sets, up to 30 dB above `rig_foreign_level_db_sl`. Use
        it to decide whether others can be felt, but do not compare it with this finger's own level.
        """
        return max(self.foreign_levels_db_sl, default=None)

    @property
    def rig_foreign_level_db_sl(self) -> float | None:
        """The same level relative to the rig's own threshold set, like the finger's own levels."""
        return next(iter(self.foreign_levels_db_sl), None)

    @property
    def is_foreign_felt(self) -> bool:
        """Whether other vibrations can be felt here."""
        return is_felt(self.foreign_level_db_sl)


@dataclass(frozen=True)
class Layer:
    """Excitations that play simultaneously and form one vibration for its fingers."""

    excitation: Excitation
    """Tones of all ERAs."""
    fingers: tuple[int, ...] = (0,)
    """Numbers of the fingers that feel the layer."""
    side_bands: tuple[Excitation, ...] = ()
    """Additional excitations that modulate the layer's amplitude."""
    ramp: float = ONSET_RAMP
    """Duration [s] of the plain onset and ending."""
    onset: Envelopes | None = None
    """Shaped onset instead of the ramp."""
    ending: Envelopes | None = None
    """Shaped ending instead of the ramp."""
    drive_mode: str = UNRESTRICTED
    contrast_to_plate_db: float | None = None
    """Level relative to the plate more than 50 mm away (RMS), if there is no other finger."""
    swings: tuple[Swing, ...] = ()
    """Possible envelopes of the layer's level; empty for a continuous layer."""

    @property
    def frequency(self) -> float | None:
        """Frequency [Hz] without side bands; None if the layer is empty or has several
        frequencies."""
        frequencies = {tone.frequency for tone in self.excitation.values()}
        return frequencies.pop() if len(frequencies) == 1 else None

    @property
    def excitations(self) -> tuple[Excitation, ...]:
        """The excitation and its side bands."""
        return (self.excitation, *self.side_bands)

    @property
    def drives(self) -> list[tuple[Excitation, tuple[Swing, ...]]]:
        """The excitation and its side bands, each with its envelopes."""
        return [(each, self.swings) for each in self.excitations]

    @property
    def voices(self) -> tuple["Layer", ...]:
        """The layer without side bands, and a layer per side band, with the same ramp."""
        carrier = replace(self, side_bands=())
        beside = replace(carrier, onset=None, ending=None, contrast_to_plate_db=None)
        return carrier, *[replace(beside, excitation=each) for each in self.side_bands]

    def scaled(self, gain_db: float) -> "Layer":
        """Return the layer with a gain [dB] on excitations and envelopes; contrasts do not
        change."""
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
    """Limits of the amplifiers on all layers together."""

    frequencies: tuple[float, float] = ANY_BAND
    """Lowest and highest frequency [Hz]."""
    amplitudes: Mapping[str, float] | None = None
    """Largest amplitude [m] by ERA, None for full stroke."""
    power: float = math.inf
    """Sum of the squared levels of all ERAs."""
    slew: float = math.inf
    """Fastest rise of a level [1/s]."""
    excursion: float = 1.0
    """Usable fraction of the magnets' excursions."""

    def factor_within(self, layers: Sequence[Layer], table: LocalizationTable) -> float:
        """Return the factor (at most 1) that brings a table's layers within all limits."""
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
    """Layers to play, and the resulting sensation of each finger."""

    asked: tuple[Finger, ...]
    """Fingers with their requests."""
    contents: Contents
    """Played contents and quiet fingers."""
    tones: Tones
    """Tones of the contents."""
    held: tuple[tuple[int, float, bool], ...]
    """Vibrations that are held back: finger, contrast [dB] that it would have had, and whether it
    would disturb another finger."""
    applied: tuple[str, ...]
    """Changes to the fingers' requests, one sentence each."""
    eras: tuple[Source, ...]
    """ERAs of the table."""
    frequencies: FloatArray
    """Frequencies (f,) of the table [Hz]."""
    highest_drives: FloatArray
    """Amplitude of each ERA at full level (f, eras), from the table."""
    thresholds: Float32Array
    """Detection threshold at each frequency (f,) [m/s²]."""
    envelopes: tuple[tuple[Envelopes | None, Envelopes | None], ...] = ()
    """Shaped onset and ending of each layer; empty for plain ramps."""

    def __repr__(self) -> str:
        """Show the sensations without internal numbers."""
        return f"Answer(fingers={self.fingers}, applied={self.applied})"

    @cached_property
    def fingers(self) -> tuple[Sensation, ...]:
        """Sensation of each finger, in the order of `asked`."""
        sensations: dict[int, Sensation] = {}
        for number, stream in enumerate(self.contents.streams):
            for finger in stream.targets:
                sensations[finger] = self._sensation_of_content(number, finger)
        for finger, contrast, is_disturbing in self.held:
            sensations[finger] = replace(
                self._sensation_of_others(finger, HELD_BACK),
                promised_contrast_db=contrast,
                is_disturbing=is_disturbing,
            )
        for number, finger_asked in enumerate(self.asked):
            if finger_asked.stimulus is None:
                sensations[number] = self._sensation_beside(number, QUIET)
        return tuple([sensations[number] for number in range(len(self.asked))])

    def _sensation_of_content(self, number: int, finger: int) -> Sensation:
        """Return the sensation of a finger that feels a content, both by number."""
        stream = self.contents.streams[number]
        pauses = self.pauses(number)
        level, promised_level = self.levels_db_sl(number, finger)
        verdict = SHARED
        sensation = self._sensation_beside(finger, verdict)
        if finger == stream.targets[0]:
            verdict = verdict_of(
                sensation.promised_contrast_db, sensation.foreign_level_db_sl, pauses=pauses
            )
        return replace(
            sensation,
            verdict=verdict,
            layer=number,
            level_db_sl=level,
            promised_level_db_sl=promised_level,
            lowered_db=self.lowered_db(number),
            pauses=pauses,
        )

    def _sensation_beside(self, finger: int, verdict: str) -> Sensation:
        """Return a finger's contrasts and the level of others there, without its own content."""
        contrast, median, promised = map(_known, self.tones.contrast_db[finger])
        return replace(
            self._sensation_of_others(finger, verdict),
            contrast_db=contrast,
            median_contrast_db=median,
            promised_contrast_db=promised,
        )

    def _sensation_of_others(self, finger: int, verdict: str) -> Sensation:
        """Return the levels of other vibrations at a finger, without any contrast."""
        levels_by_set = tuple(self.tones.foreign_db_sl[finger])
        if math.isnan(levels_by_set[0]):
            return Sensation(self.asked[finger], verdict)
        return Sensation(self.asked[finger], verdict, foreign_levels_db_sl=levels_by_set)

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """Layers to play, one per vibration."""
        layers, least = [], self.contents.least_ramp
        for number, stream in enumerate(self.contents.streams):
            excitation, *sides = self.tones.excitations(
                number, self.eras, self.frequencies, self.highest_drives
            )
            if self.contents.drive_mode != UNRESTRICTED:  # all tones form one excitation
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
        """Return the positions of the fingers of a layer, and of all others."""
        own = [self.asked[number] for number in layer.fingers]
        others = [each for n, each in enumerate(self.asked) if n not in layer.fingers]
        return Placement(
            tuple([each.at for each in own]),
            tuple([each.at for each in others]),
            tuple([each.load for each in (*own, *others)]),
        )

    def levels_db_sl(self, number: int, finger: int) -> tuple[float, float]:
        """Return the nominal and promised level of a layer at a finger, both by number.

        For an envelope: at its maximum, 1.
        """
        course = self.contents.streams[number].course
        level, promised = self.tones.level_db_sl[finger]
        strongest_db = 0.0 if course is None else course.strongest_db
        return level - strongest_db, promised - strongest_db

    def lowered_db(self, number: int) -> float:
        """Return how far the layer with a given number is below its strongest stimulus [dB]."""
        stream = self.contents.streams[number]
        lasts, short = stream.duration is None, -math.inf
        for finger in stream.targets:
            stimulus = self.asked[finger].stimulus
            if stimulus is not None:
                given = self.levels_db_sl(number, stream.targets[0])[lasts]
                short = max(short, stimulus.level_db_sl - given)
        return short if short > SAME_LEVEL else 0.0

    def pauses(self, number: int) -> bool:
        """Return whether the layer with a given number ends or is modulated, so that it masks
        nothing meanwhile."""
        stream = self.contents.streams[number]
        stimulus = self.asked[stream.targets[0]].stimulus
        is_modulated = stimulus is not None and stimulus.modulation_hz is not None
        return stream.duration is not None or (
            is_modulated and list(self.tones.owners).count(number) > 1
        )

    @property
    def is_reached(self) -> bool:
        """Whether all vibrations have their nominal levels."""
        return all(
            self.tones.level_db_sl[finger][0] >= stream.level_db_sl - _SHORT_OF
            for stream in self.contents.streams
            for finger in stream.targets
        )

    @property
    def excitations(self) -> list[Excitation]:
        """All excitations that play together."""
        return [each for layer in self.layers for each in layer.excitations]

    @property
    def amplitudes(self) -> dict[str, float]:
        """Amplitude of each ERA [m], by name, of all excitations together."""
        return amplitudes_of(self.excitations)

    @property
    def promised_worst_db(self) -> float | None:
        """Promised contrast [dB] of the worst finger, None for a single finger."""
        worst = self.tones.worst_db
        return None if math.isnan(worst) else worst

    @property
    def lacks_contrast(self) -> bool:
        """Whether a finger has less contrast to others' vibrations than it requires."""
        targets = [finger for stream in self.contents.streams for finger in stream.targets]
        found, asked = self.tones.contrast_db, self.asked
        return any(found[each][2] < asked[each].min_contrast_db for each in targets)

    @property
    def disturbed(self) -> list[int]:
        """Fingers, by number, with stronger vibrations of others than they allow."""
        levels = enumerate(zip(self.tones.foreign_db_sl, self.asked, strict=False))
        return [finger for finger, (by, each) in levels if by[0] > each.max_foreign_db_sl]

    @property
    def stroke_factor(self) -> float:
        """Fraction of the requested levels that the ERAs' stroke allows; 1 if it allows all."""
        return self.tones.stroke_factor

    @property
    def _contrast_to_plate_db(self) -> float | None:
        """Level of the weakest target relative to the rest of the plate [dB].

        None if there are other fingers.
        """
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
        """Return the sensations as a pandas DataFrame, one row per finger; requires pandas.

        Levels are relative to the rig's own threshold set; other contents' levels are at the
        loudest point of the fingertip. Only worst_foreign_level_db_sl is relative to the lowest
        thresholds known (`Sensation.foreign_level_db_sl`), up to 30 dB higher; do not compare it
        with the others.
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
                "rig_foreign_level_db_sl": [each.rig_foreign_level_db_sl for each in found],
                "worst_foreign_level_db_sl": [each.foreign_level_db_sl for each in found],
            }
        )


def _known(value: float) -> float | None:
    """Return a number, None for NaN."""
    return None if math.isnan(value) else value


def verdict_of(
    promised_contrast_db: float | None, foreign_level_db_sl: float | None, *, pauses: bool
) -> str:
    """Return whether a vibration with this promised contrast is a finger's own or mixed with
    others.

    A continuous vibration masks weaker ones. During the pauses of another vibration, foreign ones
    must not be felt.
    """
    is_own = promised_contrast_db is None or promised_contrast_db >= OWN_CONTRAST_DB
    return OWN if is_own and not (pauses and is_felt(foreign_level_db_sl)) else MIXED


def is_felt(level_db_sl: float | None) -> bool:
    """Return whether a level is above the threshold; None is no level."""
    return level_db_sl is not None and level_db_sl > 0


def verdict_shown(verdict: str | None, *, is_foreign_felt: bool) -> str | None:
    """Return a verdict in words, with a note if others' vibrations are felt as well."""
    return f"{verdict}, others faintly felt" if verdict == OWN and is_foreign_felt else verdict


def amplitudes_of(excitations: Iterable[Excitation]) -> dict[str, float]:
    """Return the amplitudes [m] of excitations together, by ERA."""
    total = defaultdict[str, float](float)
    for tones in excitations:
        for name, tone in tones.items():
            total[name] += tone.amplitude
    return total
