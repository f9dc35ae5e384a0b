"""Decisions of the control loop, without waiting: touch frames in, safe command sets out.

take(frame)  ->  contacts
decide(now)  ->  contacts -> intent -> selection -> routing -> guard -> safe sets
"""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.envelopes import MAX_LOADING_TIME, RAMPS_ONLY
from controller.loop.intent import IntentSource
from controller.loop.loading_times import LoadingTimes
from controller.loop.safe_sets import FADE_RAMP, SafeSets, SetBuilder
from controller.loop.selection import Selection, Selector
from controller.loop.table_query import is_short
from controller.loop.validity import Validity, first_end, last_end, valid_for
from controller.sources.contacts import Change, Contact, ContactTracker
from controller.sources.touch import TouchFrame
from drivers.command import DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.table import LocalizationTable
from model.table.timing import Timing
from registry.plugins import failure_text

# With no finger left on the plate the end may be short: zero within 20 ms of the lift.
RELEASE_RAMP = 0.010

# s; after a vibration a plate first rings louder than the next onset is at a quiet finger.
_RING_DOWN = 0.4
_ENDINGS_MARGIN = 0.1  # s; endings are loaded and committed in less

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Decision:
    """A selection and what the amplifiers are to play for it.

    from_rest: whether nothing has played for 0.4 s, so that the plate is at rest;
    triggered_at [s]: when the change arrived.
    sets: None if all channels are silent already; pattern: with the ramp and onset of the sets,
    None for silence; adds_endings_only: whether the sets only add endings to the playback; refusal:
    why a guard refused the pattern, which makes it silence; retry_at [s]: when the guard would pass
    it, None for never. ends_due [s]: when the vibration that it ends was to end, if the amplifiers
    do not end it themselves. held_until [s]: when to decide instead, once amplifiers that cannot
    cross-fade have faded out.
    """

    contacts: tuple[Contact, ...]
    selection: Selection
    from_rest: bool
    triggered_at: float
    sets: SafeSets | None = None
    pattern: Pattern | None = None
    adds_endings_only: bool = False
    refusal: str | None = None
    retry_at: float | None = None
    ends_due: float | None = None
    held_until: float | None = None


@dataclass(frozen=True)
class _Playback:
    """Playback of the amplifiers since the last decision with sets.

    confirmed_commands: by ERA; has_endings: whether endings were added; endings_due [s]: when
    endings can be added; retry_at [s]: when a guard would pass what it refused. confirmed_until
    [s]: when the first target would have been lifted, as known when the sets were sent;
    renewal_due, renewable_until [s]: between these they are renewed if all targets have been
    confirmed since.
    """

    decision: Decision | None = None
    confirmed_commands: Mapping[str, DriveCommand] = field(default_factory=dict)
    has_endings: bool = False
    endings_due: float | None = None
    retry_at: float | None = None
    validity: Validity = field(default_factory=Validity)

    @property
    def is_silent(self) -> bool:
        """Whether it is certain that nothing plays."""
        sets = None if self.decision is None else self.decision.sets
        return sets is not None and sets.is_silence


class Decider:
    """Contacts, intent, selection and safe sets of one plate; synchronous, times are arguments.

    guards: one for each amplifier, by name; max_loading_time [s]: longest loading of envelopes. A
    decision never raises: it falls back to silence on any exception.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        *,
        guards: Mapping[str, Guard],
        capabilities: PlaybackCapabilities,
        intent_source: IntentSource,
        timing: Timing | None = None,
        max_loading_time: float = MAX_LOADING_TIME,
    ) -> None:
        self._table = table
        self._timing = timing
        self._capabilities = capabilities
        self._loading_times = LoadingTimes(max_loading_time)
        self._tracker = ContactTracker(rig.plate)
        self._intent_source = intent_source
        self._intent_due: float | None = None  # when the intent may change without a touch
        self._held_until: float | None = None  # when there is room for a pattern
        self._selector = Selector(table, None if timing is None else timing.levels, rig.voltage)
        self._builder = SetBuilder(rig, guards, timing=timing)
        self._selected: Selection | None = None
        self._playing = self._playing_before = _Playback()
        self._triggered_at: float | None = None
        self._played_until = -math.inf  # s; as far as known

    @property
    def capabilities(self) -> PlaybackCapabilities:
        """Capabilities of the amplifiers together."""
        return self._capabilities

    def replace_answers(self, table: LocalizationTable, timing: Timing | None) -> None:
        """Answer by another table of this plate from now on; what plays stays until it changes."""
        self._table, self._timing = table, timing
        self._selector.replace(table, None if timing is None else timing.levels)
        self._builder.replace(timing)

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All contacts in order of arrival."""
        return self._tracker.contacts

    def prepare(self) -> None:
        """Precompute what the first touch would have to wait for; tens of milliseconds.

        Raises InputError for a table that has no pattern for these amplifiers.
        """
        self._table.prepare(self._capabilities.drive_mode)
        if self._timing is None:
            return
        self._timing.prepare(self._table.frequencies.tolist())
        plate, support = self._table.plate, self._capabilities.envelope_support
        question = Question(
            ((plate.length / 2, plate.width / 2),),
            ((0.0, 0.0),),
            level_db_sl=-100.0,
            drive_mode=self._capabilities.drive_mode,
            playable=self._capabilities.playable,
            eras_at_most=self._capabilities.eras_at_most,
            frequencies=self._capabilities.frequencies,
            envelopes=support.onsets,
        )
        pattern = self._timing.with_envelopes(
            question, self._table.query(question), onset=support.onsets, ending=support.endings
        )
        self._timing.with_transient_measures(question, pattern)

    @property
    def due(self) -> float | None:
        """When [s] to decide next even if nothing arrives.

        A source times out then, an intent expires, endings can be added, a guard would pass what it
        refused, or the amplifiers have room for what is held back.
        """
        moments = (
            *(self._tracker.next_expiry, self._intent_due, self._held_until),
            *(self._playing.endings_due, self._playing.retry_at),
        )
        return min((moment for moment in moments if moment is not None), default=None)

    @property
    def next_expiry(self) -> float | None:
        """When [s] the next source times out unless a frame of it arrives."""
        return self._tracker.next_expiry

    @property
    def is_silence_pending(self) -> bool:
        """Whether the last contact has lifted and silence has not been commanded yet."""
        return not self._tracker.contacts and not self._playing.is_silent

    def update(self, frame: TouchFrame, *, keeps_taps: bool = False) -> Change:
        """Apply a touch frame to the contacts; keeps_taps: as of `ContactTracker.update`."""
        change = self._tracker.update(frame, keeps_taps=keeps_taps)
        self._note(change, frame.time)
        return change

    def expire(self, now: float) -> Change:
        """Lift the contacts of sources that have timed out at now [s]."""
        change = self._tracker.expire(now)
        self._note(change, now)
        return change

    def forget(self) -> None:
        """Discard the known playback: the next decision has sets."""
        self._selected = None
        self._playing = _Playback()

    def confirm(
        self, commands: Mapping[str, DriveCommand], *, now: float, sent_at: float | None = None
    ) -> None:
        """Note what the amplifiers play for the last decision, by ERA, without silent ones.

        sent_at [s]: when the last byte of the commit was sent; pulses start with it.
        """
        decision = self._playing.decision
        if decision is None or decision.sets is None or decision.pattern is None:
            self._playing = replace(self._playing, confirmed_commands=commands)
            return
        for _, target in decision.selection.targets:
            if target.pulse is not None and target.pulse.started_at is None:
                target.pulse.started_at = now if sent_at is None else sent_at
        validity = self._validity(decision.sets, decision.selection, now)
        self._playing = replace(self._playing, confirmed_commands=commands, validity=validity)
        if decision.adds_endings_only:
            self._playing = replace(self._playing, has_endings=True)
        elif self._capabilities_at(now).envelope_support.endings and self._timing is not None:
            endings_due = now + decision.sets.settled_after
            # A commit after the end of a pulse would start it again.
            if endings_due + _ENDINGS_MARGIN < first_end(decision.selection):
                self._playing = replace(self._playing, endings_due=endings_due)

    def renewal(self, now: float) -> SafeSets | None:
        """Return the sets that prolong the playback, if due at a time [s]; else None."""
        decision = self._playing.decision
        if decision is None or decision.sets is None:
            return None
        confirmed_until = self._confirmed_until(decision.selection)
        if not self._playing.validity.is_renewal_due(now, confirmed_until=confirmed_until):
            return None
        valid_for = self._valid_for(decision.selection, now)
        sets = self._builder.build_renewal(decision.sets, valid_for=valid_for)
        return sets if sets is not None and sets.room_from <= now else None

    def confirm_renewal(self, sets: SafeSets, *, now: float) -> None:
        """Note that the amplifiers have accepted the sets of a renewal."""
        if self._playing.decision is not None:
            validity = self._validity(sets, self._playing.decision.selection, now)
            self._playing = replace(self._playing, validity=validity)

    def without_onset(self, decision: Decision) -> Decision | None:
        """Return the last decision along its plain ramp, since its onset was not loaded in time.

        None for one that only adds endings: the playback stays as it is.
        """
        plain = None if decision.sets is None else decision.sets.plain
        if plain is None or decision.pattern is None:
            self._playing = replace(self._playing_before, endings_due=None)
            return None
        pattern = replace(decision.pattern, onset=None)
        decision = replace(decision, sets=plain, pattern=pattern)
        self._playing = replace(self._playing, decision=decision)
        return decision

    def note_loading_time(self, duration: float, *, now: float, is_late: bool = False) -> None:
        """Note how long [s] loading envelopes took; too long means plain ramps for a while.

        is_late: whether it was given up.
        """
        self._loading_times.note(duration, now=now, is_late=is_late)

    def ramp_only_reason(self, now: float) -> str | None:
        """Return why touches start along plain ramps though the amplifiers play envelopes."""
        if not self._capabilities.envelope_support:
            return None
        return self._loading_times.ramp_only_reason(now)

    def decide(self, now: float) -> Decision | None:
        """Decide at a time [s]; None if nothing changes.

        A pattern that the amplifiers have no room for yet is decided again once they have, unless
        something else is then.
        """
        self.expire(now)
        contacts, playing = self._tracker.contacts, self._playing
        triggered_at = now if self._triggered_at is None else min(self._triggered_at, now)
        self._triggered_at = None
        if playing.confirmed_commands:
            self._played_until = now
        from_rest = now - self._played_until >= _RING_DOWN
        decision, has_failed = None, False
        try:
            selection = self._select(contacts, now)
            is_new = selection != self._selected or _is_due(playing.retry_at, now)
            draft = Decision(contacts, selection, from_rest, triggered_at)
            decision = self._with_pattern(draft, now) if is_new else self._with_endings(draft, now)
        except Exception as error:
            has_failed = True
            selection = Selection((), contacts, None, failure_text(error))
            is_new = selection != self._selected
            draft = Decision(contacts, selection, from_rest, triggered_at)
            if is_new:
                _logger.exception("loop: decision failed, silencing all channels")
        self._held_until = None
        until = _room_from(decision)
        if until > now:
            self._hold(until, now, triggered_at)
            return None
        if decision is None and is_new:
            decision = draft
            if not playing.is_silent:
                sets = self._end(contacts, along_endings=playing.has_endings and not has_failed)
                decision = replace(draft, sets=sets, ends_due=self._missed_end(now))
        if decision is not None and decision.sets is not None:
            self._playing_before = playing
            self._playing = _Playback(decision, retry_at=decision.retry_at)
        else:
            self._playing = replace(
                playing,
                retry_at=None if is_new else playing.retry_at,
                endings_due=None if _is_due(playing.endings_due, now) else playing.endings_due,
            )
        self._selected = selection
        return decision

    def _hold(self, until: float, now: float, triggered_at: float) -> None:
        """Decide again at a time [s], as if nothing had been decided at `now` [s]."""
        self._held_until, self._triggered_at = until, triggered_at
        playing = self._playing
        self._playing = replace(
            playing,
            retry_at=until if _is_due(playing.retry_at, now) else playing.retry_at,
            endings_due=until if _is_due(playing.endings_due, now) else playing.endings_due,
        )

    def silence(self, *, ramp: float, before: SafeSets | None = None) -> SafeSets:
        """Build the sets that ramp [s] every wired channel to zero; see `SetBuilder`."""
        return self._builder.build_silence(ramp=ramp, before=before)

    def _capabilities_at(self, now: float) -> PlaybackCapabilities:
        """Return the capabilities at a time [s]: without envelopes while loading is too slow."""
        if self._loading_times.ramp_only_reason(now) is None:
            return self._capabilities
        return replace(self._capabilities, envelope_support=RAMPS_ONLY)

    def _select(self, contacts: tuple[Contact, ...], now: float) -> Selection:
        """Query the intent, and the table for it."""
        self._intent_due = None
        intent = self._intent_source.intent(contacts, now)
        self._intent_due = intent.due(now)
        return self._selector.select(contacts, intent, self._capabilities_at(now))

    def _with_pattern(self, draft: Decision, now: float) -> Decision | None:
        """Return a draft with the sets of its pattern; None without a pattern."""
        pattern, question = draft.selection.pattern, draft.selection.question
        if pattern is None or question is None:
            return None
        support = self._capabilities_at(now).envelope_support
        is_shaped = support.onsets and not is_short(draft.selection.targets)
        try:
            sets, played = self._builder.build_pattern(
                pattern,
                question,
                is_shaped=is_shaped,
                playing=self._playing.confirmed_commands,
                valid_for=self._valid_for(draft.selection, now),
            )
        except CommandRefused as error:
            silence = self.silence(ramp=FADE_RAMP)
            if not self._capabilities.has_cross_fades:  # out, then in
                if not self._playing.is_silent:
                    return replace(draft, sets=silence, retry_at=now)
                if error.until is not None:
                    return replace(draft, held_until=error.until)
            return replace(draft, sets=silence, refusal=str(error), retry_at=error.until)
        return replace(draft, sets=sets, pattern=played)

    def _with_endings(self, draft: Decision, now: float) -> Decision | None:
        """Return a draft that adds endings to the playback; None if not due, or refused."""
        pattern, question = draft.selection.pattern, draft.selection.question
        playing = self._playing
        if pattern is None or question is None or not playing.confirmed_commands:
            return None
        if not _is_due(playing.endings_due, now):
            return None
        sets = self._builder.build_endings(
            pattern,
            question,
            playing=playing.confirmed_commands,
            valid_for=self._valid_for(draft.selection, now),
        )
        if sets is None:
            return None
        return replace(draft, sets=sets, pattern=pattern, adds_endings_only=True)

    def _end(self, contacts: tuple[Contact, ...], *, along_endings: bool) -> SafeSets:
        """Build the sets that end the playback: along endings only under fingers that stay."""
        if not contacts:
            return self.silence(ramp=RELEASE_RAMP)
        return self._builder.build_end() if along_endings else self.silence(ramp=FADE_RAMP)

    def _confirmed_until(self, selection: Selection) -> float:
        """Return when [s] the first target is lifted unless a frame arrives."""
        expiries = [self._tracker.expiry_of(contact.key) for contact, _ in selection.targets]
        return min(expiries, default=-math.inf)

    def _valid_for(self, selection: Selection, now: float) -> float:
        """How long [s] a vibration may last by itself; 0 where the host ends it."""
        if not self._capabilities.ends_itself:
            return 0.0
        return valid_for(selection, confirmed_until=self._confirmed_until(selection), now=now)

    def _missed_end(self, now: float) -> float | None:
        """Return when [s] the pulses that play were to end, if the host has to end them."""
        decision = self._playing.decision
        if self._capabilities.ends_itself or decision is None or decision.pattern is None:
            return None
        end = last_end(decision.selection)
        return end if end <= now else None

    def _validity(self, sets: SafeSets, selection: Selection, now: float) -> Validity:
        """Return how long sets committed by now [s] last."""
        until = self._confirmed_until(selection)
        return Validity.started(sets.valid_for, confirmed_until=until, now=now)

    def _note(self, change: Change, time: float) -> None:
        """Note when the first change since the last decision arrived."""
        if change and self._triggered_at is None:
            self._triggered_at = time


def _room_from(decision: Decision | None) -> float:
    """Return when [s] the amplifiers have room for a decision."""
    if decision is None:
        return -math.inf
    if decision.held_until is not None:
        return decision.held_until
    return -math.inf if decision.sets is None else decision.sets.room_from


def _is_due(moment: float | None, now: float) -> bool:
    return moment is not None and now >= moment
