"""Haptic intent: which contacts shall feel something, how strongly, and until when.

Intents are the interface between effects and playback. All other contacts are kept quiet.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np

from controller.sources.touch import Contact, ContactKey
from model.answer.stimulus import SHAPED_FROM, Course
from model.arrays import FloatArray, best_of
from model.finger import STRONG_DB_SL

_MIN_WAIT = 0.001  # s

# A pulse that has not started this long [s] after it was due has lost its touch.
_MAX_DELAY = 0.1

FADED_AFTER = 0.05
"""Time [s] after the end of a pulse or layer when none of it is left on any amplifier."""

MAX_DB_SL = 26.0
"""Upper bound of `as strongly as the neighbours allow`: twice a strong vibration."""

NO_CONTACTS = "no contact on the plate"

Band: TypeAlias = tuple[float, float]
"""Lowest and highest frequency [Hz]; equal ones stand for the nearest that a table has."""

Gains = Mapping[tuple[ContactKey, bool], float]
"""Strengths [dB], 0 at most, by contact, and by whether a short pulse or what lasts is meant."""

CLICK = -1
"""Voice of a short pulse; those of what lasts at the same finger begin with 0."""

_TOLERANCE = 0.05  # of a frequency; less than anyone tells apart


@dataclass(slots=True, unsafe_hash=True)
class Pulse:
    """A vibration of limited duration; pulses requested at different times differ.

    A pulse that is not started ends 0.1 s after it is due, or after its duration where that is
    more.
    """

    duration: float
    """[s], from its start."""
    requested_at: float
    """[s]"""
    is_raised: bool = True
    """Whether the drive is raised so that the level is felt over the duration, onset included; else
    the level is the steady one."""
    due_at: float = field(default=-math.inf, init=False, compare=False)
    """When [s] it is due, where it waits its turn; else it is due when it is requested."""
    started_at: float | None = field(default=None, init=False, compare=False)
    """When [s] the amplifiers were sent its commit; None before."""

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
    """A contact that shall feel something of its own."""

    key: ContactKey
    level_db_sl: float | None = STRONG_DB_SL
    """Level where the plate allows it; None for as strong as the neighbours allow."""
    pulse: Pulse | None = None
    """None without an end of its own."""
    band: Band | None = None
    priority: int = 0
    """Targets of lower priority give way first."""
    content: str | None = None
    """Name of the content. Fingers of one name may share a vibration where the plate cannot give
    each its own; without a name the content is this finger's alone."""
    is_own: bool = False
    """Whether it feels its own content or none."""
    may_share: bool = False
    """Whether it may also feel the content of any other finger that may share."""
    modulation_hz: float | None = None
    """Frequency [Hz] at which the strength of what lasts comes and goes."""
    above_db: float | None = None
    """Least level [dB] of a short pulse above what lasts at its finger; None for its own level."""
    course: Course | None = field(default=None, hash=False, repr=False)  # of thousands of points
    """Course from the start of the pulse on, again and again until that ends; None if steady."""

    @property
    def voice(self) -> int:
        """Its first voice; voices tell the contents of one finger apart."""
        return CLICK if self.is_short else 0

    @property
    def shared_as(self) -> str | bool | None:
        """A value that targets have in common if they may share a vibration; None if it may not."""
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
    """For each contact one that lasts, a short pulse, or both; contacts that are not on the plate
    are ignored."""
    reason: str = "no target"
    """Why there are no targets."""
    until: float = math.inf
    """When [s] the intent may change though no contact does."""
    protected: frozenset[ContactKey] = frozenset()
    """Contacts that must not notice the contents of others."""
    gains_db: Gains = field(default_factory=dict)
    """Strengths with which the contents of targets are played."""

    def due(self, now: float) -> float:
        """Return when [s] to query again, at least a millisecond from now; infinite for never."""
        return self.until if self.until > now else now + _MIN_WAIT


class IntentSource(Protocol):
    """A source of intents, queried when contacts change and when an intent expires."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return the intent for contacts in their order of arrival, at a time [s]; must not wait.

        All channels are silent while it raises.
        """


def band_of_table(band: Band, frequencies: FloatArray) -> Band:
    """Return a band [Hz] that has frequencies of a table: itself, or the nearest of them alone."""
    low, high = band
    if low < high and ((frequencies >= low) & (frequencies <= high)).any():
        return band
    middle = np.sqrt(low * high)
    nearest = float(frequencies[best_of(-np.abs(np.log(frequencies / middle)))])
    return nearest, nearest


def band_problem(band: Band, frequencies: FloatArray) -> str | None:
    """Return a warning if a table of frequencies [Hz] has none in or near a band."""
    low, high = band
    nearest = band_of_table(band, frequencies)[0]
    if low * (1 - _TOLERANCE) <= nearest <= high * (1 + _TOLERANCE):
        return None
    given = f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"
    return f"frequency {given} is not in the table, which plays {nearest:g} Hz instead"
