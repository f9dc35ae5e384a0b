"""The layers that play: which finger has which, what each plays, and until when.

A vibration ends by itself if the host or a touch source falls silent, so it is renewed only while
sources confirm the contacts that it is for.
"""

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from controller.play.content import Content
from controller.play.intent import Target
from controller.play.routing import Drive, PlateSet, restarted_by, tones_by_era
from controller.sources.contacts import MAX_CONTACT_TIMEOUT, Contact, ContactKey
from drivers.errors import CommandRefused
from drivers.host.joint_sets import Played
from drivers.protocol.sets import is_vibrating
from drivers.protocol.table import QUANTITIES
from model.answer.answer import Layer
from model.rig.rig import Rig

# Shortest time [s] until a vibration ends by itself on the amplifier, so that a slow wire or a rate
# limit of one set a second does not interrupt it. It is renewed at half its time.
_MIN_VALID_FOR = 2.0
_MARGIN = 0.2  # s; after the contact is lifted, for late frames
_MIN_LEFT = 0.001  # s; of a pulse that is about to end
_VALID_FOR = QUANTITIES["valid_for"]

Targets = Sequence[tuple[Contact, Target]]


@dataclass(frozen=True)
class PlayedContent:
    """A content in its layer.

    pattern: with the ramp, onset and ending of its set; drive: by ERA, as confirmed; settled_at
    [s]: when its onset has ended. confirmed_until [s]: when its first target would have been
    lifted, as known when it was sent; between renewal_due and renewable_until it is renewed if all
    targets have been confirmed since. ends_at: when it has ended by itself unless it was renewed.
    """

    content: Content
    set: PlateSet
    pattern: Layer
    drive: Drive = field(default_factory=dict)
    settled_at: float = math.inf
    confirmed_until: float = math.inf
    renewal_due: float = math.inf
    renewable_until: float = math.inf
    ends_at: float = math.inf

    @property
    def continued(self) -> Drive:
        """What plays, at the frequencies that were asked for, which wire and amplifier round."""
        requested = self.pattern.excitation
        return {
            name: replace(tone, frequency=requested[name].frequency)
            for name, tone in self.drive.items()
            if name in requested
        }


class Playing:
    """The layers of the amplifiers; count: how many there are, expiry_of: a contact [s]."""

    def __init__(self, rig: Rig, count: int, expiry_of: Callable[[ContactKey], float]) -> None:
        self._rig, self._count, self._expiry_of = rig, count, expiry_of
        self.contents: Mapping[int, PlayedContent] = {}
        """What plays, by layer."""
        self.due = math.inf
        """When [s] the next content is to be renewed, or has ended by itself."""
        self.may_play: frozenset[int] = frozenset()
        """Layers that may play, since all were silent."""
        self.is_silent = False
        """Whether all layers are silent, for certain."""
        self._over: tuple[Content, ...] = ()  # ended by themselves
        # By finger and voice, also where what plays is unknown.
        self._layer_of: Mapping[tuple[ContactKey, int], int] = {}

    def forget(self) -> None:
        """Discard what plays, which is unknown; fingers keep their layers."""
        self._replace({})
        self.is_silent, self._over = False, ()

    def start(self, contents: Mapping[int, PlayedContent], started: frozenset[int]) -> None:
        """Note what is sent: the contents of all layers, and which of them start."""
        self._replace(contents)
        self.is_silent = False
        self._layer_of = {one.content.key: number for number, one in [*contents.items()][::-1]}
        self.may_play |= started

    def end(self, *, is_silent: bool) -> None:
        """Note that all contents end, by a silence of all amplifiers or each by its ending."""
        self._replace({})
        self.is_silent, self._layer_of = is_silent, {}

    def leave_out(self, numbers: Container[int]) -> None:
        """Note that some layers do not play what they were to."""
        self._replace({n: one for n, one in self.contents.items() if n not in numbers})

    def change(self, number: int, **values: Any) -> None:
        """Give what plays in a layer other values of its fields."""
        self._replace({**self.contents, number: replace(self.contents[number], **values)})

    def _replace(self, contents: Mapping[int, PlayedContent]) -> None:
        self.contents, self.due = contents, math.inf
        for one in contents.values():
            self.due = min(self.due, one.renewal_due, one.ends_at if one.drive else math.inf)

    def confirm(self, number: int, played: Played, now: float) -> None:
        """Note what the amplifiers play of a layer, whose set was committed by now [s].

        What a ledger has shortened is not renewed, since that would circumvent its limit.
        """
        one = self.contents[number]
        lasts = _shortest(played, number)
        self.change(
            number,
            confirmed_until=self.confirmed_until(one.content),
            renewal_due=math.inf if lasts < _MIN_VALID_FOR else now + lasts / 2,
            renewable_until=now + lasts - _MARGIN / 2,
            ends_at=now + lasts,
        )

    def confirm_start(self, number: int, played: Played, now: float) -> None:
        """Note what the amplifiers play of a content that has started in a layer."""
        settled_at = now + self.contents[number].set.settled_after
        drive = tones_by_era(played.layers, self._rig, number)
        self.change(number, drive=drive, settled_at=settled_at)
        self.confirm(number, played, now)

    def confirmed_until(self, content: Content) -> float:
        """Return when [s] the first target of a content is lifted unless a frame arrives."""
        expiries = [self._expiry_of(contact.key) for contact, _ in content.targets]
        return min(expiries, default=-math.inf)

    def lasts(self, content: Content, now: float) -> float:
        """Return for how long [s] a content at a time [s] may last by itself.

        The amplifiers end a pulse; the last one, where several play.
        """
        until = self.confirmed_until(content)
        unlimited = min(max(until - now + _MARGIN, _MIN_VALID_FOR), MAX_CONTACT_TIMEOUT)
        return min(unlimited, max(all_left(content.targets, now), default=math.inf))

    def to_renew(self, now: float) -> dict[int, PlayedContent]:
        """Return what is to be prolonged at a time [s], by layer."""
        return {
            number: one
            for number, one in self.contents.items()
            if one.renewal_due <= now < one.renewable_until
            and self.confirmed_until(one.content) > one.confirmed_until
        }

    def renewed(
        self, numbers: Iterable[int], played: Played | CommandRefused, *, now: float
    ) -> None:
        """Note what became of a renewal of layers; one refused for good lets them end."""
        for number in numbers:
            if isinstance(played, CommandRefused):
                due = math.inf if played.until is None else played.until
                self.change(number, renewal_due=due)
            else:
                self.confirm(number, played, now)

    def ended(self, now: float) -> tuple[Content, ...]:
        """Return the contents that have ended by themselves by a time [s], once."""
        over = [n for n, one in self.contents.items() if one.drive and now >= one.ends_at]
        for number in over:
            self.change(number, drive={})
        contents = tuple(self.contents[number].content for number in over)
        self._over = (*self._over, *contents)
        return contents

    def over_of(self, contents: Container[Content]) -> tuple[Content, ...]:
        """Return those of the contents that are still wanted that have ended by themselves."""
        if self._over:
            self._over = tuple(each for each in self._over if each in contents)
        return self._over

    def may_end_shaped(self, number: int, now: float) -> bool:
        """Whether a layer has settled, so that its endings lead from what plays."""
        one = self.contents.get(number)
        return one is not None and one.set.has_endings and now >= one.settled_at

    def beside(self, number: int) -> frozenset[int]:
        """Return the layers of the voices of the same content as one, itself included."""
        targets = self.contents[number].content.targets
        return frozenset(n for n, one in self.contents.items() if one.content.targets == targets)

    def numbered(self, contents: Sequence[Content]) -> dict[int, Content]:
        """Contents by layer: what plays in its own, else a finger's, new ones in those that end."""
        numbers = {n: one.content for n, one in self.contents.items() if one.content in contents}
        kept = [*numbers.values()]
        new = []
        for content in contents:
            if content in kept:
                continue
            number = self._layer_of.get(content.key)
            if number is None or number in numbers:  # a pulse beside what others share
                new.append(content)
            else:
                numbers[number] = content
        every = [*sorted(self.may_play), *range(self._count)]
        free = [number for number in dict.fromkeys(every) if number not in numbers]
        return {**numbers, **dict(zip(free, new, strict=False))}

    def starting(self, numbers: Mapping[int, Content]) -> tuple[list[int], set[int]]:
        """Return the layers that start by the contents of all, and which of these restart.

        A carrier and its side bands must count their phases from one moment: where one starts, all
        of the content restart.
        """
        restarting = set[int]()
        changed = [
            number
            for number, content in numbers.items()
            if number not in self.contents or self.contents[number].content != content
        ]
        for number in changed:
            content = numbers[number]
            voices = [n for n, one in numbers.items() if one.targets == content.targets]
            if len(voices) > 1 and restarted_by(content.pattern.excitation, self.drive_of(number)):
                restarting.update(voices)
        if restarting:
            changed = [n for n in numbers if n in changed or n in restarting]
        return changed, restarting

    def drive_of(self, number: int) -> Drive:
        """Return what plays in a layer, at the frequencies that were asked for."""
        return self.contents[number].continued if number in self.contents else {}


def all_left(targets: Targets, now: float) -> list[float]:
    """Return how long [s] each target is driven from a time [s]; infinite without a pulse."""
    left = []
    for _, target in targets:
        pulse = target.pulse
        if pulse is None:
            left.append(math.inf)
        elif pulse.started_at is None:
            left.append(pulse.duration)
        else:
            left.append(max(pulse.end - now, _MIN_LEFT))
    return left


def _shortest(played: Played, number: int) -> float:
    """Return the time [s] after the commit when the first amplifier ends a layer by itself.

    Infinite where none does.
    """
    times = [
        _VALID_FOR.from_wire(one.valid_for)
        for layers in played.layers.values()
        for one in layers
        if one.layer == number and one.valid_for and is_vibrating(one)
    ]
    return min(times, default=math.inf)
