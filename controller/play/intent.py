"""Haptic intent: which contacts shall feel something, how strongly, and until when.

The interface between the meaning of touches and their playback. All other contacts are kept quiet.
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
"""After the end of a pulse, or of a layer, by so long [s] none of it is left on any amplifier."""

MAX_DB_SL = 26.0
"""Upper bound of `as strongly as the neighbours allow`: twice a strong vibration."""

NO_CONTACTS = "no contact on the plate"

Band: TypeAlias = tuple[float, float]
"""Lowest and highest frequency [Hz]; equal ones stand for the nearest that a table has."""

Gains = Mapping[tuple[ContactKey, bool], float]
"""Strengths [dB], 0 at most, of what is felt by a contact, and whether that is a short pulse."""

CLICK = -1
"""Voice of a short pulse, which plays beside what lasts at its finger: that begins with 0."""

_TOLERANCE = 0.05  # of a frequency; less than anyone tells apart


@dataclass(slots=True, unsafe_hash=True)
class Pulse:
    """A vibration of limited duration [s], requested at a time [s]; a later one is another.

    Its duration counts from started_at [s], when the amplifiers have been sent its commit. Without
    that it ends 0.1 s after it is due, or after its duration where that is more; it is due at
    requested_at, or at due_at [s] where it waits its turn. is_raised: whether the drive is raised
    so that the level is felt over the duration, onset included; else the level is the steady one.
    """

    duration: float
    requested_at: float
    is_raised: bool = True
    due_at: float = field(default=-math.inf, init=False, compare=False)
    started_at: float | None = field(default=None, init=False, compare=False)

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
    """A contact that shall feel something of its own.

    level_db_sl: how strongly, where the plate can; None for as strongly as the neighbours allow.
    pulse: None without an end of its own. priority: lower ones give way first. content: a name;
    fingers of one name may share one vibration where the plate cannot give each its own. None: of
    this one alone. is_own: whether it feels its own content or none; may_share: whether it may also
    feel that of any finger that may share. modulation_hz: how often a second the strength of what
    lasts comes and goes. above_db: by how much at least a short pulse is above what lasts at its
    finger; None as strong as its level says. course: along which it is felt from the start of its
    pulse on, None for steadily; it begins anew until the pulse ends.
    """

    key: ContactKey
    level_db_sl: float | None = STRONG_DB_SL
    pulse: Pulse | None = None
    band: Band | None = None
    priority: int = 0
    content: str | None = None
    is_own: bool = False
    may_share: bool = False
    modulation_hz: float | None = None
    above_db: float | None = None
    course: Course | None = field(default=None, hash=False, repr=False)  # of thousands of points

    @property
    def voice(self) -> int:
        """The first of its voices, by which layers tell the contents of one finger apart."""
        return CLICK if self.is_short else 0

    @property
    def shared_as(self) -> str | bool | None:
        """Equal for contacts that may feel one vibration that lasts; None for its own alone."""
        if self.is_short or self.is_own or self.course:
            return None
        return self.may_share or self.content

    @property
    def is_short(self) -> bool:
        """Whether it is a short pulse."""
        return self.pulse is not None and self.pulse.is_short and self.course is None


@dataclass(frozen=True)
class HapticIntent:
    """Targets and their levels at one moment.

    targets: of each contact one that lasts, a short pulse, or both at once; those that are not on
    the plate are ignored. reason: why there are
    none. until: when [s] the intent may change though no contact has. protected: contacts that must
    not notice the contents of others. gains_db: by which what is chosen for targets is played
    weaker.
    """

    targets: tuple[Target, ...]
    reason: str = "no target"
    until: float = math.inf
    protected: frozenset[ContactKey] = frozenset()
    gains_db: Gains = field(default_factory=dict)

    def due(self, now: float) -> float:
        """Return when [s] to query again, at least a millisecond from now; infinite for never."""
        return self.until if self.until > now else now + _MIN_WAIT


class IntentSource(Protocol):
    """Where intents come from; queried when contacts change and when an intent expires."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return the intent for contacts in their order of arrival, at a time [s], at once.

        While it raises, all channels are silent.
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
    """Return what a table with these frequencies [Hz] plays instead of a band that it lacks."""
    low, high = band
    nearest = band_of_table(band, frequencies)[0]
    if low * (1 - _TOLERANCE) <= nearest <= high * (1 + _TOLERANCE):
        return None
    given = f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"
    return f"frequency {given} is not in the table, which plays {nearest:g} Hz instead"
