"""The layers of the amplifiers: contents in, sets out; what each layer plays, and until when.

The ledgers are asked before a set is made: what they do not admit is played along plain ramps, then
without the newest content, and nothing is played where none is left. A vibration ends by itself if
the host or a touch source falls silent, so it is renewed only while sources confirm its contacts.
A layer with a course gets a set for each piece, half a piece ahead.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from controller.play.intent import CLICK, FADED_AFTER, Pulse
from controller.play.layer_contents import Content, LayerContent
from controller.play.routing import (
    BESIDE_CLICK,
    HELD,
    PLAIN_STEP,
    Drive,
    PlateLayer,
    PlaybackCapabilities,
    SetBuilder,
    full_drive,
    piece_of,
    tones_by_era,
)
from controller.sources.touch import MAX_CONTACT_TIMEOUT, ContactKey
from drivers.errors import CommandRefused
from drivers.host.joint_sets import PlayedSet
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import is_vibrating
from model.answer import answer
from model.answer.answer_report import Timing
from model.answer.stimulus import FADE_RAMP, Course
from model.rig.rig import Rig

MIN_LEFT = 0.001
"""Shortest remaining time [s] of a pulse."""


# With no finger left on the plate the end may be short: zero within 20 ms of the lift.
RELEASE_RAMP = 0.010

STRENGTH_FADE = 0.100
"""Time [s] of the raised cosine along which a content is led to another strength."""

CROSSFADE = 0.300
"""Time [s] of the raised cosines along which one content takes the place of another.

Shorter ones are felt by fingers that are on nulls.
"""

FALL_AFTER = 0.27 * CROSSFADE
"""Delay [s] of the fall of the other content, so that its finger feels no dip between."""

RETRY = 1.0
"""Time [s] after which a set is planned again that was refused for an unknown time."""

# Shortest time [s] until a vibration ends by itself on the amplifier, so that a slow wire or a rate
# limit of one set a second does not interrupt it. It is renewed at half its time.
_MIN_VALID_FOR = 2.0
_MARGIN = 0.2  # s; after the contact is lifted, for late frames
_SURELY_SETTLED = 0.005  # s; by which a set starts later than its last reply, and clocks differ
_MIN_RATE = 10.0  # sets/s; a lower limit leaves no turn to an ending: a touch would wait for it
_VALID_FOR = QUANTITIES["valid_for"]

Check = Callable[[Mapping[str, Sequence[AmplifierLayer]]], CommandRefused | None]
"""Returns why the ledgers would refuse layers, by amplifier, now; None if they would admit them."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sets:
    """The sets of all amplifiers for one moment; without layers and silence nothing is sent."""

    layers: Mapping[int, PlateLayer] = field(default_factory=dict)
    """Layers that change, by number."""
    started: frozenset[int] = frozenset()
    """Of these, the layers that play another content."""
    endings: Mapping[int, answer.Layer] = field(default_factory=dict)
    """Of the others, those that get an ending, or the next piece of a course."""
    silence: float | None = None
    """Ramp [s] along which all layers fall silent instead."""
    settled_after: float = 0.0
    """Time [s] until the last ramp or onset has ended."""
    skipped: Sequence[Content] = ()
    """Contents that a ledger does not admit."""
    reason: str = ""
    """Why it does not."""
    retry_at: float = math.inf
    """When [s] it may."""
    preempted_until: float = math.inf
    """When [s] a touch no longer preempts endings, pieces of courses among them."""

    @cached_property
    def by_amplifier(self) -> dict[str, list[AmplifierLayer]]:
        """The layers of each amplifier, by name."""
        of_each: dict[str, list[AmplifierLayer]] = {}
        for layers in self.layers.values():
            for name, layer in layers.items():
                of_each.setdefault(name, []).append(layer)
        return of_each

    def __bool__(self) -> bool:
        """Whether anything is to be sent."""
        return bool(self.layers) or self.silence is not None


class Layers:
    """The layers of all amplifiers of a rig; times are arguments.

    check: asks the ledgers; expiry_of: returns when [s] a contact is lifted unless a frame arrives.
    """

    def __init__(
        self,
        rig: Rig,
        capabilities: PlaybackCapabilities,
        timing: Timing,
        *,
        check: Check = lambda layers: None,
        expiry_of: Callable[[ContactKey], float],
    ) -> None:
        self._rig, self._count = rig, capabilities.layers
        self.check, self._expiry_of = check, expiry_of
        self.builder = SetBuilder(rig, capabilities.envelope_support, capabilities.ramp_max, timing)
        """Makes the sets."""
        has_endings = capabilities.envelope_support.ending_knots > 0
        self._may_follow = has_endings and rig.limits.rate >= _MIN_RATE
        # A limit of slew lengthens ramps.
        knots = capabilities.course_knots if math.isinf(rig.limits.slew) else 0
        self._course_knots = knots  # of a piece, 0 for ramps
        if not knots:
            why = "without envelopes" if math.isinf(rig.limits.slew) else "with a limit of slew"
            _logger.debug("loop: files follow in ramps of %g s, %s", PLAIN_STEP, why)
        self.contents: Mapping[int, LayerContent] = {}
        """What plays, by layer."""
        self.due = math.inf
        """When [s] the next content is renewed, gets its ending, or has ended by itself."""
        self.ending_due = math.inf
        """When [s] the next content gets its ending, or the next piece of its course."""
        self.may_play: frozenset[int] = frozenset()
        """Layers that may play; empty once all are silent for certain."""
        self.is_silent = False
        """Whether all layers are silent, for certain."""
        self._fades_until = -math.inf  # s; what was ended or replaced
        self._over: tuple[Content, ...] = ()  # ended by themselves
        # By finger and voice, also where what plays is unknown.
        self._layer_of: Mapping[tuple[ContactKey, int], int] = {}

    def plan(self, contents: Sequence[Content], now: float) -> Sets:
        """Return the sets by which layers play these contents and no others from a time [s] on.

        Contents that play already stay as they are.
        """
        left, skipped = [*contents], list[Content]()
        reason, retry_at = "", math.inf
        while True:
            for is_shaped in (True, False):
                sets, playing = self._sets(left, now, is_shaped=is_shaped)
                refusal = self.check(sets.by_amplifier) if sets.started else None
                if refusal is None:
                    if sets.layers:
                        self.start(sets, playing, now)
                    if skipped:
                        sets = replace(sets, skipped=skipped, reason=reason, retry_at=retry_at)
                    return sets
                _logger.info("loop: a ledger refuses what plays shaped, then plain: %s", refusal)
                if self._fades(sets):
                    self._fades_until = now + FADED_AFTER
                reason, until = str(refusal), refusal.until
            retry_at = self._faded_by(contents, now) if until is None else until
            newest = max([playing[number] for number in sets.started], key=_requested_at).content
            voices = [each for each in left if each.targets == newest.targets]
            skipped, left = skipped + voices, [each for each in left if each not in voices]

    def may_lead(self, contents: Sequence[Content], now: float) -> bool:
        """Whether contents may be led to from what plays at a time [s].

        Each must take the place of one that plays. Each other frequency needs a free layer, and
        the ledgers must admit both together.
        """
        if {each.key for each in contents} - {one.content.key for one in self.contents.values()}:
            return False
        before = [(self._led_from(each), each.frequency) for each in contents]
        tuned = [each for each, new in before if each and each.content.frequency != new]
        if len(self.may_play) + len(tuned) > self._count:
            return False
        return self.check(self._sets(contents, now, is_shaped=True)[0].by_amplifier) is None

    def silence(self, ramp: float, now: float) -> Sets:
        """Return the sets that silence all layers along a ramp [s]; empty if they are silent."""
        if self.is_silent:
            return Sets()
        self._replace({})
        self.is_silent, self._layer_of, self._fades_until = True, {}, now + FADED_AFTER
        return Sets(silence=ramp)

    def endings(self, now: float) -> Sets:
        """Return the sets that give endings to what plays, where that is due at a time [s].

        They are sets of their own, so that no touch waits for endings. A content whose ending a
        ledger refuses fades later; one that gives way to another falls. The next pieces of courses
        are among them, while sources confirm the contacts.
        """
        layers: dict[int, PlateLayer] = {}
        endings: dict[int, answer.Layer] = {}
        due = [one for one in self.contents.values() if one.ending_due <= now]
        urgent = min([one.course_until for one in due if one.content.course], default=math.inf)
        for number, one in self.contents.items():
            if one.ending_due <= now and (led := one.content.course) is not None:
                if now < self._confirmed_until(one.content):
                    layers[number], endings[number] = self._piece(
                        number, one.content, *led, now, among=len(due), before=one
                    )
            elif one.ending_due <= now and one.is_falling:
                layers[number] = self.builder.build_fall(
                    number, one.layer.excitation, ramp=CROSSFADE, playing=self._drive_of(number)
                )
                endings[number] = one.layer
            elif one.ending_due <= now:
                content = one.content
                layers[number], endings[number] = self.builder.build_ending(
                    number,
                    replace(content.layer, ramp=one.layer.ramp),
                    content.placement,
                    playing=self._drive_of(number),
                    valid_for=self._lasts(content, _all_left(content, now), now),
                )
        sets = Sets(layers, endings=endings, preempted_until=urgent - HELD / 2)
        if layers and (refusal := self.check(sets.by_amplifier)) is not None:
            self.not_renewed(sets, refusal)
            return Sets()
        return sets

    def renewal(self, now: float) -> Sets:
        """Return the sets that prolong what plays, where that is due at a time [s].

        A content that a ledger refuses for good ends by itself.
        """
        if endings := self.endings(now):
            return endings
        sets = {
            number: self.builder.build_renewal(
                number,
                ramp=one.layer.ramp,
                valid_for=self._lasts(content, _all_left(content, now), now),
            )
            for number, one in self.contents.items()
            for content in (one.content,)
            if one.renewal_due <= now < one.renewable_until
            and self._confirmed_until(content) > one.confirmed_until
        }
        renewal = Sets(sets)
        if sets and (refusal := self.check(renewal.by_amplifier)) is not None:
            self.not_renewed(renewal, refusal)
            return Sets()
        return renewal

    def not_renewed(self, renewal: Sets, refusal: CommandRefused) -> None:
        """Note that layers are not prolonged; after a refusal for good they end."""
        due = math.inf if refusal.until is None else refusal.until
        for number in renewal.endings:
            has_course = self.contents[number].content.course is not None
            self._change(number, ending_due=due if has_course else math.inf)
        for number in renewal.layers.keys() - renewal.endings.keys():
            self._change(number, renewal_due=due)

    def have_settled(self, now: float) -> bool:
        """Whether all that may play has settled, so that endings lead from there."""
        may_end = [self._may_end_shaped(number, now) for number in self.may_play]
        return bool(may_end) and all(may_end)

    def confirm(self, sets: Sets, played: PlayedSet, now: float) -> None:
        """Note what the amplifiers play of sets that were committed by now [s].

        A content that a ledger has shortened is not renewed: that would circumvent its limit.
        """
        going_on = sets.layers.keys() & self.contents.keys()
        self.may_play = self.may_play.difference(sets.layers).union(going_on)
        for number in going_on:
            one, lasts = self.contents[number], _shortest(played, number)
            since = max(now, one.course_until)  # a piece waits for the one before
            if one.content.course is not None:
                starts = max(played.starts_at, one.course_until)
                piece, is_first = sets.endings.get(number, one.layer), number in sets.started
                self._confirm_piece(number, piece, starts, now, is_first=is_first)
            elif number in sets.started:
                drive = tones_by_era(played.layers, self._rig, number)
                settled_at = now + one.settled_after
                due = settled_at + _SURELY_SETTLED
                has_ending = one.is_shaped and due < now + lasts and self._may_follow
                due = due if has_ending else math.inf
                self._change(number, drive=drive, settled_at=settled_at, ending_due=due)
            elif number in sets.endings:
                layer = replace(one.layer, ending=sets.endings[number].ending)
                self._change(number, layer=layer, ending_due=math.inf)
            self._change(
                number,
                confirmed_until=self._confirmed_until(one.content),
                renewal_due=math.inf if lasts < _MIN_VALID_FOR else now + lasts / 2,
                renewable_until=now + lasts - _MARGIN / 2,
                ends_at=since + lasts,
            )

    def forget(self) -> None:
        """Discard what plays, which is unknown; fingers keep their layers."""
        self._replace({})
        self.is_silent, self._over = False, ()

    def ended(self, now: float) -> tuple[Content, ...]:
        """Return the contents that have ended by themselves by a time [s], each once.

        Those of which a piece is due, for which the host was late, go on.
        """
        over = [
            number
            for number, one in self.contents.items()
            if one.drive and now >= one.ends_at and not self._goes_on(one, now)
        ]
        fallen = {number for number in over if self.contents[number].is_falling}
        self.may_play -= fallen
        self._replace({n: one for n, one in self.contents.items() if n not in fallen})
        over = [number for number in over if number not in fallen]
        for number in over:
            self._change(number, drive={}, ending_due=math.inf)
        contents = tuple(self.contents[number].content for number in over)
        self._over = (*self._over, *contents)
        return contents

    def _goes_on(self, one: LayerContent, now: float) -> bool:
        """Whether a piece of its course is due."""
        is_due = one.content.course is not None and one.ending_due <= now
        return is_due and now < self._confirmed_until(one.content)

    def over_of(self, contents: Sequence[Content]) -> tuple[Content, ...]:
        """Return which of the wanted contents have ended by themselves."""
        if self._over:
            over = [(each.key, each.targets, each.placement) for each in self._over]
            self._over = tuple(
                [one for one in contents if (one.key, one.targets, one.placement) in over]
            )
        return self._over

    def numbered(self, contents: Sequence[Content]) -> dict[int, Content]:
        """Return contents by layer: the own one, or that of the finger, or one that ends.

        A content that another gives way to gets a free layer. So does a short pulse if it can,
        since what ends in its layer would fade along its short ramp.
        """
        numbers: dict[int, Content] = {}
        for number, one in self.contents.items():
            if one.content in contents:  # what is predicted of it may differ
                numbers[number] = contents[contents.index(one.content)]
        kept, new = [*numbers.values()], list[Content]()
        for content in contents:
            if content in kept:
                continue
            known = self._layer_of.get(content.key)
            before = self._led_from(content)
            if before is not None and before.content.frequency != content.frequency:
                free = [n for n in range(self._count) if n not in self.may_play | numbers.keys()]
                known = next(iter(free), known)
            if known is None:
                new.append(content)
            else:
                numbers[known] = content
        falls = {number for number, one in self.contents.items() if one.is_falling}
        falling = sorted(falls & self.may_play - numbers.keys())
        ending = sorted(self.may_play - numbers.keys() - falls)
        free = [n for n in range(self._count) if n not in self.may_play and n not in numbers]
        for content in new:
            first, second = (free, ending) if content.key[1] == CLICK else (ending, free)
            if some := first or second or falling:
                numbers[some.pop(0)] = content
        return numbers

    def starting(self, numbers: Mapping[int, Content]) -> list[int]:
        """Return the layers whose contents start.

        Side bands join a carrier that plays: all count their phases on one clock.
        """
        changed = []
        for number, content in numbers.items():
            if number not in self.contents or self.contents[number].content != content:
                changed.append(number)
        return changed

    def start(self, sets: Sets, playing: Mapping[int, LayerContent], now: float) -> None:
        """Note that sets are sent at a time [s], and what all layers play."""
        if self._fades(sets):
            self._fades_until = now + FADED_AFTER
        self._replace(playing)
        self.is_silent = False
        self._layer_of = {
            one.content.key: number for number, one in playing.items() if not one.is_falling
        }
        self.may_play |= sets.started

    def _sets(
        self, contents: Sequence[Content], now: float, *, is_shaped: bool
    ) -> tuple[Sets, dict[int, LayerContent]]:
        """Return the sets for these contents, and what all layers play then."""
        numbers = self.numbered(contents)
        starting = self.starting(numbers)
        layers: dict[int, PlateLayer] = {}
        playing: dict[int, LayerContent] = {}
        for number, one in self.contents.items():
            if number in numbers and number not in starting:
                content = numbers[number]
                playing[number] = one if one.content is content else replace(one, content=content)
        settled = [0.0]
        for number in starting:
            content = numbers[number]
            if (led := content.course) is not None:
                layers[number], played = self._piece(
                    number, content, *led, now, among=len(starting)
                )
                playing[number] = LayerContent(content, played)
                settled.append(playing[number].settled_after)
                continue
            left, fade = _all_left(content, now), self._fade_of(number, content)
            layers[number], played = self.builder.build_pattern(
                number,
                replace(content.layer, ramp=fade) if fade else content.layer,
                content.placement,
                playing=self._drive_of(number),
                valid_for=self._lasts(content, left, now),
                is_led=fade > 0,
                is_shaped=is_shaped and not content.targets[0][1].is_short,
                among=len(starting),
            )
            may_end = is_shaped and not content.targets[0][1].is_short
            playing[number] = LayerContent(content, played, is_shaped=may_end)
            settled.append(playing[number].settled_after)
        is_clicking = any(content.targets[0][1].is_short for content in contents)
        ramp = min(BESIDE_CLICK if is_clicking else FADE_RAMP, self.builder.ramp_max)
        for number in self.may_play - numbers.keys():
            if is_shaped and (falling := self._falling(number, contents, now)) is not None:
                playing[number] = falling
                continue
            has_endings = is_shaped and self._may_end_shaped(number, now)
            layers[number] = self.builder.build_end(number, ramp, has_endings=has_endings)
            settled.append(ramp)
        return Sets(layers, frozenset(starting), settled_after=max(settled)), playing

    def _piece(
        self,
        number: int,
        content: Content,
        course: Course,
        pulse: Pulse,
        now: float,
        *,
        among: int,
        before: LayerContent | None = None,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Return the set of the next piece of a content's course in a layer, and what is played.

        The piece starts where the pulse is at a time [s], or when the piece before ends if that has
        not ended yet. among: pieces that are sent together; before: the layer with the piece
        before, None for the first.
        """
        is_after, knots, starts = False, self._course_knots, now
        if before is None:
            knots = min(knots, self.builder.support.onset_knots)
        elif now < before.course_until:
            is_after, starts = True, before.course_until
        piece = piece_of(
            course,
            pulse,
            0.0 if pulse.started_at is None else starts - pulse.started_at,
            knots=max(knots // among, 1) if knots else 0,
            is_first=before is None,
        )
        has_ended = before is not None and now >= before.ends_at
        return self.builder.build_piece(
            number,
            content.layer,
            piece,
            playing={} if has_ended else self._drive_of(number),
            valid_for=piece.duration + HELD,
            is_after=is_after and piece.has_knots,
        )

    def _confirm_piece(
        self, number: int, played: answer.Layer, since: float, now: float, *, is_first: bool
    ) -> None:
        """Note that a piece of a layer's course is confirmed, which starts at a time [s].

        The second piece is sent at once, each later one when half of that before has been played.
        """
        one = self.contents[number]
        until = since + replace(one, layer=played).settled_after
        due = now + MIN_LEFT if is_first else (since + until) / 2
        due = due if played.onset else until
        pulse = one.content.targets[0][1].pulse
        is_over = pulse is not None and until > pulse.end - MIN_LEFT
        self._change(
            number,
            drive=full_drive(one.content.layer.excitation, self._rig),
            course_until=until,
            ending_due=math.inf if is_over else due,
        )

    def _fade_of(self, number: int, content: Content) -> float:
        """Return the time [s] in which a content takes the place of another; 0 where it begins."""
        before = self.contents[number].content if number in self.contents else None
        same = [
            (one.key, one.frequency, one.targets[0][1].pulse) for one in (before, content) if one
        ]
        if before is not None and before.gain_db != content.gain_db:
            return STRENGTH_FADE if same[0] == same[1] else 0.0
        is_led = self._led_from(content) is not None and same[0] == same[-1]
        return CROSSFADE if is_led else 0.0

    def _led_from(self, content: Content) -> LayerContent | None:
        """Return what a content that is led to takes the place of, if anything."""
        one = self.contents.get(self._layer_of.get(content.key, -1))
        if one is None or not content.is_led or one.content == content:
            return None
        return None if one.content.targets[0][1].is_short else one

    def _falling(self, number: int, contents: Sequence[Content], now: float) -> LayerContent | None:
        """Return a layer as it gives way to one of these contents; None if it ends at once."""
        if (one := self.contents.get(number)) is None:
            return None
        for content in contents:
            if one.is_falling and content.is_led and content.key == one.content.key:
                return one
            if self._led_from(content) is one:
                due = now + FALL_AFTER
                return replace(one, is_falling=True, ending_due=due, renewal_due=math.inf)
        return None

    def _fades(self, sets: Sets) -> bool:
        """Whether anything that plays is ended or replaced."""
        if len(sets.layers) > len(sets.started):
            return True
        for number in sets.started:
            if number in self.contents and self.contents[number].drive:
                return True
        return False

    def _faded_by(self, contents: Sequence[Content], now: float) -> float:
        """Return when [s] pulses that play, or what was ended, have faded; after RETRY if none."""
        pulses = [target.pulse for one in contents for _, target in one.targets]
        started = [each for each in pulses if each is not None and each.started_at is not None]
        ends = [each.end for each in started if each.end > now]
        if now < self._fades_until:
            ends.append(now)
        return max(ends, default=now + RETRY) + FADED_AFTER

    def _change(self, number: int, **values: Any) -> None:
        """Give what plays in a layer other values of its fields."""
        self._replace({**self.contents, number: replace(self.contents[number], **values)})

    def _replace(self, contents: Mapping[int, LayerContent]) -> None:
        self.contents, self.due, self.ending_due = contents, math.inf, math.inf
        for one in contents.values():
            self.ending_due = min(self.ending_due, one.ending_due)
            self.due = min(self.due, one.renewal_due, one.ends_at if one.drive else math.inf)
        self.due = min(self.due, self.ending_due)

    def _confirmed_until(self, content: Content) -> float:
        """Return when [s] the first target of a content is lifted unless a frame arrives."""
        until = math.inf
        for contact, _ in content.targets:
            until = min(until, self._expiry_of(contact.key))
        return until

    def _lasts(self, content: Content, left: Sequence[float], now: float) -> float:
        """Return for how long [s] a content may last by itself from a time [s] on.

        left: time [s] of each target; the amplifiers end the content with the last pulse.
        """
        until = self._confirmed_until(content)
        unlimited = min(max(until - now + _MARGIN, _MIN_VALID_FOR), MAX_CONTACT_TIMEOUT)
        return min(unlimited, max(left, default=math.inf))

    def _may_end_shaped(self, number: int, now: float) -> bool:
        """Whether a layer has settled, so that its endings lead from what plays."""
        one = self.contents.get(number)
        return one is not None and bool(one.layer.ending) and now >= one.settled_at

    def _drive_of(self, number: int) -> Drive:
        """Return what plays in a layer, at frequencies not rounded by wire and amplifier."""
        drive: dict[str, AmplifierTone] = {}
        if (one := self.contents.get(number)) is None:
            return drive
        for name, tone in one.drive.items():
            if name in one.layer.excitation:
                drive[name] = replace(tone, frequency=one.layer.excitation[name].frequency)
        return drive


def _requested_at(one: LayerContent) -> float:
    """When [s] a content was requested, by its pulse or its contact."""
    contact, target = one.content.targets[0]
    return contact.since if target.pulse is None else target.pulse.requested_at


def _all_left(content: Content, now: float) -> list[float]:
    """Return how long [s] each target is driven from a time [s]; infinite without a pulse."""
    left = []
    for _, target in content.targets:
        pulse = target.pulse
        if pulse is None:
            left.append(math.inf)
        elif pulse.started_at is None:
            left.append(pulse.duration)
        else:
            left.append(max(pulse.end - now, MIN_LEFT))
    return left


def _shortest(played: PlayedSet, number: int) -> float:
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
