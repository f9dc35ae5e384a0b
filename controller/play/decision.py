"""Decisions of the control loop, without waiting: touch frames in, sets of all amplifiers out.

update(frame) ->  contacts
decide(now)  ->  contacts -> intent -> contents -> the layers that change, on every amplifier
"""

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from controller.play.capabilities import PlaybackCapabilities
from controller.play.chooser import Chooser
from controller.play.content import Selection, no_layer_free
from controller.play.intent import FADED_AFTER, IntentSource, Pulse
from controller.play.playing import PlayedContent, Playing, all_left
from controller.play.routing import FADE_RAMP, PlateSet, SetBuilder
from controller.play.selection import Selector
from controller.sources.contacts import Change, Contact, ContactKey, ContactTracker
from drivers.errors import CommandRefused
from drivers.host.joint_sets import Played
from model.answer.fingers import MIN_LEVEL_DB_SL, Placement
from model.answer.plan import prepare_answers, query
from model.answer.timing import Timing
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry.plugins import failure_text

# With no finger left on the plate the end may be short: zero within 20 ms of the lift.
RELEASE_RAMP = 0.010

ENDED = (
    "the vibration has ended by itself: it was not renewed, or a limit of time was reached; touch "
    "there again"
)

# s; after a vibration a plate first rings louder than the next onset is at a quiet finger.
_RING_DOWN = 0.4

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Decision:
    """A selection and what the amplifiers are to play for it.

    selection: what is felt, or why not; requested: what was selected before limits of time and
    ledgers left contents out, None to decide it again.
    from_rest: whether nothing has played for 0.4 s, so that the plate is at rest;
    triggered_at [s]: when the change arrived; is_touch: whether a finger came, moved or pressed
    since, instead of lifts alone or none.
    sets: of the layers that change, by number, all from one moment on; started: those that play a
    content; silence: ramp [s] along which all layers fall silent instead. Neither if nothing is to
    be sent. refusal: why a ledger refused a content, which is left out.
    """

    contacts: tuple[Contact, ...]
    selection: Selection
    from_rest: bool
    triggered_at: float
    requested: Selection | None
    sets: Mapping[int, PlateSet] = field(default_factory=dict)
    is_touch: bool = False
    started: frozenset[int] = frozenset()
    silence: float | None = None
    refusal: str | None = None


class Decider:
    """Intent, selection and sets for the contacts on one plate; synchronous, times are arguments.

    A decision never raises: it falls back to silence on any exception. arrived: called when several
    contents have been chosen, which a decision does not wait for. too_late: called with how many
    clicks came too late to be felt.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        *,
        tracker: ContactTracker,
        capabilities: PlaybackCapabilities,
        intent_source: IntentSource,
        timing: Timing,
        arrived: Callable[[], None] = lambda: None,
        too_late: Callable[[int], None] = lambda clicks: None,
    ) -> None:
        self.capabilities = capabilities
        """Of the amplifiers together."""
        self._tracker = tracker
        self._intent_source = intent_source
        self._intent_due = math.inf  # s; when the intent may change without a touch
        self._builder = SetBuilder(
            rig, capabilities.envelope_support, capabilities.ramp_max, timing
        )
        self._selector = Selector(Chooser(table, self._builder.shape), arrived=self._note_answer)
        self._decided: Decision | None = None  # as it was sent
        self.playing = Playing(rig, capabilities.layers, tracker.expiry_of)
        """The layers."""
        self._retry_at = math.inf  # s; when a ledger would admit what it refused
        self._is_new = True  # something has come that is not decided yet
        self._arrived, self._too_late = arrived, too_late
        self._triggered_at = math.inf  # s; when the first change since the last decision arrived
        self._seen: frozenset[ContactKey] = frozenset()  # fingers, when it was last decided
        self._awaited: dict[int, Pulse] = {}  # by identity: decided, and not known to have started
        self._touched_at = -math.inf  # s; when a finger came, moved or pressed last
        self._played_until = -math.inf  # s; as far as known
        self._fades_until = -math.inf  # s; what was ended or replaced

    def replace_answers(self, table: LocalizationTable, timing: Timing) -> None:
        """Answer by another table of this plate from now on; what plays stays until it changes."""
        self._builder = replace(self._builder, timing=timing)
        self._selector.chooser = Chooser(table, self._builder.shape)

    def prepare(self) -> None:
        """Precompute what the first touch would have to wait for; seconds, of a large rig.

        Raises InputError for a table that has no pattern for these amplifiers.
        """
        table, timing = self._selector.chooser.table, self._builder.timing
        mode = self.capabilities.drive_mode
        prepare_answers(table, mode)
        timing.prepare(table.frequencies.tolist())
        plate, support = table.plate, self.capabilities.envelope_support
        placed = Placement(((plate.length / 2, plate.width / 2),), ((0.0, 0.0),))
        band = self.capabilities.frequencies
        (layer,) = query(table, placed, MIN_LEVEL_DB_SL, drive_mode=mode, band_hz=band).layers
        onset, ending = support.onset_knots > 0, support.ending_knots > 0
        layer = timing.with_envelopes(layer, placed, onset=onset, ending=ending)
        timing.transient_contrast_db(layer, placed)

    @property
    def due(self) -> float:
        """When [s] to decide next even if nothing arrives.

        An intent expires then, a ledger would admit what it refused, or a finger that moved rests.
        """
        return min(self._intent_due, self._retry_at, self._selector.due)

    @property
    def is_choosing(self) -> bool:
        """Whether contents are being chosen, which are decided when they arrive."""
        return self._selector.is_choosing

    @property
    def is_silence_pending(self) -> bool:
        """Whether the last contact has lifted and silence has not been commanded yet."""
        return not self._tracker.contacts and not self.playing.is_silent

    def note(self, time: float, change: Change) -> None:
        """Note that contacts have changed, by what arrived at a time [s]."""
        self._is_new = True
        if unseen := [each for each in change.up if each.key not in self._seen]:
            self._too_late(len(unseen))
        if change.down or change.moved or change.pressed:
            self._touched_at = time
        self._triggered_at = min(self._triggered_at, time)

    def look_again(self) -> None:
        """Note that the next decision may differ though no contact has changed."""
        self._is_new = True

    def forget(self) -> None:
        """Discard the known playback: the next decision has a set; fingers keep their layers."""
        self._decided, self._retry_at, self._is_new = None, math.inf, True
        self.playing.forget()

    def only_ends(self, decision: Decision) -> Decision:
        """Return the last decision without what it starts, which is decided again later."""
        self.forget()
        sets = {n: each for n, each in decision.sets.items() if n not in decision.started}
        return replace(decision, requested=None, sets=sets, started=frozenset())

    def confirm(self, decision: Decision, played: Played, *, now: float) -> None:
        """Note what the amplifiers play for the last decision.

        Pulses start when the last commit was sent.
        """
        self._decided, playing = decision, self.playing
        playing.may_play = playing.may_play.difference(decision.sets).union(decision.started)
        for number in decision.started:
            for _, target in playing.contents[number].content.targets:
                if target.pulse is not None and target.pulse.started_at is None:
                    if played.sent_at > target.pulse.end:
                        self._too_late(1)
                    target.pulse.started_at = played.sent_at
                    self._intent_due = min(self._intent_due, target.pulse.end)
            playing.confirm_start(number, played, now)

    def _without_shapes(self, decision: Decision) -> Decision:
        """Return the last decision along its plain ramps."""
        sets = {
            number: self._builder.plain(each) if each.is_shaped else each
            for number, each in decision.sets.items()
        }
        for number in decision.started:
            pattern = replace(self.playing.contents[number].pattern, onset=None, ending=None)
            self.playing.change(number, set=sets[number], pattern=pattern)
        return replace(decision, sets=sets)

    def refused(self, decision: Decision, error: CommandRefused, *, now: float) -> Decision:
        """Return the last decision along its plain ramps, since a ledger has refused it by now [s].

        Without its newest content where it has no other shapes, and silence where none is left;
        what is left out is decided again when a pulse or a layer beside it has ended, or what it
        replaces has faded.
        """
        if error.until is None or error.until > now:  # not of a wire that is too slow or too busy
            self._awaited.clear()
        if any(each.is_shaped for each in decision.sets.values()):
            _logger.info("loop: plain ramps instead of envelopes: %s", error)
            return self._without_shapes(decision)
        self._retry_at = self._faded_by(decision, now) if error.until is None else error.until
        newest = max(decision.started, key=self._requested_at, default=None)
        if newest is not None:
            ends = self.playing.beside(newest)
            if len(ends) < len(self.playing.contents):
                return self._without(ends, decision, str(error))
        self.playing.end(is_silent=True)
        return replace(
            decision, sets={}, started=frozenset(), silence=FADE_RAMP, refusal=str(error)
        )

    def _faded_by(self, decision: Decision, now: float) -> float:
        """Return when [s] what ends beside what a decision starts has faded; infinite for none."""
        pulses = [target.pulse for one in decision.selection.contents for _, target in one.targets]
        started = [each for each in pulses if each is not None and each.started_at is not None]
        ends = [each.end for each in started if each.end > now]
        if now < self._fades_until:
            ends.append(now)
        return max(ends, default=math.inf) + FADED_AFTER

    def _requested_at(self, number: int) -> float:
        """Return when [s] what plays in a layer was requested, by its pulse or its contact."""
        contact, target = self.playing.contents[number].content.targets[0]
        return contact.since if target.pulse is None else target.pulse.requested_at

    def _without(self, numbers: frozenset[int], decision: Decision, reason: str) -> Decision:
        """Return the last decision with layers that end instead of what it starts there."""
        contents = [self.playing.contents[number].content for number in numbers]
        self.playing.leave_out(numbers)
        ends = {number: self._builder.build_end(number, has_endings=False) for number in numbers}
        return replace(
            decision,
            selection=decision.selection.without(contents, reason),
            sets={**decision.sets, **ends},
            started=decision.started - numbers,
            refusal=reason,
        )

    def renewal(self, now: float) -> dict[int, PlateSet]:
        """Return the sets that prolong what plays, by layer, where that is due at a time [s]."""
        return {
            number: self._builder.build_renewal(
                one.set, valid_for=self.playing.lasts(one.content, now)
            )
            for number, one in self.playing.to_renew(now).items()
        }

    def ended(self, now: float) -> Decision | None:
        """Return the ends of contents that have come by themselves at a time [s], once; else None.

        With the selection of those that play on; silence if there are none.
        """
        contents = self.playing.ended(now)
        if not contents or self._decided is None:
            return None
        self._decided = replace(
            self._decided,
            selection=self._decided.selection.without(contents, ENDED),
            sets={},
            started=frozenset(),
            refusal=ENDED,
            triggered_at=now,
        )
        return self._decided

    def decide(self, now: float) -> Decision | None:
        """Decide at a time [s], for the contacts as of `expire`; None if nothing changes."""
        for each in self.playing.contents.values():
            if each.drive:
                self._played_until = now
        for number, pulse in [*self._awaited.items()]:
            if pulse.started_at is not None or now >= pulse.end:
                del self._awaited[number]
                if pulse.started_at is None:
                    self._too_late(1)
        if not self._is_new and now < self.due:
            return None
        contacts, triggered_at = self._tracker.contacts, min(self._triggered_at, now)
        self._triggered_at = math.inf
        self._is_new, is_retry = False, now >= self._retry_at
        self._seen = frozenset([each.key for each in contacts])
        from_rest = now - self._played_until >= _RING_DOWN
        before, decision, has_failed = self._decided, None, False
        try:
            self._intent_due = math.inf
            intent = self._intent_source.intent(contacts, now)
            self._intent_due = intent.due(now)
            requested = self._selector.select(
                contacts, intent, self.capabilities, triggered_at=triggered_at
            )
            if before is not None and requested == before.requested and not is_retry:
                return None
            triggered_at = min(triggered_at, self._selector.triggered_at)
            draft = Decision(
                contacts,
                self._playable(requested),
                from_rest,
                triggered_at,
                requested,
                is_touch=self._touched_at >= triggered_at,
            )
            if draft.selection.contents:
                decision = self._with_sets(draft, now)
                if decision is None and _why_not(draft) != _why_not(before):
                    decision = draft  # said without sending
        except Exception as error:
            has_failed = self._is_new = True  # and tried again
            self._selector.due = self._retry_at = math.inf
            requested = Selection((), contacts, (), failure_text(error))
            if before is not None and requested == before.requested:
                return None
            draft = Decision(contacts, requested, from_rest, triggered_at, requested)
            _logger.exception("loop: decision failed, silencing all channels")
        self._retry_at = math.inf
        if not draft.selection.contents:
            is_awaited = requested.is_pending and not self.playing.may_play
            decision = None if is_awaited else self._ended(draft, now, has_failed=has_failed)
        self._decided = decision or draft
        return decision

    def _note_answer(self) -> None:
        self._is_new = True
        self._arrived()

    def _playable(self, selection: Selection) -> Selection:
        """Return a selection without what has ended by itself, and what has no layer."""
        if over := self.playing.over_of(selection.contents):
            selection = selection.without(over, ENDED)
        if len(selection.contents) > self.capabilities.layers:
            selection = self._within_layers(selection)
        return selection

    def _within_layers(self, selection: Selection) -> Selection:
        """Return a selection without the fingers of which a voice has no layer, which says so."""
        served = [*self.playing.numbered(selection.contents).values()]
        keys = {each.key[0] for each in selection.contents if each not in served}
        left = [each for each in selection.contents if each.key[0] in keys]
        return selection.without(left, no_layer_free(self.capabilities.layers))

    def _with_sets(self, draft: Decision, now: float) -> Decision | None:
        """Return a draft with the sets of all layers that change; None if none does."""
        playing, before = self.playing, self.playing.contents
        numbers = playing.numbered(draft.selection.contents)
        starting, restarting = playing.starting(numbers)
        contents = {n: one for n, one in before.items() if n in numbers and n not in starting}
        sets: dict[int, PlateSet] = {}
        for number in starting:
            content = numbers[number]
            sets[number], pattern = self._builder.build_pattern(
                number,
                content.pattern,
                content.question,
                playing=playing.drive_of(number),
                valid_for=playing.lasts(content, now),
                restarts=number in restarting,
                is_shaped=not content.targets[0][1].is_short,
                lasts=min(all_left(content.targets, now), default=math.inf),
                among=len(starting),
            )
            contents[number] = PlayedContent(content, sets[number], pattern)
        started = frozenset(sets)
        for number in playing.may_play - numbers.keys():
            has_endings = playing.may_end_shaped(number, now)
            sets[number] = self._builder.build_end(number, has_endings=has_endings)
        if not sets:
            return None
        if sets.keys() - started or any(before[n].drive for n in started & before.keys()):
            self._fades_until = now + FADED_AFTER
        playing.start(contents, started)
        pulses = [one.pulse for number in started for _, one in numbers[number].targets]
        self._awaited |= {id(each): each for each in pulses if each is not None}
        return replace(draft, sets=sets, started=started)

    def _ended(self, draft: Decision, now: float, *, has_failed: bool) -> Decision:
        """Return a draft that ends all playback: along endings only under fingers that stay."""
        playing = self.playing
        if playing.is_silent:
            return draft
        numbers = sorted(playing.may_play)
        is_shaped = bool(numbers) and not has_failed and bool(draft.contacts)
        self._fades_until = now + FADED_AFTER
        if is_shaped and all(playing.may_end_shaped(number, now) for number in numbers):
            playing.end(is_silent=False)
            ends = {n: self._builder.build_end(n, has_endings=True) for n in numbers}
            return replace(draft, sets=ends)
        playing.end(is_silent=True)
        if not draft.contacts:
            return replace(draft, silence=RELEASE_RAMP)
        return replace(draft, silence=FADE_RAMP)


def _why_not(decision: Decision | None) -> dict[ContactKey, str | None]:
    """Return why targets feel nothing of their own, by contact."""
    held_back = () if decision is None else decision.selection.not_served
    return {each.contact.key: each.held_back for each in held_back}
