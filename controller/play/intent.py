"""Haptic intents, and the contents of layers that are chosen for them.

An intent says which contacts shall feel something, how strongly, and until when: it is the
interface between effects and playback. All other contacts are kept quiet. A content is what a layer
plays, for its own finger and those that share it; predictions say what fingers feel of it, and a
selection has the contents of all fingers. A question asks for the contents of some.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, TypeAlias

import numpy as np

from controller.sources.touch import Contact, ContactKey
from model.answer.answer import HELD_BACK, MIXED, OWN, Layer, is_felt, verdict_of
from model.answer.stimulus import SHAPED_FROM, Course, Placement
from model.arrays import FloatArray, best_of
from model.finger import STRONG_DB_SL, detection_threshold, fingertips_on
from model.structure.attachments import with_patches
from model.table.table import LocalizationTable

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


Targets = tuple[tuple[Contact, Target], ...]

BEING_CHOSEN = "what it shall feel is being chosen; wait a moment"


@dataclass(frozen=True)
class Prediction:
    """The predicted sensation of a finger that is to feel something.

    Contrasts and foreign levels are None where there is nothing to compare with.
    """

    contact: Contact
    """As it was when the content was chosen."""
    level_db_sl: float | None
    """Over the duration of the effect, onset included, or the steady level where it has none."""
    contrast_db: float | None = None
    """Nominal contrast to the loudest quiet finger, or to the contents of others here."""
    verdict: str = OWN
    """Whether the finger feels its own content, that mixed, that of another finger, or none."""
    held_back: str | None = None
    """Why it does not feel its own content; None if it does."""
    promised_contrast_db: float | None = None
    """The contrast that nine of ten plates reach."""
    foreign_level_db_sl: float | None = None
    """Level of others' contents here that nine of ten plates do not exceed."""
    frequency: float | None = None
    """[Hz]; None where several or none play."""
    content: str | None = None
    """Name of what the finger feels."""
    nominal_db_sl: float | None = None
    """Level of that on the plate as modelled."""
    pauses: bool = False
    """Whether the content ends, or comes and goes."""
    is_apart: bool = True
    """Whether all that others feel is at least 30 Hz away."""

    @property
    def is_foreign_felt(self) -> bool:
        """Whether others' contents may be felt here."""
        return is_felt(self.foreign_level_db_sl)

    def judged(self) -> "Prediction":
        """Return the prediction with its verdict by its figures, if it has a content of its own."""
        if self.verdict not in (OWN, MIXED):
            return self
        verdict = verdict_of(
            self.promised_contrast_db, self.foreign_level_db_sl, pauses=self.pauses
        )
        return replace(self, verdict=verdict if self.is_apart else MIXED)

    def beside(
        self, others: Sequence[float], total: Sequence[float], above: Sequence[float] = (0.0,)
    ) -> "Prediction":
        """Return the prediction with other contents besides, whose powers add.

        The worst set of thresholds counts. others: levels [dB SL] of these contents by set; total:
        levels of all that is foreign here; above: own level by set [dB], relative to the rig's set.
        """
        level, contrast = self.level_db_sl, self.promised_contrast_db
        found = replace(self, foreign_level_db_sl=max(total))
        if level is None:
            return found
        own = [level + each for each in above]
        least, background = math.inf if contrast is None else contrast, total
        if contrast is not None and self.foreign_level_db_sl is not None:  # else to quiet fingers
            background = sums_db([[each - contrast for each in own], others])
        contrasts = [one - each for one, each in zip(own, background, strict=True)]
        return replace(found, promised_contrast_db=min(least, *contrasts)).judged()

    def weakened(self, gain_db: float, others_db: float) -> "Prediction":
        """Return the prediction with a gain [dB]; others_db: the highest on others' contents.

        Contrasts are lower bounds.
        """
        gains = {
            **dict.fromkeys(("level_db_sl", "nominal_db_sl"), gain_db),
            **dict.fromkeys(("contrast_db", "promised_contrast_db"), min(gain_db - others_db, 0.0)),
            "foreign_level_db_sl": others_db,
        }
        found: Prediction = replace(
            self,
            **{
                key: level + gains[key]
                for key in gains
                if (level := getattr(self, key)) is not None
            },
        )
        if (found.level_db_sl or 0.0) < 0 <= (self.level_db_sl or 0.0):
            return replace(
                found,
                verdict=HELD_BACK,
                held_back=f"a strength of {gain_db:g} dB leaves it below the threshold; raise it",
            )
        return found.judged()


@dataclass(frozen=True)
class Content:
    """The content of one layer, with the contacts as they were when it was chosen."""

    key: tuple[ContactKey, int]
    """Its finger, and its voice: CLICK for a short pulse, 0 for a content that lasts, or the number
    of a side band of that, which has no predictions."""
    targets: Targets
    """Its finger, then those that share it."""
    placement: Placement
    """Where these fingers are, and all others."""
    layer: Layer
    predictions: tuple[Prediction, ...] = field(default=(), compare=False)
    """One for each target; they also depend on other contents."""
    gain_db: float = 0.0
    """Strength of its fingers, included in the layer."""
    is_led: bool = field(default=False, compare=False)
    """Whether it takes the place of another content of its finger along a cross-fade."""

    @property
    def frequency(self) -> float | None:
        """Its frequency [Hz]; None where there are several."""
        return self.layer.frequency

    @property
    def course(self) -> tuple[Course, Pulse] | None:
        """Its course and pulse; None for a steady content."""
        target = self.targets[0][1]
        if target.course is None or target.pulse is None:
            return None
        return target.course, target.pulse


@dataclass(frozen=True)
class Selection:
    """The contents of some contacts, or the reason for silence."""

    targets: Targets
    """Contacts that are to feel something, as they were when the contents were chosen."""
    quiet: tuple[Contact, ...]
    """The other contacts, as they were then."""
    contents: tuple[Content, ...] = ()
    reason: str | None = None
    """Why there are no contents."""
    not_served: tuple[Prediction, ...] = ()
    """Predictions for targets that feel nothing, with the reasons."""
    is_pending: bool = False
    """Whether the contents of some targets are still being chosen."""
    foreign_levels: Mapping[ContactKey, Sequence[float]] = field(default_factory=dict)
    """Levels [dB SL] of others' contents at contacts, by set of thresholds; nine of ten plates do
    not exceed them."""
    protected: frozenset[ContactKey] = frozenset()
    """Contacts that must not notice the contents of others."""
    is_limited: bool = field(default=False, compare=False)
    """Whether it has only the limits that pulses leave which play beside it."""

    @cached_property
    def contacts(self) -> dict[ContactKey, Contact]:
        """All contacts as they were then."""
        found = {each.key: each for each in self.quiet}
        for contact, _ in self.targets:
            found[contact.key] = contact
        return found

    @cached_property
    def target_keys(self) -> set[ContactKey]:
        """Contacts of the targets."""
        return {contact.key for contact, _ in self.targets}

    @property
    def pulses(self) -> list[Pulse]:
        """The pulses of the targets."""
        return [target.pulse for _, target in self.targets if target.pulse is not None]

    @cached_property
    def is_whole(self) -> bool:
        """Whether every target feels its own, so that others gain nothing when one leaves."""
        is_each_alone = all(len(content.targets) == 1 for content in self.contents)
        return bool(self.contents) and is_each_alone and not self.not_served

    def weakened(self, gains_db: Gains) -> "Selection":
        """Return the selection with the strengths of fingers; a shared content has the lowest."""
        if not (self.contents and any(gains_db.values())):
            return self
        gains = {
            each.targets: min(
                0.0,
                *[gains_db.get((at.key, to.is_short), 0.0) for at, to in each.targets],
            )
            for each in self.contents
        }
        contents = []
        for each in self.contents:
            gain = gains[each.targets]
            others = [other for targets, other in gains.items() if targets != each.targets]
            loudest = max(others, default=gain)
            felt = tuple([one.weakened(gain, loudest) for one in each.predictions])
            scaled = each.layer.scaled(gain)
            contents.append(replace(each, layer=scaled, predictions=felt, gain_db=gain))
        loudest = max(gains.values())
        levels = {
            key: [level + loudest for level in by_set]
            for key, by_set in self.foreign_levels.items()
        }
        return replace(self, contents=tuple(contents), foreign_levels=levels)

    def without(self, contents: Sequence["Content"], reason: str) -> "Selection":
        """Return the selection without some contents, whose targets feel nothing for a reason."""
        held_back = dict.fromkeys(contact for each in contents for contact, _ in each.targets)
        left = tuple(each for each in self.contents if each not in contents)
        return replace(
            self,
            contents=left,
            reason=self.reason if left else reason,
            not_served=(
                *self.not_served,
                *[not_served(contact, reason) for contact in held_back],
            ),
        )

    def beside(self, others: Sequence["Selection"], table: LocalizationTable) -> "Selection":
        """Return the selection with the foreign levels of others that play beside it.

        table: has the sets of thresholds.
        """
        levels = {key: foreign_at(key, others) for key in self.target_keys}
        levels = {
            key: each for key, each in levels.items() if max(each, default=-math.inf) > -math.inf
        }
        if not levels:
            return self
        total = {**self.foreign_levels}
        total |= {key: foreign_at(key, (self, *others)) for key in levels}

        def together(each: Prediction, above: Sequence[float] = (0.0,)) -> Prediction:
            key = each.contact.key
            return each.beside(levels[key], total[key], above) if key in levels else each

        contents = []
        for one in self.contents:
            above = [*map(float, table.levels_by_set(0.0, one.layer.excitation))]
            felt = [together(each, above) for each in one.predictions]
            contents.append(replace(one, predictions=tuple(felt)))
        return replace(
            self,
            contents=tuple(contents),
            not_served=tuple(map(together, self.not_served)),
            foreign_levels=total,
        )

    @property
    def predictions(self) -> tuple[Prediction, ...]:
        """A prediction for each target, those that feel nothing at the end.

        A finger with two contents has that of its short pulse; if one is not served, that of the
        other with the reason.
        """
        found = {each.contact.key: each for one in self.contents for each in one.predictions}
        for each in self.not_served:
            felt = found.get(each.contact.key)
            found[each.contact.key] = (
                each if felt is None else replace(felt, held_back=each.held_back)
            )
        return tuple(found.values())


NOTHING = Selection((), ())
"""The selection of no contents."""

_SOON = 5.0  # s; longer courses take longer to answer than the control loop may wait


@dataclass(frozen=True)
class Question:
    """The targets that contents are to be chosen for, among all contacts, and what plays."""

    contacts: tuple[Contact, ...]
    """All on the plate."""
    lasting: Targets
    """Targets of contents that last."""
    short: Targets
    """Targets of short pulses."""
    protected: frozenset[ContactKey] = frozenset()
    """Contacts that must not notice the contents of others."""
    before: Mapping[tuple[ContactKey, int], Content] = field(default_factory=dict)
    """Contents that are felt now, by finger and voice."""
    kept: tuple[Selection, ...] = ()
    """Selections that play on beside the new ones."""
    is_rested: bool = False
    """Whether what plays would do, too, but may be led to what promises more."""
    now: float = math.inf
    """[s]"""
    fading: Selection = NOTHING
    """What played before a cross-fade that goes on."""

    @cached_property
    def is_alone(self) -> bool:
        """Whether what lasts is one, steady, beside no other finger that is protected."""
        if len(self.lasting) != 1:
            return False
        ((contact, target),) = self.lasting
        return self.protected <= {contact.key} and target.modulation_hz is None

    @cached_property
    def takes_long(self) -> bool:
        """Whether what lasts takes longer than the control loop may wait."""
        if self.lasting and not self.is_alone:
            return True
        courses = [each.course for _, each in self.lasting if each.course is not None]
        return bool(courses) and max([each.duration for each in courses]) > _SOON

    def quiet_beside(self, targets: Targets) -> tuple[Contact, ...]:
        """Return the contacts that are not among some targets."""
        quiet = [*self.contacts]
        for contact, _ in targets:
            quiet.remove(contact)
        return tuple(quiet)

    def silent(self, targets: Targets, reason: str) -> Selection:
        """Return the selection of targets that feel nothing, for a reason."""
        skipped = tuple(not_served(contact, reason) for contact, _ in targets)
        quiet = self.quiet_beside(targets)
        return Selection(targets, quiet, (), reason, skipped, protected=self.protected)

    def unanswered(self, reason: str) -> tuple[Selection, ...]:
        """Return selections in place of those not made: silence, unless what plays would do."""
        each = () if self.is_rested else (self.lasting, *[(one,) for one in self.short])
        return tuple([self.silent(targets, reason) for targets in each])


def foreign_at(key: ContactKey, parts: Sequence[Selection]) -> list[float]:
    """Return the foreign levels [dB SL] of several selections at a contact, by set."""
    return sums_db([known for part in parts if (known := part.foreign_levels.get(key))])


def sums_db(levels: Sequence[Sequence[float]]) -> list[float]:
    """Return the levels of powers that add up [dB], by set of thresholds."""
    powers = [sum([10 ** (level / 10) for level in each]) for each in zip(*levels, strict=True)]
    return [10 * math.log10(power) if power else -math.inf for power in powers]


def no_layer_free(count: int) -> str:
    """Return why a content is held back where the layers of the amplifiers are all taken."""
    return f"no layer is free: the amplifiers play {count} contents at once; lift a finger"


def not_served(contact: Contact, reason: str) -> Prediction:
    """Return the prediction for a target that feels nothing of its own."""
    return Prediction(contact, None, verdict=HELD_BACK, held_back=reason)


def leaks_db_sl(
    table: LocalizationTable, contents: Sequence[Content], contacts: Sequence[Contact]
) -> dict[ContactKey, float]:
    """Return what each contact feels of contents that are not for it, at its loudest point [dB SL].

    On the nominal plate with the contacts where they are, since weights follow them late: until a
    finger has moved by 8 mm, and while the next answer is computed and fades in. Takes a few
    milliseconds.
    """
    if not contacts:  # lifted, while what plays is not known to have ended
        return {}
    places = [(each.x, each.y) for each in contacts]
    length, width = table.plate.length, table.plate.width
    resting = with_patches(places, [each.load for each in contacts], (length, width))
    points, _ = fingertips_on(np.array(places), length=length, width=width)
    power = np.zeros(points.shape[:2])  # by contact and point
    fields = table.unit_fields(points.reshape(-1, 2), contacts=resting[0], loads=resting[1])
    for content in contents:
        frequencies, felt = table.driven(content.layer.excitation, fields)
        sensed = np.abs(felt) / detection_threshold(frequencies, table.threshold)[:, None]
        own = {contact.key for contact, _ in content.targets}
        is_foreign = np.array([each.key not in own for each in contacts])
        power += (sensed**2).sum(axis=0).reshape(power.shape) * is_foreign[:, None]
    return {
        each.key: 10 * math.log10(loudest) if loudest else -math.inf
        for each, loudest in zip(contacts, power.max(axis=1).tolist(), strict=True)
    }
