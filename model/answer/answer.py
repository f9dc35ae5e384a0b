"""What is played for fingers, and what each of them feels."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from model.answer.fingers import ANY_BAND, Finger, Placement
from model.answer.over_duration import ONSET_RAMP, pulse_ramp, swings_of_pulse
from model.answer.search import Contents, Tones
from model.arrays import Float32Array, FloatArray
from model.drive_modes import UNRESTRICTED
from model.files.csv_file import as_frame
from model.finger import decibels
from model.structure.attachments import Source
from model.table.table import LocalizationTable
from model.transients.base_motion import Envelopes
from model.transients.swings import Swing
from model.vibration import Excitation

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
