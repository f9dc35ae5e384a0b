"""The slots of a plate: contents in, sets out; what each layer plays, and until when.

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

from controller.play.intent import CLICK, FADED_AFTER, Content, Pulse
from controller.play.routing import (
    BESIDE_CLICK,
    HELD,
    PLAIN_STEP,
    Drive,
    PlateLayer,
    PlaybackCapabilities,
    full_drive,
    piece_of,
    restarted_by,
    route,
    thinned,
    tones_by_era,
)
from controller.sources.touch import MAX_CONTACT_TIMEOUT, ContactKey
from drivers.errors import CommandRefused
from drivers.host.joint_sets import PlayedSet
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import is_vibrating
from model.answer import answer
from model.answer.answer_report import Timing
from model.answer.stimulus import FADE_RAMP, Course
from model.rig.rig import Rig
from model.transients.base_motion import BaseEnvelope
from model.vibration import Tone

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
_VALID_FOR, _LEVEL = QUANTITIES["valid_for"], QUANTITIES["level"]

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


@dataclass
class Slot:
    """A content in its layer; it starts, plays, gets its ending or pieces, is renewed, falls, ends.

    What is due at one is due at `due`. `replace` makes a copy that does not change.
    """

    content: Content
    layer: answer.Layer
    """With the ramp, onset and ending of its sets."""
    drive: Drive = field(default_factory=dict)
    """By ERA, as confirmed; empty while it starts, and once it has ended."""
    settled_at: float = math.inf
    """When [s] its onset has ended."""
    is_shaped: bool = False
    """Whether it may have an ending; until it has one, it fades."""
    ending_due: float = math.inf
    """When [s] its ending is sent, once the onset has ended, or the next piece of its course, or
    when it falls."""
    confirmed_until: float = math.inf
    """When [s] its first target would have been lifted, as known when it was sent."""
    renewal_due: float = math.inf
    """When [s] it is renewed, if all targets have been confirmed since it was sent, and a margin is
    left until its end."""
    ends_at: float = math.inf
    """When [s] it has ended by itself unless it was renewed."""
    is_falling: bool = False
    """Whether another content takes its place along a cross-fade; it is not renewed."""
    course_until: float = -math.inf
    """When [s] what has been sent of its course ends."""

    @property
    def due(self) -> float:
        """When [s] its ending, its renewal or its end is due."""
        return min(self.ending_due, self.renewal_due, self.ends_at if self.drive else math.inf)


class Slots:
    """The slots of all layers of a rig; times are arguments.

    timing: shapes patterns; check: asks the ledgers; expiry_of: returns when [s] a contact is
    lifted unless a frame arrives.
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
        self._rig, self._count, self.timing = rig, capabilities.layers, timing
        self.check, self._expiry_of = check, expiry_of
        self._support, self._ramp_max = capabilities.envelope_support, capabilities.ramp_max
        self._may_follow = self._support.ending_knots > 0 and rig.limits.rate >= _MIN_RATE
        # A limit of slew lengthens ramps.
        knots = capabilities.course_knots if math.isinf(rig.limits.slew) else 0
        self._course_knots = knots  # of a piece, 0 for ramps
        if not knots:
            why = "without envelopes" if math.isinf(rig.limits.slew) else "with a limit of slew"
            _logger.debug("loop: files follow in ramps of %g s, %s", PLAIN_STEP, why)
        self.contents: dict[int, Slot] = {}
        """What plays, by layer."""
        self.may_play: frozenset[int] = frozenset()
        """Layers that may play; empty once all are silent for certain."""
        self.is_silent = False
        """Whether all layers are silent, for certain."""
        self._fades_until = -math.inf  # s; what was ended or replaced
        self._over: tuple[Content, ...] = ()  # ended by themselves
        # By finger and voice, also where what plays is unknown.
        self._layer_of: Mapping[tuple[ContactKey, int], int] = {}

    @property
    def due(self) -> float:
        """When [s] the next content is renewed, gets its ending, or has ended by itself."""
        return min([one.due for one in self.contents.values()], default=math.inf)

    @property
    def ending_due(self) -> float:
        """When [s] the next content gets its ending, or the next piece of its course."""
        return min([one.ending_due for one in self.contents.values()], default=math.inf)

    def plan(self, contents: Sequence[Content], now: float) -> Sets:
        """Return the sets by which layers play these contents and no others from a time [s] on.

        Contents that play already stay as they are.
        """
        left, skipped = [*contents], list[Content]()
        reason, retry_at = "", math.inf
        while True:
            for is_shaped in (True, False):
                sets, playing = self._sets(left, now, is_shaped=is_shaped)
                driven = [number for number, one in self.contents.items() if one.drive]
                if len(sets.layers) > len(sets.started) or not sets.started.isdisjoint(driven):
                    self._fades_until = now + FADED_AFTER
                refusal = self.check(sets.by_amplifier) if sets.started else None
                if refusal is None:
                    if sets.layers:
                        self.contents, self.is_silent = playing, False
                        self._layer_of = {
                            one.content.key: number
                            for number, one in playing.items()
                            if not one.is_falling
                        }
                        self.may_play |= sets.started
                    if skipped:
                        sets = replace(sets, skipped=skipped, reason=reason, retry_at=retry_at)
                    return sets
                _logger.info("loop: a ledger refuses what plays shaped, then plain: %s", refusal)
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
        self.contents = {}
        self.is_silent, self._layer_of, self._fades_until = True, {}, now + FADED_AFTER
        return Sets(silence=ramp)

    def endings(self, now: float) -> Sets:
        """Return the sets that give endings to what plays, where that is due at a time [s].

        They are sets of their own, so that no touch waits for endings. A content whose ending a
        ledger refuses fades later; one that gives way to another falls. The next pieces of courses
        are among them, while sources confirm the contacts.
        """
        layers, endings = dict[int, PlateLayer](), dict[int, answer.Layer]()
        due = {number: one for number, one in self.contents.items() if one.ending_due <= now}
        urgent = min(
            [one.course_until for one in due.values() if one.content.course], default=math.inf
        )
        for number, one in due.items():
            if (led := one.content.course) is None:
                build = self._fall if one.is_falling else self._ending
                layers[number], endings[number] = build(number, one, now)
            elif now < self._confirmed_until(one.content):
                layers[number], endings[number] = self._piece(
                    number, one.content, *led, now, among=len(due), before=one
                )
        return self._admitted(Sets(layers, endings=endings, preempted_until=urgent - HELD / 2))

    def renewal(self, now: float) -> Sets:
        """Return the sets that prolong what plays, where that is due at a time [s].

        A content that a ledger refuses for good ends by itself.
        """
        if endings := self.endings(now):
            return endings
        sets = dict[int, PlateLayer]()
        for number, one in self.contents.items():
            is_due = one.renewal_due <= now < one.ends_at - _MARGIN / 2
            if is_due and self._confirmed_until(one.content) > one.confirmed_until:
                lasts = self._lasts(one.content, now)
                layer = AmplifierLayer(number, ramp=one.layer.ramp, valid_for=lasts, renew=True)
                sets[number] = dict.fromkeys(self._rig.amplifiers, layer)
        return self._admitted(Sets(sets))

    def _admitted(self, sets: Sets) -> Sets:
        """Return sets by which nothing starts, or none if a ledger refuses them."""
        if sets.layers and (refusal := self.check(sets.by_amplifier)) is not None:
            self.not_renewed(sets, refusal)
            return Sets()
        return sets

    def not_renewed(self, renewal: Sets, refusal: CommandRefused) -> None:
        """Note that layers are not prolonged; after a refusal for good they end."""
        due = math.inf if refusal.until is None else refusal.until
        for number in renewal.layers:
            one = self.contents[number]
            if number not in renewal.endings:
                one.renewal_due = due
            else:
                one.ending_due = math.inf if one.content.course is None else due

    def have_settled(self, now: float) -> bool:
        """Whether all that may play has settled, so that endings lead from there."""
        return bool(self.may_play) and all(self._may_end_shaped(n, now) for n in self.may_play)

    def confirm(self, sets: Sets, played: PlayedSet, now: float) -> None:
        """Note what the amplifiers play of sets that were committed by now [s].

        A content that a ledger has shortened is not renewed: that would circumvent its limit. The
        second piece of a course is sent at once, each later one when half of that before has been
        played.
        """
        going_on = sets.layers.keys() & self.contents.keys()
        self.may_play = self.may_play.difference(sets.layers).union(going_on)
        for number in going_on:
            one, lasts = self.contents[number], _shortest(played, number)
            since = max(now, one.course_until)  # a piece waits for the one before
            if (led := one.content.course) is not None:
                piece = sets.endings.get(number, one.layer)
                starts = max(played.starts_at, one.course_until)
                until = one.course_until = starts + _settled_after(piece)
                due = now + MIN_LEFT if number in sets.started else (starts + until) / 2
                is_over = until > led[1].end - MIN_LEFT
                one.ending_due = math.inf if is_over else due if piece.onset else until
                one.drive = full_drive(one.content.layer.excitation, self._rig)
            elif number in sets.started:
                one.drive = tones_by_era(played.layers, self._rig, number)
                one.settled_at = now + _settled_after(one.layer)
                due = one.settled_at + _SURELY_SETTLED
                has_ending = one.is_shaped and due < now + lasts and self._may_follow
                one.ending_due = due if has_ending else math.inf
            elif number in sets.endings:
                one.layer = replace(one.layer, ending=sets.endings[number].ending)
                one.ending_due = math.inf
            one.confirmed_until = self._confirmed_until(one.content)
            one.renewal_due = math.inf if lasts < _MIN_VALID_FOR else now + lasts / 2
            one.ends_at = since + lasts

    def forget(self) -> None:
        """Discard what plays, which is unknown; fingers keep their layers."""
        self.contents = {}
        self.is_silent, self._over = False, ()

    def ended(self, now: float) -> tuple[Content, ...]:
        """Return the contents that have ended by themselves by a time [s], each once.

        Those of which a piece is due, for which the host was late, go on.
        """
        over = list[Content]()
        for number, one in [*self.contents.items()]:
            if not one.drive or now < one.ends_at:
                continue
            is_due = one.content.course is not None and one.ending_due <= now
            if is_due and now < self._confirmed_until(one.content):
                continue
            if one.is_falling:
                self.may_play -= {number}
                del self.contents[number]
            else:
                one.drive, one.ending_due = {}, math.inf
                over.append(one.content)
        self._over = (*self._over, *over)
        return tuple(over)

    def over_of(self, contents: Sequence[Content]) -> tuple[Content, ...]:
        """Return which of the wanted contents have ended by themselves."""
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
        numbers = {
            number: contents[contents.index(one.content)]  # what is predicted of it may differ
            for number, one in self.contents.items()
            if one.content in contents
        }
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

    def _sets(
        self, contents: Sequence[Content], now: float, *, is_shaped: bool
    ) -> tuple[Sets, dict[int, Slot]]:
        """Return the sets for these contents, and what all layers play then."""
        numbers = self.numbered(contents)
        starting = [  # side bands join a carrier that plays: all count their phases on one clock
            number
            for number, content in numbers.items()
            if number not in self.contents or self.contents[number].content != content
        ]
        layers = dict[int, PlateLayer]()
        playing = {
            number: replace(one, content=numbers[number])
            for number, one in self.contents.items()
            if number in numbers and number not in starting
        }
        settled, among = [0.0], len(starting)
        for number in starting:
            content = numbers[number]
            led = content.course
            is_long = is_shaped and led is None and not content.targets[0][1].is_short
            if led is not None:
                layers[number], played = self._piece(number, content, *led, now, among=among)
            else:
                layers[number], played = self._pattern(
                    number, content, now, among=among, is_shaped=is_long
                )
            playing[number] = Slot(content, played, is_shaped=is_long)
            settled.append(_settled_after(played))
        is_clicking = any(content.targets[0][1].is_short for content in contents)
        ramp = min(BESIDE_CLICK if is_clicking else FADE_RAMP, self._ramp_max)
        for number in self.may_play - numbers.keys():
            if is_shaped and (falling := self._falling(number, contents, now)) is not None:
                playing[number] = falling
                continue
            if is_shaped and self._may_end_shaped(number, now):
                end = AmplifierLayer(number, ramp=ramp)
                layers[number] = dict.fromkeys(self._rig.amplifiers, end)
            else:
                layers[number] = route({}, self._rig, ramp=ramp, number=number)
            settled.append(ramp)
        return Sets(layers, frozenset(starting), settled_after=max(settled)), playing

    def _pattern(
        self, number: int, content: Content, now: float, *, among: int, is_shaped: bool
    ) -> tuple[PlateLayer, answer.Layer]:
        """Return the set of a pattern in a layer, and the pattern as it is played.

        A tone that continues needs no onset, nor does one that is led along its ramp, though an ERA
        joins it. among: layers that change at once, which share the time on the wires; is_shaped:
        whether it may have an onset; its ending follows (`_ending`).
        """
        fade, layer = self._fade_of(number, content), content.layer
        tones, playing, onset = layer.excitation, self._drive_of(number), None
        restarted = restarted_by(tones, playing)
        if is_shaped:
            frequencies = [tone.frequency for tone in tones.values()]
            is_continued = fade > 0 or not restarted.issuperset(frequencies)
            shaped = self._support.shape(
                self.timing, content.placement, layer, is_continued, adds_ending=False
            )
            if onset := shaped.onset:
                onset = thinned(onset, knots=max(1, self._support.onset_knots // among))
        layers = route(
            tones,
            self._rig,
            ramp=min(fade or layer.ramp, self._ramp_max),
            number=number,
            playing=playing,
            restarted=restarted,
            valid_for=self._lasts(content, now),
            onset=onset,
        )
        ramp = next(iter(layers.values())).ramp
        return layers, replace(layer, ramp=ramp, onset=onset, ending=None)

    def _ending(self, number: int, one: Slot, now: float) -> tuple[PlateLayer, answer.Layer]:
        """Return the set that gives an ending to a pattern, which plays on as it is, and both."""
        content = one.content
        layer = replace(content.layer, ramp=one.layer.ramp)
        layer = self._support.shape(self.timing, content.placement, layer, is_continued=True)
        layers = route(
            layer.excitation,
            self._rig,
            ramp=layer.ramp,
            number=number,
            playing=self._drive_of(number),
            restarted=frozenset(),
            valid_for=self._lasts(content, now),
            ending=layer.ending,
        )
        return layers, layer

    def _fall(self, number: int, one: Slot, now: float) -> tuple[PlateLayer, answer.Layer]:
        """Return the set by which a layer falls to below any threshold, and ends; and its layer.

        It does not fall to silence, since no later set could end that sooner, as where a finger
        lifts.
        """
        least, ramp = _LEVEL.from_wire(1), min(CROSSFADE, self._ramp_max)
        faint = {
            name: replace(tone, amplitude=least * self._rig.full_levels[name])
            for name, tone in one.layer.excitation.items()
        }
        layers = route(
            faint,
            self._rig,
            ramp=ramp,
            number=number,
            playing=self._drive_of(number),
            restarted=frozenset(),
            valid_for=ramp,
        )
        return layers, one.layer

    def _piece(
        self,
        number: int,
        content: Content,
        course: Course,
        pulse: Pulse,
        now: float,
        *,
        among: int,
        before: Slot | None = None,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Return the set of the next piece of a content's course in a layer, and what is played.

        The piece starts where the pulse is at a time [s], or when the piece before ends if that has
        not ended yet, and from wherever its tones are. among: pieces that are sent together;
        before: the slot with the piece before, None for the first.
        """
        is_after, starts, playing = False, now, self._drive_of(number)
        knots = self._course_knots
        if before is None:
            knots = min(knots, self._support.onset_knots)
        else:
            is_after, starts = now < before.course_until, max(now, before.course_until)
            playing = {} if now >= before.ends_at else playing
        since = 0.0 if pulse.started_at is None else starts - pulse.started_at
        knots = max(knots // among, 1) if knots else 0
        step, shares = piece_of(course, pulse, since, knots=knots, is_first=before is None)
        onset: dict[str, BaseEnvelope] = {}
        last, tones = dict[str, Tone](), content.layer.excitation
        for name, tone in tones.items():
            last[name] = replace(tone, amplitude=shares[-1] * tone.amplitude)
            if len(shares) > 1:  # else a ramp
                motions = tuple([share * tone.phasor for share in shares])
                onset[name] = BaseEnvelope(tone.frequency, 0.0, motions, step)
        layers = route(
            last,
            self._rig,
            ramp=min(FADE_RAMP if onset else step, self._ramp_max),
            number=number,
            playing=playing,
            restarted=frozenset(),
            valid_for=step * len(shares) + HELD,
            onset=onset or None,
        )
        ramp, is_after = next(iter(layers.values())).ramp, is_after and bool(onset)
        after = {name: replace(each, after=is_after) for name, each in layers.items()}
        return after, replace(content.layer, ramp=ramp, onset=onset or None, ending=None)

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

    def _led_from(self, content: Content) -> Slot | None:
        """Return what a content that is led to takes the place of, if anything."""
        one = self.contents.get(self._layer_of.get(content.key, -1))
        if one is None or not content.is_led or one.content == content:
            return None
        return None if one.content.targets[0][1].is_short else one

    def _falling(self, number: int, contents: Sequence[Content], now: float) -> Slot | None:
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

    def _faded_by(self, contents: Sequence[Content], now: float) -> float:
        """Return when [s] pulses that play, or what was ended, have faded; after RETRY if none."""
        pulses = [to.pulse for one in contents for _, to in one.targets if to.pulse is not None]
        ends = [each.end for each in pulses if each.started_at is not None and each.end > now]
        if now < self._fades_until:
            ends.append(now)
        return max(ends, default=now + RETRY) + FADED_AFTER

    def _confirmed_until(self, content: Content) -> float:
        """Return when [s] the first target of a content is lifted unless a frame arrives."""
        return min([self._expiry_of(contact.key) for contact, _ in content.targets])

    def _lasts(self, content: Content, now: float) -> float:
        """Return for how long [s] a content may last by itself from a time [s] on.

        The amplifiers end the content with the last pulse.
        """
        until = self._confirmed_until(content)
        unlimited = min(max(until - now + _MARGIN, _MIN_VALID_FOR), MAX_CONTACT_TIMEOUT)
        return min(unlimited, max([_left(target.pulse, now) for _, target in content.targets]))

    def _may_end_shaped(self, number: int, now: float) -> bool:
        """Whether a layer has settled, so that its endings lead from what plays."""
        one = self.contents.get(number)
        return one is not None and bool(one.layer.ending) and now >= one.settled_at

    def _drive_of(self, number: int) -> Drive:
        """Return what plays in a layer, at frequencies not rounded by wire and amplifier."""
        if (one := self.contents.get(number)) is None:
            return {}
        tones = one.layer.excitation
        return {
            name: replace(tone, frequency=tones[name].frequency)
            for name, tone in one.drive.items()
            if name in tones
        }


def _requested_at(one: Slot) -> float:
    """When [s] a content was requested, by its pulse or its contact."""
    contact, target = one.content.targets[0]
    return contact.since if target.pulse is None else target.pulse.requested_at


def _left(pulse: Pulse | None, now: float) -> float:
    """Return how long [s] a target is driven from a time [s]; infinite without a pulse."""
    if pulse is None:
        return math.inf
    return pulse.duration if pulse.started_at is None else max(pulse.end - now, MIN_LEFT)


def _settled_after(layer: answer.Layer) -> float:
    """Return how long [s] after the commit the ramp or onset of a layer has ended."""
    last = next(iter(layer.onset.values())).duration if layer.onset else 0.0
    return max(layer.ramp, last)


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
