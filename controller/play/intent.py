"""Haptic intents: the contacts that get a vibration, how strong it is and until when it plays.

An intent is the interface between effects and playback; all contacts without a target are kept
quiet.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from controller.sources.touch import Contact, ContactKey
from model.answer.envelope import SHAPED_FROM, Course
from model.arrays import FloatArray, best_of
from model.finger import STRONG_DB_SL

_MIN_WAIT = 0.001  # s

# A pulse that has not started this long [s] after it was due has lost its touch.
_MAX_DELAY = 0.1

FADED_AFTER = 0.05
"""Time [s] from the end of a pulse or layer until it has faded on every amplifier."""

MAX_DB_SL = 26.0
"""Upper bound of `as strongly as the neighbors allow`: twice a strong vibration."""

NO_CONTACTS = "no contact on the plate"

Band: TypeAlias = tuple[float, float]
"""Lowest and highest frequency [Hz]; if they are equal, the nearest frequency of the table."""

Gains = Mapping[tuple[ContactKey, bool], float]
"""Strengths [dB], 0 at most, by contact and by whether they apply to its short pulses or to its
lasting content."""

CLICK = -1
"""Voice of a short pulse; the voices of the same finger's lasting content begin with 0."""

_TOLERANCE = 0.05  # relative; smaller differences of frequency are not felt


@dataclass(slots=True, unsafe_hash=True)
class Pulse:
    """A vibration of limited duration; pulses requested at different times differ.

    A pulse that has not started ends 0.1 s after it is due, or after its duration if that is
    longer.
    """

    duration: float
    """[s], from its start."""
    requested_at: float
    """[s]"""
    is_raised: bool = True
    """Whether the drive is raised to reach the level over the duration, onset included; otherwise
    the level applies to the steady vibration."""
    due_at: float = field(default=-math.inf, init=False, compare=False)
    """When [s] a pulse that waits its turn is due; other pulses are due when requested."""
    started_at: float | None = field(default=None, init=False, compare=False)
    """When [s] its commit was sent to the amplifiers; None before."""

    @property
    def start(self) -> float:
        """When [s] its duration starts, as far as known."""
        if self.started_at is None:
            return max(self.requested_at, self.due_at)
        return self.started_at

    @property
    def end(self) -> float:
        """When [s] it ends, as far as known."""
        if self.started_at is None:
            return self.start + max(self.duration, _MAX_DELAY)
        return self.start + self.duration

    @property
    def is_short(self) -> bool:
        """Whether it ends before a shaped onset would have settled."""
        return self.duration < SHAPED_FROM


@dataclass(frozen=True, slots=True)
class Target:
    """A contact with the vibration intended for it."""

    key: ContactKey
    level_db_sl: float | None = STRONG_DB_SL
    """Level if the plate allows it; None for as strong as the neighbors allow."""
    pulse: Pulse | None = None
    """Limits its duration; None for a vibration without an end of its own."""
    band: Band | None = None
    priority: int = 0
    """Targets of lower priority give way first."""
    content: str | None = None
    """Name of the content. If the plate cannot give each finger a vibration, fingers with contents
    of the same name can share one; a content without a name is never shared."""
    is_own: bool = False
    """Whether it feels its own content or none."""
    may_share: bool = False
    """Whether it can also feel the content of any other finger that may share."""
    modulation_hz: float | None = None
    """Frequency [Hz] at which the strength of a lasting content is modulated."""
    above_db: float | None = None
    """Minimum level [dB] of a short pulse above the lasting content of its finger; None for no
    minimum."""
    course: Course | None = field(default=None, hash=False, repr=False)  # thousands of points
    """Course from the start of the pulse, repeated until the pulse ends; None if steady."""

    @property
    def voice(self) -> int:
        """Its first voice; voices distinguish contents at the same finger."""
        if self.is_short:
            return CLICK
        return 0

    @property
    def shared_as(self) -> str | bool | None:
        """A value that is equal for targets that may share a vibration; None if it may not."""
        if self.is_short or self.is_own or self.course:
            return None
        return self.may_share or self.content

    @property
    def is_short(self) -> bool:
        """Whether it is a short pulse."""
        return self.pulse is not None and self.pulse.is_short and self.course is None


@dataclass(frozen=True)
class HapticIntent:
    """Targets and their levels at one moment."""

    targets: tuple[Target, ...]
    """For each contact a lasting content, a short pulse, or both; contacts that are not on the
    plate are ignored."""
    reason: str = "no target"
    """Why there are no targets."""
    until: float = math.inf
    """When [s] the intent can change without a change of contacts."""
    protected: frozenset[ContactKey] = frozenset()
    """Contacts that must not notice the contents of others."""
    gains_db: Gains = field(default_factory=dict)
    """Strengths with which the contents of targets are played."""

    def due(self, now: float) -> float:
        """Return when [s] to query again, at least a millisecond from now; infinite for never."""
        if self.until > now:
            return self.until
        return now + _MIN_WAIT


class IntentSource(Protocol):
    """A source of intents, queried when contacts change and when an intent expires."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return the intent for contacts in their order of arrival, at a time [s]; must not wait.

        All channels are silent while it raises.
        """

    def has_effect_at(self, contact: Contact) -> bool:
        """Whether a contact that comes down here starts an effect."""


def band_of_table(band: Band, frequencies: FloatArray) -> Band:
    """Return a band [Hz] with frequencies of a table: the band itself, or the nearest frequency."""
    low, high = band
    if low < high and ((frequencies >= low) & (frequencies <= high)).any():
        return band
    middle = np.sqrt(low * high)
    distances = np.abs(np.log(frequencies / middle))
    nearest = float(frequencies[best_of(-distances)])
    return nearest, nearest


def band_problem(band: Band, frequencies: FloatArray) -> str | None:
    """Return a warning unless one of a table's frequencies [Hz] is in or near a band."""
    low, high = band
    nearest = band_of_table(band, frequencies)[0]
    if low * (1 - _TOLERANCE) <= nearest <= high * (1 + _TOLERANCE):
        return None
    band_text = f"{low:g} to {high:g} Hz"
    if low == high:
        band_text = f"{low:g} Hz"
    return f"frequency {band_text} is not in the table, which plays {nearest:g} Hz instead"


class FingerTarget(NamedTuple):
    """A contact on the plate, and the vibration intended for it."""

    contact: Contact
    target: Target


Targets = tuple[FingerTarget, ...]


def contacts_of(targets: Targets) -> list[Contact]:
    """Return the contacts of targets."""
    return [finger.contact for finger in targets]


def pulses_of(targets: Targets) -> list[Pulse]:
    """Return the pulses of targets with a limited duration."""
    return [target.pulse for _, target in targets if target.pulse is not None]
