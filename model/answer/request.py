"""Requests: what each finger is to feel, and the answer to all of them together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from model.answer.question import MAX_LEVEL_DB_SL, MIN_LEVEL_DB_SL, check_on_plate
from model.answer.search import Contents, Tones
from model.arguments import expect_number, shown
from model.arrays import FloatArray, Point
from model.drive_modes import UNRESTRICTED
from model.drive_modes.tones import excitation_of
from model.errors import InputError
from model.files.csv_file import as_frame
from model.finger import MAX_CONTACTS
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import STRONG_DB_SL
from model.structure.attachments import Era, check_loads
from model.structure.plate import Plate
from model.vibration.excitation import Excitation

APART_HZ = 30.0
"""Distance of the frequencies of two contents: nearer ones would be felt to beat."""

MIN_CONTRAST_DB, OWN_CONTRAST_DB = 6.0, 12.0
"""Promised contrast from which a content is served, and from which it is a finger's own."""

MIN_MODULATION, MAX_MODULATION = 10.0, 30.0
"""Modulations that side bands play [Hz]; slower ones are changes of level."""

ANY_BAND = (0.0, math.inf)


@dataclass(frozen=True)
class Request:
    """A finger at a place [m], and the content that it is to feel.

    band_hz: lowest and highest frequency of the content; level_db_sl: its level; priority: lower
    ones give way first; may_share: whether the content may be that of the nearest finger that may
    share, too; content: a name, fingers of one name may share; is_protected: whether the finger
    keeps the others' contents away where its own is given up; load: of the finger relative to the
    rig's fingertip; min_contrast_db: promised contrast to the contents of others below which
    contents give way; max_foreign_db_sl: level of others' contents at the finger that nine of ten
    plates do not exceed, else these are held back; modulation_hz: how often a second the strength
    of the content comes and goes, MIN_MODULATION to MAX_MODULATION, None for a steady one.
    """

    at: Point
    band_hz: tuple[float, float] = ANY_BAND
    level_db_sl: float = STRONG_DB_SL
    priority: int = 0
    may_share: bool = False
    is_protected: bool = True
    load: float = 1.0
    content: str | None = None
    min_contrast_db: float = -math.inf
    max_foreign_db_sl: float = math.inf
    modulation_hz: float | None = None

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table."""
        _check_pair(self.at, what="place of a finger", such_as="(0.08, 0.06), x and y in metres")
        _check_pair(self.band_hz, what="band", such_as="(40, 120), lowest and highest in Hz")
        expect_number(self.level_db_sl, what="level", unit="dB SL")
        expect_number(self.load, what="load", unit="times the rig's fingertip")
        low, high = self.band_hz
        if not 0 <= low <= high:  # False for NaN
            raise InputError(
                f"band of ({self.at[0]:g}, {self.at[1]:g}) m must be from a lowest to a highest "
                f"frequency in Hz, got {low:g} to {high:g}"
            )
        if not MIN_LEVEL_DB_SL <= self.level_db_sl <= MAX_LEVEL_DB_SL:
            raise InputError(
                f"level must be between {MIN_LEVEL_DB_SL:g} and {MAX_LEVEL_DB_SL:g} dB SL, got "
                f"{self.level_db_sl:g}"
            )
        if isinstance(self.priority, bool) or not isinstance(self.priority, int):
            raise InputError(f"priority must be a whole number, got {self.priority!r}")
        if not (self.content is None or isinstance(self.content, str)):
            raise InputError(f"content must be a name, got {shown(self.content)}")
        _check_bound(self.min_contrast_db, what="min_contrast_db", unit="dB")
        _check_bound(self.max_foreign_db_sl, what="max_foreign_db_sl", unit="dB SL")
        if self.modulation_hz is not None:
            expect_number(self.modulation_hz, what="modulation_hz", unit="Hz")
            if not MIN_MODULATION <= self.modulation_hz <= MAX_MODULATION:
                raise InputError(
                    f"modulation_hz must be from {MIN_MODULATION:g} to {MAX_MODULATION:g} Hz, got "
                    f"{self.modulation_hz:g}"
                )

    def may_feel_one_with(self, other: "Request") -> bool:
        """Whether both fingers may feel one content."""
        is_same = self.content is not None and self.content == other.content
        return is_same or (self.may_share and other.may_share)


@dataclass(frozen=True)
class Finger:
    """A finger at a place [m] that is to feel nothing.

    load: relative to the rig's fingertip; max_foreign_db_sl: as of `Request`.
    """

    at: Point
    load: float = 1.0
    max_foreign_db_sl: float = math.inf

    def __post_init__(self) -> None:
        """Check the types."""
        _check_pair(self.at, what="place of a finger", such_as="(0.08, 0.06), x and y in metres")
        expect_number(self.load, what="load", unit="times the rig's fingertip")
        _check_bound(self.max_foreign_db_sl, what="max_foreign_db_sl", unit="dB SL")


def _check_bound(given: float, *, what: str, unit: str) -> None:
    """Raise InputError for anything but a number, which may be infinite."""
    expect_number(given, what=what, unit=unit)
    if math.isnan(given):
        raise InputError(f"{what} must be a number of {unit}, got {given}")


def _check_pair(given: object, *, what: str, such_as: str) -> None:
    """Raise InputError for anything but two numbers."""
    pair = given if isinstance(given, Sequence | np.ndarray) else ()
    if len(pair) != 2 or not (isinstance(pair[0], Real) and isinstance(pair[1], Real)):
        raise InputError(f"{what} must be two numbers such as {such_as}, got {shown(given)}")


@dataclass(frozen=True)
class Layer:
    """What is played for one request, with what its finger feels.

    excitation: of all ERAs, empty where it is held back; level_db_sl, promised_level_db_sl: as
    modelled, and what nine of ten plates give; felt_contrast_db, median_felt_contrast_db,
    promised_contrast_db: level of the content above that of all others at this finger, or above
    its own at the loudest quiet finger where it is the only content: nominal, and that of half
    and of nine of ten plates, None where there is nothing to compare with; foreign_level_db_sl: of
    all other contents at this finger, which nine of ten plates do not exceed; verdict: `own`,
    `mixed` (below OWN_CONTRAST_DB), `shared` (the content of another finger) or `held back`, which
    has the contrast that it would have had; is_disturbing: whether that is because of a finger's
    max_foreign_db_sl; side_bands: excitations beside it of a content that is modulated.
    """

    request: Request
    excitation: Excitation
    verdict: str
    level_db_sl: float = -math.inf
    promised_level_db_sl: float = -math.inf
    felt_contrast_db: float | None = None
    median_felt_contrast_db: float | None = None
    promised_contrast_db: float | None = None
    foreign_level_db_sl: float | None = None
    is_disturbing: bool = False
    side_bands: tuple[Excitation, ...] = ()

    @property
    def frequency(self) -> float | None:
        """The frequency of the content, without its side bands [Hz]; None where nothing plays."""
        return next((tone.frequency for tone in self.excitation.values()), None)


@dataclass(frozen=True)
class QuietFinger:
    """What a finger at a place [m] that is to feel nothing feels.

    felt_contrast_db, promised_contrast_db: level of the weakest content at its own finger above
    that of all contents here; level_db_sl: of these, which nine of ten plates do not exceed.
    """

    at: Point
    felt_contrast_db: float
    promised_contrast_db: float
    level_db_sl: float


@dataclass(frozen=True, eq=False)
class Answer:
    """What is played for the requests of all fingers, and what is promised of all together.

    fingers: those that are to feel nothing, numbered after the requests; contents: that are played,
    and who is kept quiet; tones: of these; held: contents given up, by request, with the contrast
    that they would have had, and whether they would disturb a finger; applied: what was changed in
    the requests, in words; eras, frequencies [Hz]: of the table.
    """

    requests: tuple[Request, ...]
    fingers: tuple[Finger, ...]
    contents: Contents
    tones: Tones
    held: tuple[tuple[int, float, bool], ...]
    applied: tuple[str, ...]
    eras: tuple[Era, ...]
    frequencies: FloatArray

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """What is played for each request, with what its finger feels."""
        found, tones = dict[int, Layer](), self.tones
        for number, stream in enumerate(self.contents.streams):
            carrier, *sides = self._excitations(number)
            for finger in stream.targets:
                felt, median, promised = map(_known, tones.contrast_db[finger])
                level, promised_level = tones.level_db_sl[finger]
                is_shared = finger != stream.targets[0]
                found[finger] = Layer(
                    self.requests[finger],
                    carrier,
                    "shared" if is_shared else verdict_of(promised),
                    level,
                    promised_level,
                    felt,
                    median,
                    promised,
                    _known(tones.foreign_db_sl[finger]),
                    side_bands=tuple(sides),
                )
        for finger, had, is_disturbing in self.held:
            found[finger] = Layer(
                self.requests[finger],
                {},
                "held back",
                promised_contrast_db=had,
                foreign_level_db_sl=_known(tones.foreign_db_sl[finger]),
                is_disturbing=is_disturbing,
            )
        return tuple(found[number] for number in range(len(self.requests)))

    @property
    def quiet(self) -> tuple[QuietFinger, ...]:
        """What quiet fingers feel."""
        figures = zip(self.tones.contrast_db, self.tones.foreign_db_sl, strict=True)
        felt = [*figures][len(self.requests) :]
        return tuple(
            QuietFinger(each.at, contrast[0], contrast[2], level)
            for each, (contrast, level) in zip(self.fingers, felt, strict=True)
        )

    @property
    def promised_worst_db(self) -> float | None:
        """The least contrast of all fingers, on nine of ten plates; None for one finger alone."""
        return _known(self.tones.worst_db)

    @property
    def lacks_contrast(self) -> bool:
        """Whether a finger has less contrast to others' contents than its request asks for."""
        targets = [finger for stream in self.contents.streams for finger in stream.targets]
        found, requests = self.tones.contrast_db, self.requests
        return any(found[each][2] < requests[each].min_contrast_db for each in targets)

    @property
    def disturbed(self) -> list[int]:
        """Fingers, by number, that would feel more of others' contents than they allow."""
        bounds = [each.max_foreign_db_sl for each in self.requests]
        bounds += [each.max_foreign_db_sl for each in self.fingers]
        levels = enumerate(zip(self.tones.foreign_db_sl, bounds, strict=True))
        return [finger for finger, (level, bound) in levels if level > bound]

    @property
    def stroke_factor(self) -> float:
        """Of the requested levels what the ERAs' stroke allows, 1 for all."""
        return self.tones.stroke_factor

    def _excitations(self, content: int) -> list[Excitation]:
        """The tones of a content, its carrier first."""
        tones, on = self.tones, (self.eras, self.frequencies)
        every = zip(tones.rows, tones.weights, tones.gains, tones.owners, strict=True)
        own = [(row, weights, gain) for row, weights, gain, owner in every if owner == content]
        if self.contents.drive_mode != UNRESTRICTED:  # tones that make one vibration
            drive = [(row, weights) for row, weights, _ in own]
            return [excitation_of(drive, *on, gain=own[0][2])]
        return [excitation_of([(row, weights)], *on, gain=gain) for row, weights, gain in own]

    def to_frame(self) -> Any:
        """What each request's finger feels as a pandas DataFrame, a row a finger; needs pandas."""
        at = np.array([layer.request.at for layer in self.layers])
        return as_frame(
            {
                "x_m": at[:, 0],
                "y_m": at[:, 1],
                "verdict": [layer.verdict for layer in self.layers],
                "frequency_hz": [layer.frequency or math.nan for layer in self.layers],
                "promised_level_db_sl": [layer.promised_level_db_sl for layer in self.layers],
                "promised_contrast_db": [layer.promised_contrast_db for layer in self.layers],
                "foreign_level_db_sl": [layer.foreign_level_db_sl for layer in self.layers],
            }
        )


def _known(figure: float) -> float | None:
    """A figure, None for one that there is not."""
    return None if math.isnan(figure) else figure


def verdict_of(promised_contrast_db: float | None) -> str:
    """Return whether a content of a contrast is a finger's own or mixed with others."""
    is_own = promised_contrast_db is None or promised_contrast_db >= OWN_CONTRAST_DB
    return "own" if is_own else "mixed"


def check_requests(requests: Sequence[Request], fingers: Sequence[Finger], plate: Plate) -> None:
    """Raise InputError for requests that contradict each other or are not on the plate."""
    if not requests:
        raise InputError("an answer must have at least one request, got none")
    every: list[Request | Finger] = [*requests, *fingers]
    if len(every) > MAX_CONTACTS:
        raise InputError(f"an answer must have up to {MAX_CONTACTS} fingers, got {len(every)}")
    check_loads([each.load for each in every])
    check_on_plate("finger", [each.at for each in every], plate)
    for number, finger in enumerate(every):
        x, y = finger.at
        for other in every[:number]:
            if math.dist(other.at, finger.at) < FINGERTIP_RADIUS:
                raise InputError(
                    f"finger ({x:g}, {y:g}) m must be at least {1000 * FINGERTIP_RADIUS:g} mm "
                    f"from the one at ({other.at[0]:g}, {other.at[1]:g}) m"
                )
