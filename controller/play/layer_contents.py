"""What layers play: one content each, for its own finger and those that share it.

What a layer of all amplifiers plays: a content, until when, and what is due of it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from controller.play.intent import Gains, Pulse, Target
from controller.play.routing import Drive
from controller.sources.touch import Contact, ContactKey
from model.answer import answer
from model.answer.answer import HELD_BACK, MIXED, OWN, Layer, is_felt, verdict_of
from model.answer.stimulus import Course, Placement
from model.finger import detection_threshold, fingertips_on
from model.table.table import LocalizationTable

Targets = tuple[tuple[Contact, Target], ...]

BEING_CHOSEN = "what it shall feel is being chosen; wait a moment"


@dataclass(frozen=True)
class Prediction:
    """What a finger that is to feel something is predicted to feel.

    contact: as it was when the content was chosen; verdict: whether it feels its own content, that
    mixed with others', that of another finger, or none; held_back: why not its own, None if it
    does. level_db_sl: over the duration of the effect, onset included, or the steady one where it
    has none; contrast_db: on the plate as modelled, to the loudest quiet finger or to the contents
    of others here; promised_contrast_db: the same on nine of ten plates; foreign_level_db_sl: of
    others' contents here, which nine of ten plates do not exceed. None where there is nothing to
    compare with. frequency [Hz]: None where several or none play; content: name of what it feels;
    nominal_db_sl: its level on the plate as modelled; pauses: whether it ends, or comes and goes;
    is_apart: whether all that others feel is 30 Hz away.
    """

    contact: Contact
    level_db_sl: float | None
    contrast_db: float | None = None
    verdict: str = OWN
    held_back: str | None = None
    promised_contrast_db: float | None = None
    foreign_level_db_sl: float | None = None
    frequency: float | None = None
    content: str | None = None
    nominal_db_sl: float | None = None
    pauses: bool = False
    is_apart: bool = True

    @property
    def is_foreign_felt(self) -> bool:
        """Whether others' contents may be felt here."""
        return is_felt(self.foreign_level_db_sl)

    def judged(self) -> "Prediction":
        """Return it with the verdict that its figures give where it feels a content of its own."""
        if self.verdict not in (OWN, MIXED):
            return self
        verdict = verdict_of(
            self.promised_contrast_db, self.foreign_level_db_sl, pauses=self.pauses
        )
        return replace(self, verdict=verdict if self.is_apart else MIXED)

    def beside(
        self, others: Sequence[float], total: Sequence[float], above: Sequence[float] = (0.0,)
    ) -> "Prediction":
        """Return it with other contents besides, whose powers add, by the set that is worst.

        others: of these alone [dB SL], by each set of thresholds; total: all that is foreign here;
        above: its level by each set, above that by the rig's own [dB].
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
        """Return it with a gain [dB]; others_db: at most on others' contents.

        Of its contrasts what is left at least.
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
    """What one layer plays, with the contacts as they were when it was chosen.

    key: of the finger whose content it is, and CLICK for a short pulse, 0 for what lasts, or the
    number of a side band of that, which has no predictions; targets: that finger, then those that
    share it; placement: where they are, and all others; predictions: one per target, which also
    depend on others; gain_db: that the layer has, its fingers' strength. is_led: whether it
    takes the place of what its finger feels along a cross-fade, which others hardly notice.
    """

    key: tuple[ContactKey, int]
    targets: Targets
    placement: Placement
    layer: Layer
    predictions: tuple[Prediction, ...] = field(default=(), compare=False)
    gain_db: float = 0.0
    is_led: bool = field(default=False, compare=False)

    @property
    def frequency(self) -> float | None:
        """Its frequency [Hz]; None of several."""
        return self.layer.frequency

    @property
    def course(self) -> tuple[Course, Pulse] | None:
        """The course along which it is felt, and its pulse; None for steadily."""
        target = self.targets[0][1]
        if target.course is None or target.pulse is None:
            return None
        return target.course, target.pulse


@dataclass(frozen=True)
class Selection:
    """The contents of some contacts, or none and the reason for silence.

    targets, quiet: contacts as they were when the contents were chosen, targets with their
    intents; not_served: targets that feel nothing, with the reason; is_pending: whether the
    contents of some targets are still being chosen. foreign_levels [dB SL]: what contacts feel
    of others' contents by each set of thresholds, which nine of ten plates do not exceed;
    protected: contacts that must not notice those of others.
    """

    targets: Targets
    quiet: tuple[Contact, ...]
    contents: tuple[Content, ...] = ()
    reason: str | None = None
    not_served: tuple[Prediction, ...] = ()
    is_pending: bool = False
    foreign_levels: Mapping[ContactKey, Sequence[float]] = field(default_factory=dict)
    protected: frozenset[ContactKey] = frozenset()

    @cached_property
    def contacts(self) -> dict[ContactKey, Contact]:
        """All contacts as they were then."""
        found = {each.key: each for each in self.quiet}
        for contact, _ in self.targets:
            found[contact.key] = contact
        return found

    @property
    def target_keys(self) -> set[ContactKey]:
        """Contacts of the targets."""
        return {contact.key for contact, _ in self.targets}

    @property
    def pulses(self) -> list[Pulse]:
        """Those of the targets that have an end of their own."""
        return [target.pulse for _, target in self.targets if target.pulse is not None]

    @cached_property
    def is_whole(self) -> bool:
        """Whether every target feels its own, so that who leaves changes nothing for others."""
        is_each_alone = all(len(content.targets) == 1 for content in self.contents)
        return bool(self.contents) and is_each_alone and not self.not_served

    def weakened(self, gains_db: Gains) -> "Selection":
        """Return it with the strengths of fingers; what several share has the lowest."""
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
            contents.append(
                replace(
                    each,
                    layer=each.layer.scaled(gain),
                    predictions=tuple([one.weakened(gain, loudest) for one in each.predictions]),
                    gain_db=gain,
                )
            )
        loudest = max(gains.values(), default=0.0)
        levels = {
            key: [level + loudest for level in by_set]
            for key, by_set in self.foreign_levels.items()
        }
        return replace(self, contents=tuple(contents), foreign_levels=levels)

    def without(self, contents: Sequence["Content"], reason: str) -> "Selection":
        """Return it without some contents, whose targets feel nothing for a reason."""
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
        """Return it with what the fingers of its targets feel of others that play beside it.

        table: whose sets of thresholds count.
        """
        levels, total = dict[ContactKey, list[float]](), {**self.foreign_levels}
        for key in self.target_keys:
            of_others = foreign_at(key, others)
            if max(of_others, default=-math.inf) > -math.inf:
                levels[key], total[key] = of_others, foreign_at(key, (self, *others))
        if not levels:
            return self

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
        """What each finger feels, those that feel nothing at the end.

        Of a short pulse beside what lasts; where that is not served, why, of the other.
        """
        found = {each.contact.key: each for one in self.contents for each in one.predictions}
        for each in self.not_served:
            felt = found.get(each.contact.key)
            found[each.contact.key] = (
                each if felt is None else replace(felt, held_back=each.held_back)
            )
        return tuple(found.values())


def foreign_at(key: ContactKey, parts: Sequence[Selection]) -> list[float]:
    """Return what a contact feels of others' contents of several selections, by set [dB SL]."""
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
    loads = [each.load for each in contacts]
    length, width = table.plate.length, table.plate.width
    points, _ = fingertips_on(np.array(places), length=length, width=width)
    power = np.zeros(points.shape[:2])  # by contact and point
    fields = table.unit_fields(points.reshape(-1, 2), contacts=places, loads=loads)
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


@dataclass(frozen=True)
class LayerContent:
    """A content in its layer.

    layer: with the ramp, onset and ending of its sets; drive: by ERA, as confirmed; settled_at
    [s]: when its onset has ended. is_shaped: whether it may have an ending, which is sent at
    ending_due [s], once the onset has ended: until then it fades. Of one with a course the next
    piece is sent then; course_until [s]: when what has been sent of it ends. confirmed_until [s]:
    when its first target would have been lifted, as known when it was sent; between renewal_due and
    renewable_until it is renewed if all targets have been confirmed since. ends_at: when it has
    ended by itself unless it was renewed. is_falling: whether another content takes its place along
    a cross-fade: it falls at ending_due, and is not renewed.
    """

    content: Content
    layer: answer.Layer
    drive: Drive = field(default_factory=dict)
    settled_at: float = math.inf
    is_shaped: bool = False
    ending_due: float = math.inf
    confirmed_until: float = math.inf
    renewal_due: float = math.inf
    renewable_until: float = math.inf
    ends_at: float = math.inf
    is_falling: bool = False
    course_until: float = -math.inf

    @property
    def settled_after(self) -> float:
        """How long [s] after the commit its ramp or onset has ended."""
        onset = self.layer.onset
        last = next(iter(onset.values())).duration if onset else 0.0
        return max(self.layer.ramp, last)
