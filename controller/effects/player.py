"""From contacts to intents by a surface layout: who feels which effect, and who gives way."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from controller.effects.effect import Course, Effect, Feeling, Nothing
from controller.effects.layout import Layout, Region
from controller.loop.intent import NO_CONTACTS, HapticIntent, Target
from controller.sources.contacts import Contact, ContactKey
from registry.plugins import WrongResultError

# A finger that rests on an edge must not go in and out with the noise of its sensor, so it stays in
# the region that it came into until it is this far [m] from where it did.
_NOISE = 0.001

ASKED = 1_000_000
"""The priority of an effect that was asked for by name: above all regions."""


@dataclass
class _Play:
    """One effect at one finger, the order in which it began, and how important it is."""

    name: str
    course: Course
    number: int
    priority: int


@dataclass
class _Finger:
    """The region that a finger is in, where it came into that, and what plays for it."""

    region: Region | None
    entered: tuple[float, float]
    plays: list[_Play] = field(default_factory=list)


class EffectPlayer:
    """Plays the effects of a layout; `intent` is a pure function of what it was told, in order.

    Every play asks for its finger. Of one finger the play that began last is felt; when it is over,
    the one before goes on. Of several fingers those of the highest priority are felt, among equals
    the one whose play began last, or as many of the last as the layout allows; all others are
    quiet. An effect of a slider that is quiet at the moment (no detent passed, no movement) asks
    for nothing and stands in nobody's way.

    known: fingers that have felt their press already, by another layout. For them begins what lasts
    and what moves, and nothing that would be felt as another press.
    """

    def __init__(self, layout: Layout, *, known: Iterable[ContactKey] = ()) -> None:
        self.layout = layout
        self._known = set(known)
        self._fingers: dict[ContactKey, _Finger] = {}
        self._number = 0

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Who shall feel what at a time [s]."""
        self._follow(contacts, now)
        if not contacts:
            return HapticIntent((), NO_CONTACTS)
        asking: list[tuple[int, int, Contact, Feeling]] = []
        ends: list[float] = []
        for contact in contacts:
            play, feeling = self._felt(contact, now, ends)
            if play is not None and feeling is not None:
                asking.append((play.priority, play.number, contact, feeling))
        asking.sort(key=lambda one: one[:2], reverse=True)
        chosen = [one for one in asking if one[0] == asking[0][0]][: self.layout.most_at_once]
        return HapticIntent(
            tuple(
                Target(contact.key, feeling.level_db_sl, or_less=feeling.or_less)
                for _, _, contact, feeling in chosen
            ),
            "no effect plays for the fingers that are there",
            until=min(ends, default=None),
        )

    @property
    def fingers(self) -> Collection[ContactKey]:
        """Those that were on the plate when it was last looked."""
        return self._fingers.keys() | self._known

    def effect_of(self, key: ContactKey) -> str | None:
        """The name of the effect that a finger has, None for none."""
        finger = self._fingers.get(key)
        return finger.plays[-1].name if finger and finger.plays else None

    def play(self, name: str, contact: Contact, now: float, *, level_db_sl: float | None) -> None:
        """Begin a named effect at a finger; level [dB SL] in place of its own, unless None.

        One that was asked for there before begins anew.

        Raises KeyError for an effect that the layout does not have.
        """
        effect = self.layout.effects[name]
        level = effect.level_db_sl if level_db_sl is None else level_db_sl
        finger = self._fingers.get(contact.key) or self._come(contact, now)
        # It begins anew; nobody can pile up plays that way.
        finger.plays = [
            play for play in finger.plays if (play.name, play.priority) != (name, ASKED)
        ]
        self._begin(finger, name, contact, now, level=level, priority=ASKED)

    def _follow(self, contacts: Sequence[Contact], now: float) -> None:
        """Begin and end what the fingers' ways through the regions begin and end."""
        keys = {contact.key for contact in contacts}
        self._known &= keys
        for key in [key for key in self._fingers if key not in keys]:
            del self._fingers[key]
        for contact in contacts:
            finger = self._fingers.get(contact.key)
            if finger is None:
                self._come(contact, now)
                continue
            place = (contact.x, contact.y)
            if math.dist(place, finger.entered) < _NOISE:
                continue
            region = self.layout.region_at(*place)
            if finger.region is not region:
                left, finger.region, finger.entered = finger.region, region, place
                finger.plays = [play for play in finger.plays if play.priority == ASKED]
                self._enter(finger, contact, now)
                if left is not None and left.on_release is not None:
                    self._begin_of(finger, left, left.on_release, contact, now)

    def _come(self, contact: Contact, now: float) -> _Finger:
        """Take in a finger that was not there, and begin what there is for it."""
        place = (contact.x, contact.y)
        finger = _Finger(self.layout.region_at(*place), place)
        self._fingers[contact.key] = finger
        self._enter(finger, contact, now)
        if contact.key in self._known:
            self._known.discard(contact.key)
            finger.plays = [play for play in finger.plays if self._goes_on(play)]
        return finger

    def _goes_on(self, play: _Play) -> bool:
        effect = self.layout.effects[play.name]
        return effect.moves or not effect.ends

    def _enter(self, finger: _Finger, contact: Contact, now: float) -> None:
        """Begin what a region, or the plate outside of all, has for a finger that comes."""
        region = finger.region
        if region is None:
            name = self.layout.elsewhere
            if name is not None:
                level = self.layout.effects[name].level_db_sl
                self._begin(finger, name, contact, now, level=level, priority=0)
            return
        # What moves begins first: a press is felt, then the movement that follows it.
        for name in (region.on_move, region.on_press):
            if name is not None:
                self._begin_of(finger, region, name, contact, now)

    def _begin_of(
        self, finger: _Finger, region: Region, name: str, contact: Contact, now: float
    ) -> None:
        effect: Effect = self.layout.effects[name]
        level = region.level_db_sl if region.has_level else effect.level_db_sl
        self._begin(finger, name, contact, now, level=level, priority=region.priority)

    def _begin(
        self,
        finger: _Finger,
        name: str,
        contact: Contact,
        now: float,
        *,
        level: float | None,
        priority: int,
    ) -> None:
        self._number += 1
        effect = self.layout.effects[name]
        course = effect.begin(contact, now, level_db_sl=level)
        if not isinstance(course, Course):
            raise WrongResultError(effect, course, Course)
        finger.plays.append(_Play(name, course, self._number, priority))

    def _felt(
        self, contact: Contact, now: float, ends: list[float]
    ) -> tuple[_Play | None, Feeling | None]:
        """The play that a finger feels now, with what; ends gains every moment when to look again.

        All its plays are followed, for those that move must know the finger's way.
        """
        finger = self._fingers[contact.key]
        felt: tuple[_Play | None, Feeling | None] = (None, None)
        lasting: list[_Play] = []
        for play in finger.plays:
            answer = play.course.feel(contact, now)
            if answer is None:
                continue
            if not isinstance(answer, Feeling | Nothing):
                raise WrongResultError(play.course, answer, Feeling)
            lasting.append(play)
            if answer.until is not None:
                ends.append(answer.until)
            if isinstance(answer, Feeling):
                felt = (play, answer)
        finger.plays = lasting
        return felt
