"""Contents: the vibrations selected for the targets of an intent, and what the fingers feel.

A content is a layer of the model's answer, the contacts it is played for, and the model's sensation
for each contact. A selection holds the contents of all contacts; a question asks for the contents
of some contacts.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from controller.play.intent import FingerTarget, Gains, Pulse, Target, Targets, pulses_of
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import (
    HELD_BACK,
    MIXED,
    OWN,
    SAME_LEVEL,
    SHARED,
    Layer,
    Sensation,
    verdict_of,
)
from model.answer.envelope import Course
from model.answer.stimulus import Finger, Placement
from model.finger import detection_threshold, fingertips_on
from model.structure.fingertips import with_patches
from model.table.table import LocalizationTable

BEING_CHOSEN = "its vibration is being chosen; wait a moment"

TIME_LIMIT = 1.0
"""Time [s] after which a choice in the thread is given up; it takes some tens of milliseconds."""

GIVEN_UP = (
    f"no answer within {TIME_LIMIT:g} s: several fingers feel nothing until it is computed; touch "
    "with one finger, and restart the daemon if it lasts"
)

_SOON = 5.0  # s; longer courses take longer to answer than the control loop may wait


class ContentKey(NamedTuple):
    """The finger that owns a content, and the content's voice at that finger."""

    finger: ContactKey
    voice: int
    """CLICK for a short pulse, 0 for a lasting content, or the number of a side band of a lasting
    content."""


def own_level_db_sl(sensation: Sensation) -> float:
    """Return the level [dB SL] of a finger's content: promised if it lasts, otherwise nominal.

    The nominal level is the level over the duration, onset included.
    """
    stimulus = sensation.finger.stimulus
    if stimulus is None or stimulus.duration is None:
        return sensation.promised_level_db_sl
    return sensation.level_db_sl


def reaches_threshold(sensation: Sensation) -> bool:
    """Whether a finger's content reaches 0 dB SL, within the rounding of levels."""
    return own_level_db_sl(sensation) >= -SAME_LEVEL


def judged(sensation: Sensation, *, is_apart: bool) -> Sensation:
    """Return a sensation with the verdict that its figures give, if the finger has its own content.

    is_apart: whether all other contents are at least 30 Hz away; otherwise they mix.
    """
    if sensation.verdict not in (OWN, MIXED):
        return sensation
    if not is_apart:
        return replace(sensation, verdict=MIXED)
    verdict = verdict_of(
        sensation.promised_contrast_db,
        sensation.foreign_level_db_sl,
        pauses=sensation.pauses,
    )
    return replace(sensation, verdict=verdict)


def beside_others(
    sensation: Sensation,
    other_levels: Sequence[float],
    foreign_levels: Sequence[float],
    offsets_db: Sequence[float] = (0.0,),
) -> Sensation:
    """Return a sensation while other contents play; powers add, and the worst threshold set counts.

    other_levels: levels of these contents at the finger [dB SL] by threshold set; foreign_levels:
    levels of all foreign contents there, these included, relative to the rig's own set first;
    offsets_db: the finger's own level by set, relative to the rig's set.
    """
    beside = replace(sensation, foreign_levels_db_sl=tuple(foreign_levels))
    if sensation.layer is None:
        return beside
    own_level = own_level_db_sl(sensation)
    promised = sensation.promised_contrast_db
    masking_levels = foreign_levels
    if promised is not None and sensation.foreign_levels_db_sl:
        # The promised contrast is to foreign contents here, not to quiet fingers.
        promised_background = [own_level + offset - promised for offset in offsets_db]
        masking_levels = sums_db([promised_background, other_levels])
    worst_contrast = math.inf
    if promised is not None:
        worst_contrast = promised
    for offset, masking_level in zip(offsets_db, masking_levels, strict=True):
        worst_contrast = min(worst_contrast, own_level + offset - masking_level)
    return replace(beside, promised_contrast_db=worst_contrast)


def weakened(sensation: Sensation, gain_db: float, others_gain_db: float) -> Sensation:
    """Return a sensation with a gain [dB]; others_gain_db: the largest gain of other contents.

    Contrasts become lower bounds. A sensation that falls below the threshold is held back.
    """
    contrast_gain = min(gain_db - others_gain_db, 0.0)
    weaker = replace(
        sensation,
        level_db_sl=sensation.level_db_sl + gain_db,
        promised_level_db_sl=sensation.promised_level_db_sl + gain_db,
        contrast_db=_amplified(sensation.contrast_db, contrast_gain),
        median_contrast_db=_amplified(sensation.median_contrast_db, contrast_gain),
        promised_contrast_db=_amplified(sensation.promised_contrast_db, contrast_gain),
        foreign_levels_db_sl=_all_amplified(sensation.foreign_levels_db_sl, others_gain_db),
    )
    if reaches_threshold(sensation) and not reaches_threshold(weaker):
        return replace(weaker, verdict=HELD_BACK)
    return weaker


def _amplified(level: float | None, gain_db: float) -> float | None:
    if level is None:
        return None
    return level + gain_db


def _all_amplified(levels: Sequence[float], gain_db: float) -> tuple[float, ...]:
    return tuple([level + gain_db for level in levels])


@dataclass(frozen=True)
class Content:
    """A content, which plays in its own layer, and its contacts when it was chosen."""

    key: ContentKey
    targets: Targets
    """The finger that owns it, followed by the fingers that share it."""
    placement: Placement
    """Positions of its fingers, followed by the positions of all other fingers."""
    layer: Layer
    """The layer of the model's answer, in phase with the content that it continues, with its
    gain."""
    sensations: tuple[Sensation, ...] = field(default=(), compare=False)
    """One for each target, while all other contents play; empty for a side band."""
    is_apart: bool = field(default=True, compare=False)
    """Whether all other contents are at least 30 Hz away."""
    gain_db: float = 0.0
    """Strength of its fingers, included in the layer."""
    is_led: bool = field(default=False, compare=False)
    """Whether it replaces another content of its finger in a cross-fade."""

    @property
    def contact(self) -> Contact:
        """The contact that owns it."""
        return self.targets[0].contact

    @property
    def target(self) -> Target:
        """The target of the contact that owns it."""
        return self.targets[0].target

    @property
    def contact_keys(self) -> list[ContactKey]:
        """Keys of all contacts that feel it."""
        return [finger.contact.key for finger in self.targets]

    @property
    def frequency(self) -> float | None:
        """Its frequency [Hz]; None if it has several."""
        return self.layer.frequency

    @property
    def pulses(self) -> list[Pulse]:
        """The pulses of its targets."""
        return pulses_of(self.targets)

    @property
    def course(self) -> tuple[Course, Pulse] | None:
        """Its course and pulse; None for a steady content."""
        target = self.target
        if target.course is None or target.pulse is None:
            return None
        return target.course, target.pulse

    @property
    def finger_sensations(self) -> list["FingerSensation"]:
        """The sensation of each of its fingers; none for a side band."""
        finger_sensations = list[FingerSensation]()
        if not self.sensations:
            return finger_sensations
        for finger, sensation in zip(self.targets, self.sensations, strict=True):
            held_back = self._why_held_back(finger.contact, sensation)
            finger_sensations.append(FingerSensation(finger.contact, sensation, self, held_back))
        return finger_sensations

    def _why_held_back(self, contact: Contact, sensation: Sensation) -> str | None:
        """Return why a finger does not feel a content of its own; None if it does."""
        if sensation.verdict == HELD_BACK:
            return f"a strength of {self.gain_db:g} dB leaves it below the threshold; raise it"
        if sensation.verdict == SHARED and contact is not self.contact:
            owner = self.contact.key
            return (
                f"shares the vibration of finger {owner.source} {owner.id}; lift one, or move "
                "them apart"
            )
        return None

    def with_sensations(self, sensations: Iterable[Sensation]) -> "Content":
        """Return the content with other figures for its fingers, and the verdicts they give."""
        verdicts = [judged(sensation, is_apart=self.is_apart) for sensation in sensations]
        return replace(self, sensations=tuple(verdicts))

    def weakened(self, gain_db: float, others_gain_db: float) -> "Content":
        """Return the content with a gain [dB]; others_gain_db: the largest gain of the others."""
        quieter = replace(self, layer=self.layer.scaled(gain_db), gain_db=gain_db)
        sensations = [weakened(sensation, gain_db, others_gain_db) for sensation in self.sensations]
        return quieter.with_sensations(sensations)


@dataclass(frozen=True)
class FingerSensation:
    """The model's sensation of a finger, its contact, and the content that it feels."""

    contact: Contact
    """As it was when the content was chosen."""
    sensation: Sensation
    """While all other contents play."""
    content: Content | None = None
    """The content it feels; None if it feels nothing of its own."""
    held_back: str | None = None
    """Why it does not feel a content of its own; None if it does."""

    @property
    def level_db_sl(self) -> float | None:
        """Level of the content: promised if it lasts, otherwise nominal; None without a content."""
        if self.content is None:
            return None
        return own_level_db_sl(self.sensation)

    @property
    def promised_level_db_sl(self) -> float | None:
        """Promised level of the content; None without a content."""
        return None if self.content is None else self.sensation.promised_level_db_sl

    @property
    def frequency(self) -> float | None:
        """Frequency of the content [Hz]; None if it has several, or without a content."""
        if self.content is None:
            return None
        return self.content.frequency

    @property
    def content_name(self) -> str | None:
        """Name of the content."""
        if self.content is None:
            return None
        return self.content.target.content


@dataclass(frozen=True)
class Selection:
    """The contents of some contacts, or the reason for silence."""

    targets: Targets
    """Contacts with a target, as they were when the contents were chosen."""
    quiet: tuple[Contact, ...]
    """The other contacts, as they were then."""
    contents: tuple[Content, ...] = ()
    reason: str | None = None
    """Why there are no contents."""
    unserved: tuple[FingerSensation, ...] = ()
    """Targets that feel nothing, with the reasons."""
    is_pending: bool = False
    """Whether the contents of some targets are still being chosen."""
    foreign_levels: Mapping[ContactKey, tuple[float, ...]] = field(default_factory=dict)
    """The sensation's `foreign_levels_db_sl` at each contact, targets and quiet contacts alike."""
    protected: frozenset[ContactKey] = frozenset()
    """Contacts that must not notice the contents of others."""
    is_limited: bool = field(default=False, compare=False)
    """Whether it is confined to the limits that active pulses leave."""
    is_given_up: bool = field(default=False, compare=False)
    """Whether it is silence in place of a choice that took too long."""

    @cached_property
    def contacts(self) -> dict[ContactKey, Contact]:
        """All contacts as they were then."""
        contacts = {contact.key: contact for contact in self.quiet}
        for finger in self.targets:
            contacts[finger.contact.key] = finger.contact
        return contacts

    @cached_property
    def target_keys(self) -> set[ContactKey]:
        """Keys of the contacts with a target."""
        return {finger.contact.key for finger in self.targets}

    @property
    def pulses(self) -> list[Pulse]:
        """The pulses of the targets."""
        return pulses_of(self.targets)

    @cached_property
    def is_whole(self) -> bool:
        """Whether every target feels its own content, so that none gains when another leaves."""
        if not self.contents or self.unserved:
            return False
        return all(len(content.targets) == 1 for content in self.contents)

    @property
    def finger_sensations(self) -> tuple[FingerSensation, ...]:
        """The sensation of each target; targets without a content come last.

        A finger with two contents has the sensation of its short pulse. If one content could not be
        served, the finger has the sensation of the other content, and the reason.
        """
        sensations = dict[ContactKey, FingerSensation]()
        for content in self.contents:
            for felt in content.finger_sensations:
                sensations[felt.contact.key] = felt
        for unserved in self.unserved:
            key = unserved.contact.key
            if key in sensations:
                sensations[key] = replace(sensations[key], held_back=unserved.held_back)
            else:
                sensations[key] = unserved
        return tuple(sensations.values())

    def weakened(self, gains_db: Gains) -> "Selection":
        """Return the selection with the strengths of its fingers.

        A shared content has the lowest strength of its fingers.
        """
        if not self.contents or not any(gains_db.values()):
            return self
        gains = {
            content.targets: _lowest_gain(content.targets, gains_db) for content in self.contents
        }
        contents = list[Content]()
        for content in self.contents:
            gain = gains[content.targets]
            others_gains = [gains[targets] for targets in gains if targets != content.targets]
            contents.append(content.weakened(gain, max(others_gains, default=gain)))
        largest_gain = max(gains.values())
        foreign_levels = {
            key: _all_amplified(levels, largest_gain) for key, levels in self.foreign_levels.items()
        }
        return replace(self, contents=tuple(contents), foreign_levels=foreign_levels)

    def restricted(self, keys: Set[ContactKey]) -> "Selection":
        """Return the selection with the contents of some fingers alone; the others are quiet."""
        if self.target_keys <= keys:
            return self
        targets = list[FingerTarget]()
        quiet = [*self.quiet]
        for finger in self.targets:
            if finger.contact.key in keys:
                targets.append(finger)
            else:
                quiet.append(finger.contact)
        contents = [
            content for content in self.contents if not keys.isdisjoint(content.contact_keys)
        ]
        unserved = [finger for finger in self.unserved if finger.contact.key in keys]
        return replace(
            self,
            targets=tuple(targets),
            quiet=tuple(quiet),
            contents=tuple(contents),
            unserved=tuple(unserved),
        )

    def without(self, contents: Collection[Content], reason: str) -> "Selection":
        """Return the selection without some contents, whose targets feel nothing for a reason."""
        remaining = tuple([content for content in self.contents if content not in contents])
        unserved = dict[ContactKey, FingerSensation]()
        for content in contents:
            for contact, _ in content.targets:
                unserved[contact.key] = not_served(contact, reason)
        selection = replace(self, contents=remaining, unserved=(*self.unserved, *unserved.values()))
        if remaining:
            return selection
        return replace(selection, reason=reason)

    def beside(self, others: Sequence["Selection"], table: LocalizationTable) -> "Selection":
        """Return the selection while other selections play, too, with their foreign levels.

        table: has the threshold sets.
        """
        other_levels = dict[ContactKey, tuple[float, ...]]()
        foreign_levels = {**self.foreign_levels}
        for key in self.target_keys:
            levels = foreign_at(key, others)
            if max(levels, default=-math.inf) > -math.inf:
                other_levels[key] = levels
                foreign_levels[key] = foreign_at(key, (self, *others))
        if not other_levels:
            return self

        def restated(finger: FingerSensation, offsets_db: Sequence[float] = (0.0,)) -> Sensation:
            key = finger.contact.key
            if key not in other_levels:
                return finger.sensation
            return beside_others(
                finger.sensation, other_levels[key], foreign_levels[key], offsets_db
            )

        contents = list[Content]()
        for content in self.contents:
            levels_by_set = table.levels_by_set(0.0, content.layer.excitation)
            offsets_db = [float(level) for level in levels_by_set]
            sensations = [restated(finger, offsets_db) for finger in content.finger_sensations]
            contents.append(content.with_sensations(sensations))
        unserved = [replace(finger, sensation=restated(finger)) for finger in self.unserved]
        return replace(
            self,
            contents=tuple(contents),
            unserved=tuple(unserved),
            foreign_levels=foreign_levels,
        )


def _lowest_gain(targets: Targets, gains_db: Gains) -> float:
    """Return the lowest gain [dB] of some targets, 0 at most."""
    lowest = 0.0
    for contact, target in targets:
        lowest = min(lowest, gains_db.get((contact.key, target.is_short), 0.0))
    return lowest


NOTHING = Selection((), ())
"""The selection of no contents."""


@dataclass(frozen=True)
class Question:
    """The targets to choose contents for, all contacts, and the contents that play."""

    contacts: tuple[Contact, ...]
    """All contacts on the plate."""
    lasting: Targets
    """Targets of lasting contents."""
    short: Targets
    """Targets of short pulses."""
    protected: frozenset[ContactKey] = frozenset()
    """Contacts that must not notice the contents of others."""
    playing: Mapping[ContentKey, Content] = field(default_factory=dict)
    """Contents that are felt now, by finger and voice."""
    kept: tuple[Selection, ...] = ()
    """Selections that continue to play next to the new ones."""
    is_rested: bool = False
    """Whether all fingers rest and are served, so that only a better answer is of interest."""
    now: float = math.inf
    """[s]"""
    fading: Selection = NOTHING
    """Contents that fade in a cross-fade."""

    @cached_property
    def is_alone(self) -> bool:
        """Whether there is one lasting, steady target and no other finger is protected."""
        if len(self.lasting) != 1:
            return False
        ((contact, target),) = self.lasting
        return self.protected <= {contact.key} and target.modulation_hz is None

    @cached_property
    def takes_long(self) -> bool:
        """Whether the answer for lasting targets takes longer than the control loop can wait."""
        if self.lasting and not self.is_alone:
            return True
        for _, target in self.lasting:
            if target.course is not None and target.course.duration > _SOON:
                return True
        return False

    def quiet_beside(self, targets: Targets) -> tuple[Contact, ...]:
        """Return the contacts that are not among some targets."""
        quiet = [*self.contacts]
        for finger in targets:
            quiet.remove(finger.contact)
        return tuple(quiet)

    def silent(self, targets: Targets, reason: str) -> Selection:
        """Return the selection of targets that feel nothing, for a reason."""
        unserved = [not_served(contact, reason) for contact, _ in targets]
        return Selection(
            targets,
            self.quiet_beside(targets),
            reason=reason,
            unserved=tuple(unserved),
            protected=self.protected,
        )

    def given_up(self) -> tuple[Selection, ...]:
        """Return silence for all targets, whose choice took too long; nothing if fingers rest."""
        if self.is_rested:
            return ()
        silence = self.silent(self.lasting, GIVEN_UP)
        selections = [replace(silence, is_given_up=True)]
        for finger in self.short:
            selections.append(self.silent((finger,), GIVEN_UP))
        return tuple(selections)


def foreign_at(key: ContactKey, selections: Sequence[Selection]) -> tuple[float, ...]:
    """Return the foreign levels [dB SL] of several selections at a contact, by threshold set."""
    levels = list[Sequence[float]]()
    for selection in selections:
        levels_by_set = selection.foreign_levels.get(key)
        if levels_by_set:
            levels.append(levels_by_set)
    return tuple(sums_db(levels))


def sums_db(levels: Sequence[Sequence[float]]) -> list[float]:
    """Return the levels [dB] of the sums of powers, by threshold set."""
    sums = list[float]()
    for levels_of_set in zip(*levels, strict=True):
        power = sum([10 ** (level / 10) for level in levels_of_set])
        sums.append(_power_db(power))
    return sums


def _power_db(power: float) -> float:
    if not power:
        return -math.inf
    return 10 * math.log10(power)


def no_layer_free(count: int) -> str:
    """Return why a content is held back when all layers of the amplifiers are in use."""
    return f"no layer is free: the amplifiers play {count} simultaneous vibrations; lift a finger"


def not_served(contact: Contact, reason: str) -> FingerSensation:
    """Return the sensation of a target that feels nothing of its own."""
    finger = Finger((contact.x, contact.y), load=contact.load)
    return FingerSensation(contact, Sensation(finger, HELD_BACK), held_back=reason)


def leaks_db_sl(
    table: LocalizationTable, contents: Sequence[Content], contacts: Sequence[Contact]
) -> dict[ContactKey, float]:
    """Return the level of foreign contents at each contact, at its loudest point [dB SL].

    The level is computed on the nominal plate for the present positions of the contacts. Weights
    lag behind a moving finger: they change after 8 mm, once the next answer has been computed and
    has faded in. Takes a few milliseconds.
    """
    if not contacts:  # lifted, while layers are not known to have ended
        return {}
    positions = [(contact.x, contact.y) for contact in contacts]
    loads = [contact.load for contact in contacts]
    plate = table.plate
    patches, patch_loads = with_patches(positions, loads, (plate.length, plate.width))
    points, _ = fingertips_on(np.array(positions), length=plate.length, width=plate.width)
    fields = table.unit_fields(points.reshape(-1, 2), contacts=patches, loads=patch_loads)
    foreign_power = np.zeros(points.shape[:2])  # by contact and point
    for content in contents:
        frequencies, accelerations = table.driven(content.layer.excitation, fields)
        thresholds = detection_threshold(frequencies, table.threshold)
        relative = np.abs(accelerations) / thresholds[:, None]
        power = (relative**2).sum(axis=0).reshape(foreign_power.shape)
        own_keys = content.contact_keys
        is_foreign = np.array([contact.key not in own_keys for contact in contacts])
        foreign_power += power * is_foreign[:, None]
    levels = dict[ContactKey, float]()
    loudest_powers = foreign_power.max(axis=1).tolist()
    for contact, power in zip(contacts, loudest_powers, strict=True):
        levels[contact.key] = _power_db(power)
    return levels
