"""Slots: which content each layer plays, until when, and the sets for it.

The ledgers are queried before a set is made. Contents that they refuse are played along plain
ramps, then without the newest content; if no content is left, nothing plays. A vibration ends by
itself if the host or a touch source falls silent, so it is renewed only while sources confirm its
contacts. A layer with a course gets a set for each piece, half a piece ahead.
"""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

from controller.play.intent import CLICK, FADED_AFTER, Content, ContentKey, Pulse, Targets
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
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import is_vibrating
from model.answer import answer
from model.answer.answer_report import Timing
from model.answer.stimulus import FADE_RAMP, Placement
from model.rig.rig import Rig
from model.transients.base_motion import BaseEnvelope
from model.vibration import Tone

MIN_LEFT = 0.001
"""Shortest remaining time [s] of a pulse."""

# With no finger left on the plate the end may be short: zero within 20 ms of the lift.
RELEASE_RAMP = 0.010

STRENGTH_FADE = 0.100
"""Time [s] of the raised cosine along which a content changes its strength."""

CROSSFADE = 0.300
"""Time [s] of the raised cosines along which one content replaces another.

Fingers on nulls feel shorter ones.
"""

FALL_AFTER = 0.27 * CROSSFADE
"""Delay [s] after which the replaced content falls, so that its finger feels no dip."""

RETRY = 1.0
"""Time [s] after which a set that was refused for an unknown time is planned again."""

# Shortest time [s] until a vibration ends by itself on the amplifier, so that a slow wire or a rate
# limit of one set a second does not interrupt it. It is renewed at half its time.
_MIN_VALID_FOR = 2.0
_MARGIN = 0.2  # s; after the contact is lifted, for late frames
_SURELY_SETTLED = 0.005  # s; covers the delay from a set's last reply to its start, and clocks
_MIN_RATE = 10.0  # sets/s; with a lower limit, touches would have to wait for endings
_VALID_FOR, _LEVEL = QUANTITIES["valid_for"], QUANTITIES["level"]

Check = Callable[[Mapping[str, Sequence[AmplifierLayer]]], CommandRefused | None]
"""Returns why the ledgers would refuse layers (by amplifier) now; None if they would admit them."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sets:
    """The sets of all amplifiers for one moment; nothing is sent without layers and silence."""

    layers: Mapping[int, PlateLayer] = field(default_factory=dict)
    """Layers that change, by number."""
    started: frozenset[int] = frozenset()
    """Changing layers that start another content."""
    endings: Mapping[int, answer.Layer] = field(default_factory=dict)
    """Changing layers that get an ending, or the next piece of a course."""
    silence: float | None = None
    """Ramp [s] along which all layers fall silent instead."""
    settled_after: float = 0.0
    """Time [s] until the last ramp or onset has ended."""
    skipped: Sequence[Content] = ()
    """Contents that a ledger does not admit."""
    reason: str = ""
    """Why the ledger does not admit them."""
    retry_at: float = math.inf
    """When [s] the ledger may admit them."""
    preempted_until: float = math.inf
    """When [s] a touch no longer preempts endings and pieces of courses."""

    @cached_property
    def by_amplifier(self) -> dict[str, list[AmplifierLayer]]:
        """The layers of each amplifier, by name."""
        by_amplifier: dict[str, list[AmplifierLayer]] = {}
        for plate_layer in self.layers.values():
            for name, layer in plate_layer.items():
                by_amplifier.setdefault(name, []).append(layer)
        return by_amplifier

    def __bool__(self) -> bool:
        """Whether there is anything to send."""
        return bool(self.layers) or self.silence is not None


@dataclass
class Slot:
    """A content in its layer; it starts, plays, gets its ending or pieces, is renewed, falls, ends.

    `due` is the time of the next event. `replace` makes a copy that does not change.
    """

    content: Content
    layer: answer.Layer
    """With the ramp, onset and ending of its sets."""
    drive: Drive = field(default_factory=dict)
    """By ERA, as confirmed; empty while it starts, and once it has ended."""
    settled_at: float = math.inf
    """When [s] its onset has ended."""
    is_shaped: bool = False
    """Whether it can have a shaped ending; until it has got that, it would end along a ramp."""
    ending_due: float = math.inf
    """When [s] to send its ending (once the onset has ended), the next piece of its course, or its
    fall."""
    confirmed_until: float = math.inf
    """When [s] its first target would have been lifted, as known when its set was sent."""
    renewal_due: float = math.inf
    """When [s] to renew it, if all targets have been confirmed since its set was sent and a margin
    is left until it ends."""
    ends_at: float = math.inf
    """When [s] it ends by itself unless it is renewed."""
    is_falling: bool = False
    """Whether another content replaces it in a cross-fade, so that it is not renewed."""
    course_until: float = -math.inf
    """When [s] the last piece of its course that was sent ends."""

    @property
    def due(self) -> float:
        """When [s] its ending, its renewal or its end is due."""
        due = min(self.ending_due, self.renewal_due)
        if not self.drive:  # it starts, or has ended
            return due
        return min(due, self.ends_at)


class _Identity(NamedTuple):
    """The values that identify a content independently of its strength."""

    key: ContentKey
    targets: Targets
    placement: Placement


class _Voice(NamedTuple):
    """The values that are equal for contents that can fade from one to the other."""

    key: ContentKey
    frequency: float | None
    pulse: Pulse | None


class Slots:
    """The slots of all layers of a rig; times are arguments.

    timing: shapes patterns; check: queries the ledgers; expiry_of: returns when [s] a contact is
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
        self.timing = timing
        self.check = check
        self._rig = rig
        self.layer_count = capabilities.layers
        self._ramp_max = capabilities.ramp_max
        self._support = capabilities.envelope_support
        self._expiry_of = expiry_of
        has_endings = self._support.ending_knots > 0
        self._may_follow = has_endings and rig.limits.rate >= _MIN_RATE
        self._course_knots = capabilities.course_knots  # of a piece; 0 for ramps
        cause = "without envelopes"
        if not math.isinf(rig.limits.slew):  # which lengthens ramps
            self._course_knots = 0
            cause = "with a limit of slew"
        if not self._course_knots:
            _logger.debug("loop: files follow in ramps of %g s, %s", PLAIN_STEP, cause)
        self.by_layer: dict[int, Slot] = {}
        """Slots by layer."""
        self.may_play: frozenset[int] = frozenset()
        """Layers that may play; empty once all are silent for certain."""
        self.is_silent = False
        """Whether all layers are silent, for certain."""
        self._fades_until = -math.inf  # s; for contents that were ended or replaced
        self._ended_contents: tuple[Content, ...] = ()  # by themselves
        # By finger and voice, also while the playback is unknown.
        self._layer_of: Mapping[ContentKey, int] = {}

    @property
    def due(self) -> float:
        """When [s] the next content is renewed, gets its ending, or has ended by itself."""
        return min([slot.due for slot in self.by_layer.values()], default=math.inf)

    @property
    def ending_due(self) -> float:
        """When [s] the next content gets its ending, or the next piece of its course."""
        return min([slot.ending_due for slot in self.by_layer.values()], default=math.inf)

    def plan(self, contents: Sequence[Content], now: float) -> Sets:
        """Return the sets that let layers play only these contents from a time [s] on.

        Contents that play already do not change. If the ledgers refuse the sets, the contents are
        played along plain ramps; if they refuse these, too, without the newest content.
        """
        remaining = [*contents]
        skipped = list[Content]()
        reason = ""
        retry_at = math.inf
        while True:
            sets, slots, refusal = self._admissible(remaining, now)
            if refusal is None:
                break
            reason = str(refusal)
            retry_at = self._retry_at(refusal, contents, now)
            newest = max([slots[number] for number in sets.started], key=_requested_at)
            for content in [*remaining]:
                if content.targets == newest.content.targets:  # a voice of the newest content
                    skipped.append(content)
                    remaining.remove(content)
        if sets.layers:
            self._take(slots, sets.started)
        if skipped:
            sets = replace(sets, skipped=skipped, reason=reason, retry_at=retry_at)
        return sets

    def _admissible(
        self, contents: Sequence[Content], now: float
    ) -> tuple[Sets, dict[int, Slot], CommandRefused | None]:
        """Return sets for contents with their slots, shaped or otherwise plain, and any refusal."""
        for is_shaped in (True, False):
            sets, slots = self._sets(contents, now, is_shaped=is_shaped)
            self._note_ends(sets, now)
            if not sets.started:
                return sets, slots, None
            refusal = self.check(sets.by_amplifier)
            if refusal is None:
                break
            form = "shaped" if is_shaped else "plain"
            _logger.info("loop: ledger refused %s contents: %s", form, refusal)
        return sets, slots, refusal

    def _note_ends(self, sets: Sets, now: float) -> None:
        """Note until when contents fade that are ended or replaced by sets."""
        has_endings = len(sets.layers) > len(sets.started)
        driven = [number for number, slot in self.by_layer.items() if slot.drive]
        if has_endings or not sets.started.isdisjoint(driven):
            self._fades_until = now + FADED_AFTER

    def _take(self, slots: dict[int, Slot], started: frozenset[int]) -> None:
        """Take these slots as the playback from now on."""
        self.by_layer = slots
        self.is_silent = False
        layers = dict[ContentKey, int]()
        for number, slot in slots.items():
            if not slot.is_falling:
                layers[slot.content.key] = number
        self._layer_of = layers
        self.may_play |= started

    def may_lead(self, contents: Sequence[Content], now: float) -> bool:
        """Whether the present contents can be cross-faded to these at a time [s].

        Each content must replace a content that plays. If its frequency differs it needs a free
        layer, and the ledgers must admit both contents together.
        """
        playing_keys = {slot.content.key for slot in self.by_layer.values()}
        second_layers = 0
        for content in contents:
            if content.key not in playing_keys:
                return False
            if self._needs_second_layer(content):
                second_layers += 1
        if len(self.may_play) + second_layers > self.layer_count:
            return False
        sets, _ = self._sets(contents, now, is_shaped=True)
        return self.check(sets.by_amplifier) is None

    def silence(self, ramp: float, now: float) -> Sets:
        """Return the sets that silence all layers along a ramp [s]; empty if they are silent."""
        if self.is_silent:
            return Sets()
        self.by_layer = {}
        self.is_silent = True
        self._layer_of = {}
        self._fades_until = now + FADED_AFTER
        return Sets(silence=ramp)

    def endings(self, now: float) -> Sets:
        """Return the sets with the endings, falls and pieces of courses due at a time [s].

        Endings have sets of their own, so that no touch waits for them. If a ledger refuses the
        ending of a content, the content will end along a plain ramp. The next piece of a course is
        sent while sources confirm its contacts.
        """
        layers = dict[int, PlateLayer]()
        endings = dict[int, answer.Layer]()
        first_piece_end = math.inf
        due = [number for number, slot in self.by_layer.items() if slot.ending_due <= now]
        for number in due:
            slot = self.by_layer[number]
            content = slot.content
            if content.course is None and slot.is_falling:
                plate_layer, layer = self._fall(number, slot)
            elif content.course is None:
                plate_layer, layer = self._ending(number, slot, now)
            else:
                first_piece_end = min(first_piece_end, slot.course_until)
                if now >= self._confirmed_until(content):
                    continue
                plate_layer, layer = self._piece(number, content, now, among=len(due), slot=slot)
            layers[number] = plate_layer
            endings[number] = layer
        preempted_until = first_piece_end - HELD / 2
        return self._admitted(Sets(layers, endings=endings, preempted_until=preempted_until))

    def renewal(self, now: float) -> Sets:
        """Return the sets that prolong contents, or their endings, if due at a time [s].

        A content whose renewal a ledger refuses for good ends by itself.
        """
        endings = self.endings(now)
        if endings:
            return endings
        layers = dict[int, PlateLayer]()
        for number, slot in self.by_layer.items():
            is_due = slot.renewal_due <= now < slot.ends_at - _MARGIN / 2
            if is_due and self._confirmed_until(slot.content) > slot.confirmed_until:
                layer = AmplifierLayer(
                    number,
                    ramp=slot.layer.ramp,
                    valid_for=self._valid_for(slot.content, now),
                    renew=True,
                )
                layers[number] = dict.fromkeys(self._rig.amplifiers, layer)
        return self._admitted(Sets(layers))

    def _admitted(self, sets: Sets) -> Sets:
        """Return sets that start nothing, or empty sets if a ledger refuses them."""
        if not sets.layers:
            return sets
        refusal = self.check(sets.by_amplifier)
        if refusal is None:
            return sets
        self.not_renewed(sets, refusal)
        return Sets()

    def not_renewed(self, renewal: Sets, refusal: CommandRefused) -> None:
        """Note that layers are not prolonged; after a final refusal they end."""
        retry_at = math.inf
        if refusal.until is not None:
            retry_at = refusal.until
        for number in renewal.layers:
            slot = self.by_layer[number]
            if number not in renewal.endings:
                slot.renewal_due = retry_at
            elif slot.content.course is None:
                slot.ending_due = math.inf
            else:
                slot.ending_due = retry_at

    def have_settled(self, now: float) -> bool:
        """Whether all layers that may play have settled, so that their endings fit."""
        if not self.may_play:
            return False
        return all(self._may_end_shaped(number, now) for number in self.may_play)

    def confirm(self, sets: Sets, played: PlayedSet, now: float) -> None:
        """Note how the amplifiers play sets that were committed before now [s].

        A content that a ledger has shortened is not renewed, which would circumvent its limit. The
        second piece of a course is sent immediately, each later piece when half of the previous one
        has been played.
        """
        continuing = sets.layers.keys() & self.by_layer.keys()
        self.may_play = self.may_play.difference(sets.layers).union(continuing)
        for number in continuing:
            slot = self.by_layer[number]
            valid_for = _shortest(played, number)
            sent_from = max(now, slot.course_until)  # a piece waits for the previous one
            if slot.content.course is not None:
                piece = sets.endings.get(number, slot.layer)
                is_first = number in sets.started
                self._confirm_piece(slot, piece, played.starts_at, now, is_first=is_first)
            elif number in sets.started:
                slot.drive = tones_by_era(played.layers, self._rig, number)
                slot.settled_at = now + _settled_after(slot.layer)
                slot.ending_due = self._first_ending_due(slot, now + valid_for)
            elif number in sets.endings:
                slot.layer = replace(slot.layer, ending=sets.endings[number].ending)
                slot.ending_due = math.inf
            slot.renewal_due = math.inf
            if valid_for >= _MIN_VALID_FOR:
                slot.renewal_due = now + valid_for / 2
            slot.confirmed_until = self._confirmed_until(slot.content)
            slot.ends_at = sent_from + valid_for

    def _first_ending_due(self, slot: Slot, ends_at: float) -> float:
        """Return when [s] a slot gets its ending once its onset has ended; infinite for never."""
        due = slot.settled_at + _SURELY_SETTLED
        has_ending = self._may_follow and slot.is_shaped and due < ends_at
        if not has_ending:
            return math.inf
        return due

    def _confirm_piece(
        self, slot: Slot, piece: answer.Layer, starts_at: float, now: float, *, is_first: bool
    ) -> None:
        """Note that a piece of a course plays from a time [s] on, and when the next one is due."""
        starts_at = max(starts_at, slot.course_until)
        ends_at = starts_at + _settled_after(piece)
        slot.course_until = ends_at
        slot.drive = full_drive(slot.content.layer.excitation, self._rig)
        pulse = slot.content.pulses[0]
        if ends_at > pulse.end - MIN_LEFT:  # the last piece
            slot.ending_due = math.inf
        elif not piece.onset:  # a ramp, which the next one follows
            slot.ending_due = ends_at
        elif is_first:
            slot.ending_due = now + MIN_LEFT
        else:
            slot.ending_due = (starts_at + ends_at) / 2

    def forget(self) -> None:
        """Discard the playback, which is unknown; fingers keep their layers."""
        self.by_layer = {}
        self.is_silent = False
        self._ended_contents = ()

    def ended(self, now: float) -> tuple[Content, ...]:
        """Return the contents that have ended by themselves by a time [s], each once.

        A course continues if its next piece is due, because the host was late.
        """
        newly_ended = list[Content]()
        for number, slot in [*self.by_layer.items()]:
            has_ended = bool(slot.drive) and now >= slot.ends_at
            if not has_ended or self._has_piece_due(slot, now):
                continue
            if slot.is_falling:
                self.may_play -= {number}
                del self.by_layer[number]
            else:
                slot.drive = {}
                slot.ending_due = math.inf
                newly_ended.append(slot.content)
        self._ended_contents = (*self._ended_contents, *newly_ended)
        return tuple(newly_ended)

    def _has_piece_due(self, slot: Slot, now: float) -> bool:
        """Whether the next piece of a slot's course is due, and its contacts are confirmed."""
        is_due = slot.content.course is not None and slot.ending_due <= now
        return is_due and now < self._confirmed_until(slot.content)

    def over_of(self, contents: Sequence[Content]) -> tuple[Content, ...]:
        """Return the requested contents that have ended by themselves; forget all others."""
        ended_identities = [_identity(content) for content in self._ended_contents]
        requested = [content for content in contents if _identity(content) in ended_identities]
        self._ended_contents = tuple(requested)
        return self._ended_contents

    def numbered(self, contents: Sequence[Content]) -> dict[int, Content]:
        """Return contents by layer: a content's present layer, its finger's, a free or ending one.

        A content that replaces one of another frequency gets a free layer. So does a short pulse if
        possible, since a content that ends in its layer would fade along its short ramp.
        """
        numbers = dict[int, Content]()
        for number, slot in self.by_layer.items():
            if slot.content in contents:  # an equal content, whose sensations may differ
                numbers[number] = contents[contents.index(slot.content)]
        continuing = [*numbers.values()]
        without_layer = list[Content]()
        for content in contents:
            if content in continuing:
                continue
            last_layer = self._layer_of.get(content.key)
            if self._needs_second_layer(content):
                free = self._layers_not_in(self.may_play | numbers.keys())
                if free:
                    last_layer = free[0]
            if last_layer is None:
                without_layer.append(content)
            else:
                numbers[last_layer] = content
        self._number_others(without_layer, numbers)
        return numbers

    def _number_others(self, contents: Sequence[Content], numbers: dict[int, Content]) -> None:
        """Add contents whose fingers have no layer to contents by layer, as long as layers last."""
        free = self._layers_not_in(self.may_play | numbers.keys())
        falling = list[int]()
        ending = list[int]()
        for number in sorted(self.may_play - numbers.keys()):
            slot = self.by_layer.get(number)
            if slot is not None and slot.is_falling:
                falling.append(number)
            else:
                ending.append(number)
        for content in contents:
            is_click = content.key.voice == CLICK
            preference = (free, ending, falling) if is_click else (ending, free, falling)
            for layers in preference:
                if layers:
                    numbers[layers.pop(0)] = content
                    break

    def _needs_second_layer(self, content: Content) -> bool:
        """Whether a content replaces one of another frequency, so that both sound for a while."""
        slot = self._led_from(content)
        return slot is not None and slot.content.frequency != content.frequency

    def _layers_not_in(self, numbers: Set[int]) -> list[int]:
        """Return all layers except these."""
        return [number for number in range(self.layer_count) if number not in numbers]

    def _sets(
        self, contents: Sequence[Content], now: float, *, is_shaped: bool
    ) -> tuple[Sets, dict[int, Slot]]:
        """Return the sets for these contents, and the slots of all layers then."""
        numbers = self.numbered(contents)
        slots = self._continuing_slots(numbers)
        # Side bands can start while their carrier plays: phases count on one clock.
        starting = [number for number in numbers if number not in slots]
        layers = dict[int, PlateLayer]()
        settled_after = 0.0
        for number in starting:
            content = numbers[number]
            plate_layer, slot = self._start(
                number, content, now, among=len(starting), is_shaped=is_shaped
            )
            layers[number] = plate_layer
            slots[number] = slot
            settled_after = max(settled_after, _settled_after(slot.layer))
        ramp = self._end_ramp(contents)
        for number in self.may_play - numbers.keys():
            falling = self._falling(number, contents, now)
            if is_shaped and falling is not None:
                slots[number] = falling
            else:
                layers[number] = self._end(number, now, ramp=ramp, is_shaped=is_shaped)
                settled_after = max(settled_after, ramp)
        sets = Sets(layers, frozenset(starting), settled_after=settled_after)
        return sets, slots

    def _continuing_slots(self, numbers: Mapping[int, Content]) -> dict[int, Slot]:
        """Return the slots whose contents play on, with the present sensations."""
        slots = dict[int, Slot]()
        for number, slot in self.by_layer.items():
            content = numbers.get(number)
            if content is not None and slot.content == content:
                slots[number] = replace(slot, content=content)
        return slots

    def _start(
        self, number: int, content: Content, now: float, *, among: int, is_shaped: bool
    ) -> tuple[PlateLayer, Slot]:
        """Return the set that starts a content in a layer, and its slot.

        among: number of layers that start simultaneously; is_shaped: whether envelopes are allowed.
        """
        if content.course is not None:
            plate_layer, layer = self._piece(number, content, now, among=among)
            return plate_layer, Slot(content, layer)
        has_envelopes = is_shaped and not content.target.is_short
        plate_layer, layer = self._pattern(
            number, content, now, among=among, is_shaped=has_envelopes
        )
        return plate_layer, Slot(content, layer, is_shaped=has_envelopes)

    def _end_ramp(self, contents: Iterable[Content]) -> float:
        """Return the ramp [s] along which layers end while these contents play."""
        has_click = any(content.target.is_short for content in contents)
        ramp = BESIDE_CLICK if has_click else FADE_RAMP
        return min(ramp, self._ramp_max)

    def _end(self, number: int, now: float, *, ramp: float, is_shaped: bool) -> PlateLayer:
        """Return the set that ends a layer: along its ending if it has one, else along a ramp."""
        if is_shaped and self._may_end_shaped(number, now):
            end = AmplifierLayer(number, ramp=ramp)
            return dict.fromkeys(self._rig.amplifiers, end)
        return route({}, self._rig, ramp=ramp, number=number)

    def _pattern(
        self, number: int, content: Content, now: float, *, among: int, is_shaped: bool
    ) -> tuple[PlateLayer, answer.Layer]:
        """Return the set of a pattern in a layer, and the pattern as it is played.

        A tone that continues or cross-fades needs no onset, even if an ERA joins it. among: number
        of layers that change simultaneously, which share the time on the wires; is_shaped: whether
        it can have an onset; its ending follows (`_ending`).
        """
        layer = content.layer
        tones = layer.excitation
        fade = self._fade_of(number, content)
        playing = self._drive_of(number)
        restarted = restarted_by(tones, playing)
        onset = None
        if is_shaped:
            frequencies = [tone.frequency for tone in tones.values()]
            is_continued = fade > 0 or not restarted.issuperset(frequencies)
            shaped = self._support.shape(
                self.timing, content.placement, layer, is_continued, adds_ending=False
            )
            if shaped.onset:
                knots = max(1, self._support.onset_knots // among)
                onset = thinned(shaped.onset, knots=knots)
        layers = route(
            tones,
            self._rig,
            ramp=min(fade or layer.ramp, self._ramp_max),
            number=number,
            playing=playing,
            restarted=restarted,
            valid_for=self._valid_for(content, now),
            onset=onset,
        )
        ramp = next(iter(layers.values())).ramp
        return layers, replace(layer, ramp=ramp, onset=onset, ending=None)

    def _ending(self, number: int, slot: Slot, now: float) -> tuple[PlateLayer, answer.Layer]:
        """Return the set that adds an ending to a pattern that continues, and that pattern."""
        content = slot.content
        layer = replace(content.layer, ramp=slot.layer.ramp)
        layer = self._support.shape(self.timing, content.placement, layer, is_continued=True)
        layers = route(
            layer.excitation,
            self._rig,
            ramp=layer.ramp,
            number=number,
            playing=self._drive_of(number),
            restarted=frozenset(),
            valid_for=self._valid_for(content, now),
            ending=layer.ending,
        )
        return layers, layer

    def _fall(self, number: int, slot: Slot) -> tuple[PlateLayer, answer.Layer]:
        """Return the set that lets a layer fall below any threshold and end, and its layer.

        It does not fall to silence, since no later set could end that sooner, for instance when its
        finger lifts.
        """
        lowest_level = _LEVEL.from_wire(1)
        ramp = min(CROSSFADE, self._ramp_max)
        faint = dict[str, Tone]()
        for name, tone in slot.layer.excitation.items():
            faint[name] = replace(tone, amplitude=lowest_level * self._rig.full_levels[name])
        layers = route(
            faint,
            self._rig,
            ramp=ramp,
            number=number,
            playing=self._drive_of(number),
            restarted=frozenset(),
            valid_for=ramp,
        )
        return layers, slot.layer

    def _piece(
        self,
        number: int,
        content: Content,
        now: float,
        *,
        among: int,
        slot: Slot | None = None,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Return the set of the next piece of a content's course in a layer, and the piece.

        The piece starts at the pulse's position in the course at a time [s], or when the previous
        piece ends if that still plays, and from the present tones. among: number of pieces that are
        sent together; slot: has played the previous piece, None for the first piece.
        """
        if content.course is None:
            raise ValueError("content must have a course")
        course, pulse = content.course
        playing = self._drive_of(number)
        starts_at = now
        follows_piece = False
        if slot is not None:
            follows_piece = now < slot.course_until
            starts_at = max(now, slot.course_until)
            if now >= slot.ends_at:
                playing = {}
        elapsed = 0.0
        if pulse.started_at is not None:
            elapsed = starts_at - pulse.started_at
        knots = self._knots_of_piece(is_first=slot is None, among=among)
        step, shares = piece_of(course, pulse, elapsed, knots=knots, is_first=slot is None)
        onset = _course_onset(content.layer, shares, step)
        last_tones = dict[str, Tone]()
        for name, tone in content.layer.excitation.items():
            last_tones[name] = replace(tone, amplitude=shares[-1] * tone.amplitude)
        ramp = FADE_RAMP if onset else step
        layers = route(
            last_tones,
            self._rig,
            ramp=min(ramp, self._ramp_max),
            number=number,
            playing=playing,
            restarted=frozenset(),
            valid_for=step * len(shares) + HELD,
            onset=onset,
        )
        ramp = next(iter(layers.values())).ramp
        if follows_piece and onset is not None:
            layers = {name: replace(layer, after=True) for name, layer in layers.items()}
        return layers, replace(content.layer, ramp=ramp, onset=onset, ending=None)

    def _knots_of_piece(self, *, is_first: bool, among: int) -> int:
        """Return the number of knots of a piece that is sent among others; 0 for a ramp."""
        knots = self._course_knots
        if is_first:
            knots = min(knots, self._support.onset_knots)
        if not knots:
            return 0
        return max(knots // among, 1)

    def _fade_of(self, number: int, content: Content) -> float:
        """Return the time [s] in which a content replaces another; 0 if it starts from silence."""
        slot = self.by_layer.get(number)
        if slot is not None and _voice_of(slot.content) != _voice_of(content):
            return 0.0
        if slot is not None and slot.content.gain_db != content.gain_db:
            return STRENGTH_FADE
        if self._led_from(content) is not None:
            return CROSSFADE
        return 0.0

    def _led_from(self, content: Content) -> Slot | None:
        """Return the slot that a content replaces in a cross-fade, if any."""
        number = self._layer_of.get(content.key)
        if number is None or not content.is_led:
            return None
        slot = self.by_layer.get(number)
        if slot is None or slot.content == content or slot.content.target.is_short:
            return None
        return slot

    def _falling(self, number: int, contents: Sequence[Content], now: float) -> Slot | None:
        """Return a layer's slot while another content replaces it; None if it just ends."""
        slot = self.by_layer.get(number)
        if slot is None:
            return None
        for content in contents:
            if slot.is_falling and content.is_led and content.key == slot.content.key:
                return slot
            if self._led_from(content) is slot:
                fall_due = now + FALL_AFTER
                return replace(slot, is_falling=True, ending_due=fall_due, renewal_due=math.inf)
        return None

    def _retry_at(self, refusal: CommandRefused, contents: Sequence[Content], now: float) -> float:
        """Return when [s] to plan refused contents again.

        If the refusal has no end: when active pulses and ended contents have faded, or without any
        after RETRY.
        """
        if refusal.until is not None:
            return refusal.until
        ends = list[float]()
        for content in contents:
            for pulse in content.pulses:
                if pulse.started_at is not None and pulse.end > now:
                    ends.append(pulse.end)
        if now < self._fades_until:
            ends.append(now)
        return max(ends, default=now + RETRY) + FADED_AFTER

    def _confirmed_until(self, content: Content) -> float:
        """Return when [s] the first target of a content is lifted unless a frame arrives."""
        return min([self._expiry_of(finger.contact.key) for finger in content.targets])

    def _valid_for(self, content: Content, now: float) -> float:
        """Return how long [s] a content can last from a time [s] on without a renewal.

        The amplifiers end the content with its last pulse.
        """
        unconfirmed_in = self._confirmed_until(content) - now + _MARGIN
        without_pulse = min(max(unconfirmed_in, _MIN_VALID_FOR), MAX_CONTACT_TIMEOUT)
        pulse_times = [_remaining(finger.target.pulse, now) for finger in content.targets]
        return min(without_pulse, max(pulse_times))

    def _may_end_shaped(self, number: int, now: float) -> bool:
        """Whether a layer has settled, so that its endings start from its present tones."""
        slot = self.by_layer.get(number)
        if slot is None or not slot.layer.ending:
            return False
        return now >= slot.settled_at

    def _drive_of(self, number: int) -> Drive:
        """Return the tones in a layer, at frequencies not rounded by wire and amplifier."""
        slot = self.by_layer.get(number)
        if slot is None:
            return {}
        drive = dict[str, AmplifierTone]()
        tones = slot.layer.excitation
        for name, driven in slot.drive.items():
            if name in tones:
                drive[name] = replace(driven, frequency=tones[name].frequency)
        return drive


def _identity(content: Content) -> _Identity:
    return _Identity(content.key, content.targets, content.placement)


def _voice_of(content: Content) -> _Voice:
    return _Voice(content.key, content.frequency, content.target.pulse)


def _course_onset(
    layer: answer.Layer, shares: Sequence[float], step: float
) -> dict[str, BaseEnvelope] | None:
    """Return the onset of a piece by ERA, whose shares are a step [s] apart; None for a ramp."""
    if len(shares) < 2:
        return None
    onset = dict[str, BaseEnvelope]()
    for name, tone in layer.excitation.items():
        motions = tuple([share * tone.phasor for share in shares])
        onset[name] = BaseEnvelope(tone.frequency, 0.0, motions, step)
    return onset or None


def _requested_at(slot: Slot) -> float:
    """Return when [s] the pulse of a content was requested, or its contact came."""
    content = slot.content
    if content.target.pulse is None:
        return content.contact.since
    return content.target.pulse.requested_at


def _remaining(pulse: Pulse | None, now: float) -> float:
    """Return how long [s] a target is driven after a time [s]; infinite without a pulse."""
    if pulse is None:
        return math.inf
    if pulse.started_at is None:
        return pulse.duration
    return max(pulse.end - now, MIN_LEFT)


def _settled_after(layer: answer.Layer) -> float:
    """Return how long [s] after the commit the ramp or onset of a layer has ended."""
    if not layer.onset:
        return layer.ramp
    envelope = next(iter(layer.onset.values()))
    return max(layer.ramp, envelope.duration)


def _shortest(played: PlayedSet, number: int) -> float:
    """Return the time [s] after the commit when the first amplifier ends a layer by itself.

    Infinite if none does.
    """
    shortest = math.inf
    for layers in played.layers.values():
        for layer in layers:
            if layer.layer == number and layer.valid_for and is_vibrating(layer):
                shortest = min(shortest, _VALID_FOR.from_wire(layer.valid_for))
    return shortest
