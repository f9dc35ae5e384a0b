"""Contents of layers: what each layer plays, for its own finger and those that share it.

Predictions say what fingers feel of contents; a selection has the contents of all fingers.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from controller.play.intent import Gains, Pulse, Target
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import HELD_BACK, MIXED, OWN, Layer, is_felt, verdict_of
from model.answer.stimulus import Course, Placement
from model.finger import detection_threshold, fingertips_on
from model.table.table import LocalizationTable

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
