"""Answer of a query: layers to play, and the resulting sensation at each finger.

`Answer` joins a question and its tones (`model.answer.question`): a `Layer` per content, and a
`Sensation` per finger.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from model.answer.envelope import ONSET_RAMP
from model.answer.question import Contents, Stream, Tones
from model.answer.stimulus import ANY_BAND, Finger, Placement
from model.arrays import Float32Array, FloatArray
from model.drive_modes import UNRESTRICTED
from model.files.csv_file import as_frame
from model.finger import decibels
from model.structure.sources import Source
from model.table.table import LocalizationTable
from model.transients.base_motion import Envelopes
from model.transients.excursions import Swing
from model.vibration import Excitation, Tone

APART_HZ = 30.0
"""Minimum distance between the frequencies of two contents [Hz]; closer ones feel like beating."""

MIN_CONTRAST_DB, OWN_CONTRAST_DB = 6.0, 12.0
"""Promised contrast [dB] above which a vibration is served, and above which it is a finger's
own."""

IMPERCEPTIBLE_DB_SL = -10.0
"""Imperceptible level: ten decibels below the threshold allow for differences between people."""

SAME_LEVEL = 0.1
"""Difference [dB] below which two levels count as equal."""

_SHORT_OF = 0.05  # dB below the wanted level that counts as reached
_NO_POWER = 1e-60  # keeps the level of a plate at rest finite

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
    vibration of another finger. `held back`: not played, with the contrast that it would have had.
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
    """Level relative to the plate more than 50 mm away (RMS); None if there are other fingers."""
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
        return [(excitation, self.swings) for excitation in self.excitations]

    @property
    def voices(self) -> tuple["Layer", ...]:
        """The layer without side bands, and a layer per side band, with the same ramp."""
        carrier = replace(self, side_bands=())
        plain = replace(carrier, onset=None, ending=None, contrast_to_plate_db=None)
        side_layers = [replace(plain, excitation=side_band) for side_band in self.side_bands]
        return (carrier, *side_layers)

    def scaled(self, gain_db: float) -> "Layer":
        """Return the layer with a gain [dB] on excitations and envelopes; contrasts do not
        change."""
        factor = 10 ** (gain_db / 20)
        side_bands = [_scaled_excitation(side_band, factor) for side_band in self.side_bands]
        return replace(
            self,
            excitation=_scaled_excitation(self.excitation, factor),
            side_bands=tuple(side_bands),
            onset=_scaled_envelopes(self.onset, factor),
            ending=_scaled_envelopes(self.ending, factor),
        )


def _scaled_excitation(excitation: Excitation, factor: float) -> Excitation:
    tones: dict[str, Tone] = {}
    for name, tone in excitation.items():
        tones[name] = replace(tone, amplitude=tone.amplitude * factor)
    return tones


def _scaled_envelopes(envelopes: Envelopes | None, factor: float) -> Envelopes | None:
    if envelopes is None:
        return None
    return {name: envelope.scaled(factor) for name, envelope in envelopes.items()}


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
    """Maximum rise of a level [1/s]."""
    excursion: float = 1.0
    """Usable fraction of the magnets' excursions."""

    def factor_within(self, layers: Sequence[Layer], table: LocalizationTable) -> float:
        """Return the factor (at most 1) that brings a table's layers within all limits."""
        drives: list[tuple[Excitation, tuple[Swing, ...]]] = []
        for layer in layers:
            drives += layer.drives
        full_levels = table.full_levels
        highest = self.amplitudes or full_levels
        largest_share = table.excursion_of(drives) / self.excursion
        power = 0.0
        for name, amplitude in amplitudes_of([excitation for excitation, _ in drives]).items():
            largest_share = max(largest_share, amplitude / highest[name])
            power += (amplitude / full_levels[name]) ** 2
        return 1.0 / max(1.0, largest_share, math.sqrt(power / self.power))


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

    @property
    def promised_fingers(self) -> tuple[Sensation, ...]:
        """The same sensations, with promised values as level and contrast: for pictures."""
        promised = []
        for finger in self.fingers:
            level = finger.promised_level_db_sl
            contrast = finger.promised_contrast_db
            promised.append(replace(finger, level_db_sl=level, contrast_db=contrast))
        return tuple(promised)

    @cached_property
    def fingers(self) -> tuple[Sensation, ...]:
        """Sensation of each finger, in the order of `asked`."""
        sensations: dict[int, Sensation] = {}
        for number, stream in enumerate(self.contents.streams):
            for target in stream.targets:
                sensations[target] = self._sensation_of_content(number, target)
        for held_back, contrast, is_disturbing in self.held:
            sensations[held_back] = replace(
                self._sensation_of_others(held_back, HELD_BACK),
                promised_contrast_db=contrast,
                is_disturbing=is_disturbing,
            )
        for index, finger in enumerate(self.asked):
            if finger.stimulus is None:
                sensations[index] = self._sensation_without_content(index, QUIET)
        return tuple([sensations[index] for index in range(len(self.asked))])

    def _sensation_of_content(self, number: int, finger: int) -> Sensation:
        """Return the sensation of a finger that feels a content, both by number."""
        stream = self.contents.streams[number]
        pauses = self.pauses(number)
        level, promised_level = self.levels_db_sl(number, finger)
        verdict = SHARED
        sensation = self._sensation_without_content(finger, verdict)
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

    def _sensation_without_content(self, finger: int, verdict: str) -> Sensation:
        """Return a finger's contrasts and the level of others there, without its own content."""
        contrast, median, promised = map(_none_for_nan, self.tones.contrast_db[finger])
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
            levels_by_set = ()
        return Sensation(self.asked[finger], verdict, foreign_levels_db_sl=levels_by_set)

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """Layers to play, one per vibration."""
        streams = self.contents.streams
        return tuple([self._layer(number, stream) for number, stream in enumerate(streams)])

    def _layer(self, number: int, stream: Stream) -> Layer:
        """Return the layer that plays the content with a given number."""
        contents = self.contents
        excitation, *side_bands = self.tones.excitations(
            number, self.eras, self.frequencies, self.highest_drives
        )
        if contents.drive_mode != UNRESTRICTED:  # all tones form one excitation
            tones = dict(excitation)
            for other_tones in side_bands:
                tones.update(other_tones)
            excitation = tones
            side_bands = []
        onset, ending = self.envelopes[number] if self.envelopes else (None, None)
        return Layer(
            excitation=excitation,
            fingers=stream.targets,
            side_bands=tuple(side_bands),
            ramp=contents.ramp(stream),
            onset=onset,
            ending=ending,
            drive_mode=contents.drive_mode,
            contrast_to_plate_db=self._contrast_to_plate_db,
            swings=contents.swings(stream),
        )

    def placement(self, layer: Layer) -> Placement:
        """Return the positions of the fingers of a layer, and of all others."""
        targets = [self.asked[number] for number in layer.fingers]
        others = [finger for number, finger in enumerate(self.asked) if number not in layer.fingers]
        return Placement(
            targets=tuple([finger.at for finger in targets]),
            quiet=tuple([finger.at for finger in others]),
            loads=tuple([finger.load for finger in (*targets, *others)]),
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
        """Return how far the layer with a given number is below its strongest stimulus [dB].

        The promised level of a continuous layer counts, and the nominal level of any other.
        """
        stream = self.contents.streams[number]
        level, promised_level = self.levels_db_sl(number, stream.targets[0])
        reached = promised_level if stream.duration is None else level
        reduction = -math.inf
        for finger in stream.targets:
            stimulus = self.asked[finger].stimulus
            if stimulus is not None:
                reduction = max(reduction, stimulus.level_db_sl - reached)
        return reduction if reduction > SAME_LEVEL else 0.0

    def pauses(self, number: int) -> bool:
        """Return whether the layer with a given number ends or is modulated, so that it masks
        nothing meanwhile."""
        stream = self.contents.streams[number]
        if stream.duration is not None:
            return True
        stimulus = self.asked[stream.targets[0]].stimulus
        if stimulus is None or stimulus.modulation_hz is None:
            return False
        return list(self.tones.owners).count(number) > 1

    @property
    def is_reached(self) -> bool:
        """Whether all vibrations have their nominal levels."""
        for stream in self.contents.streams:
            for finger in stream.targets:
                if self.tones.level_db_sl[finger][0] < stream.level_db_sl - _SHORT_OF:
                    return False
        return True

    @property
    def excitations(self) -> list[Excitation]:
        """All excitations that play together."""
        return [excitation for layer in self.layers for excitation in layer.excitations]

    @property
    def amplitudes(self) -> dict[str, float]:
        """Amplitude of each ERA [m], by name, of all excitations together."""
        return amplitudes_of(self.excitations)

    @property
    def promised_worst_db(self) -> float | None:
        """Promised contrast [dB] of the worst finger, None for a single finger."""
        return _none_for_nan(self.tones.worst_db)

    @property
    def lacks_contrast(self) -> bool:
        """Whether a finger has less contrast to others' vibrations than it requires."""
        for stream in self.contents.streams:
            for finger in stream.targets:
                promised = self.tones.contrast_db[finger][2]
                if promised < self.asked[finger].min_contrast_db:
                    return True
        return False

    @property
    def disturbed(self) -> list[int]:
        """Fingers, by number, with stronger vibrations of others than they allow."""
        disturbed = []
        levels_and_fingers = zip(self.tones.foreign_db_sl, self.asked, strict=False)
        for number, (levels_by_set, finger) in enumerate(levels_and_fingers):
            if levels_by_set[0] > finger.max_foreign_db_sl:
                disturbed.append(number)
        return disturbed

    @property
    def stroke_factor(self) -> float:
        """Fraction of the requested levels that the ERAs' stroke allows; 1 if it allows all."""
        return self.tones.stroke_factor

    @property
    def _contrast_to_plate_db(self) -> float | None:
        """Level of the weakest target relative to the rest of the plate [dB].

        None if there are other fingers.
        """
        background = self.contents.background
        if background is None:
            return None
        tones = self.tones
        power = _NO_POWER
        for row, weights, gain in zip(tones.rows, tones.weights, tones.gains, strict=True):
            drive = np.multiply(gain, weights)
            squared_acceleration = float(np.vdot(drive, background[row] @ drive).real)
            power += max(squared_acceleration, 0.0) / float(self.thresholds[row]) ** 2
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
        columns = defaultdict[str, list[Any]](list)
        for sensation in self.fingers:
            frequency = None
            if sensation.layer is not None:
                frequency = self.layers[sensation.layer].frequency
            x, y = sensation.finger.at
            row = {
                "x_m": x,
                "y_m": y,
                "verdict": sensation.verdict,
                "frequency_hz": frequency or math.nan,
                "promised_level_db_sl": sensation.promised_level_db_sl,
                "promised_contrast_db": sensation.promised_contrast_db,
                "rig_foreign_level_db_sl": sensation.rig_foreign_level_db_sl,
                "worst_foreign_level_db_sl": sensation.foreign_level_db_sl,
            }
            for name, value in row.items():
                columns[name].append(value)
        return as_frame(columns)


def _none_for_nan(value: float) -> float | None:
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
