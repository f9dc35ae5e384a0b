"""Decisions of the control loop, without waiting: touch frames in, sets of all amplifiers out.

take(frame)  ->  contacts
decide(now)  ->  contacts -> intent -> selection -> routing -> a set of every amplifier
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.intent import IntentSource
from controller.loop.plate_set import FADE_RAMP, PlateSet, SetBuilder
from controller.loop.routing import Drive, tones_by_era
from controller.loop.selection import Selection, Selector
from controller.loop.table_query import is_short
from controller.loop.validity import Validity, first_lasts, valid_for
from controller.sources.contacts import Change, Contact, ContactTracker
from controller.sources.touch import TouchFrame
from drivers.errors import CommandRefused
from drivers.host.joint_sets import Played
from drivers.host.ledger import is_vibrating
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import QUANTITIES
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.table import LocalizationTable
from model.table.timing import Timing
from registry.plugins import failure_text

# With no finger left on the plate the end may be short: zero within 20 ms of the lift.
RELEASE_RAMP = 0.010

ENDED = "the vibration has ended by itself: it was not renewed, or a limit of time was reached"

# s; after a vibration a plate first rings louder than the next onset is at a quiet finger.
_RING_DOWN = 0.4
_VALID_FOR = QUANTITIES["valid_for"]

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Decision:
    """A selection and what the amplifiers are to play for it.

    from_rest: whether nothing has played for 0.4 s, so that the plate is at rest;
    triggered_at [s]: when the change arrived.
    set: None if all channels are silent already; pattern: with the ramp and onset of the set, None
    for silence; refusal: why a ledger refused the pattern, which makes it silence; retry_at [s]:
    when the ledger would admit it, None for never.
    """

    contacts: tuple[Contact, ...]
    selection: Selection
    from_rest: bool
    triggered_at: float
    set: PlateSet | None = None
    pattern: Pattern | None = None
    refusal: str | None = None
    retry_at: float | None = None


@dataclass(frozen=True)
class _Playback:
    """Playback of the amplifiers since the last decision with a set.

    drive: by ERA, as confirmed; settled_at [s]: when its onset has ended.
    """

    decision: Decision | None = None
    drive: Drive = field(default_factory=dict)
    settled_at: float = math.inf
    validity: Validity = field(default_factory=Validity)

    @property
    def is_silent(self) -> bool:
        """Whether it is certain that nothing plays."""
        found = None if self.decision is None else self.decision.set
        return found is not None and found.is_silence

    @property
    def retry_at(self) -> float | None:
        """When [s] a ledger would admit what it refused."""
        return None if self.decision is None else self.decision.retry_at


class Decider:
    """Intent, selection and sets for the contacts on one plate; synchronous, times are arguments.

    A decision never raises: it falls back to silence on any exception.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        *,
        tracker: ContactTracker,
        capabilities: PlaybackCapabilities,
        intent_source: IntentSource,
        timing: Timing | None = None,
    ) -> None:
        self._rig = rig
        self._table = table
        self._timing = timing
        self._capabilities = capabilities
        self._tracker = tracker
        self._intent_source = intent_source
        self._intent_due: float | None = None  # when the intent may change without a touch
        self._selector = Selector(table, None if timing is None else timing.levels)
        self._builder = SetBuilder(
            rig,
            support=capabilities.envelope_support,
            ramp_max=capabilities.ramp_max,
            timing=timing,
        )
        self._selected: Selection | None = None
        self._playing = _Playback()
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
            frequencies=self._capabilities.frequencies,
            envelopes=support.onset_knots > 0,
        )
        pattern = self._timing.with_envelopes(
            question,
            self._table.query(question),
            onset=support.onset_knots > 0,
            ending=support.ending_knots > 0,
        )
        self._timing.with_transient_measures(question, pattern)

    @property
    def due(self) -> float | None:
        """When [s] to decide next even if nothing arrives.

        A source times out then, an intent expires, or a ledger would admit what it refused.
        """
        moments = (self._tracker.next_expiry, self._intent_due, self._playing.retry_at)
        return min((moment for moment in moments if moment is not None), default=None)

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
        """Discard the known playback: the next decision has a set."""
        self._selected = None
        self._playing = _Playback()

    def confirm(self, played: Played, *, now: float) -> Drive:
        """Note what the amplifiers play for the last decision; returns it by ERA.

        Pulses start when the last commit was sent.
        """
        drive = tones_by_era(played.layers, self._rig)
        decision = self._playing.decision
        self._playing = replace(self._playing, drive=drive)
        if decision is None or decision.set is None or decision.pattern is None:
            return drive
        for _, target in decision.selection.targets:
            if target.pulse is not None and target.pulse.started_at is None:
                target.pulse.started_at = played.sent_at
        self._playing = replace(
            self._playing,
            settled_at=now + decision.set.settled_after,
            validity=self._validity(played, decision.selection, now),
        )
        return drive

    def without_shapes(self, decision: Decision) -> Decision | None:
        """Return the last decision along its plain ramp; None where it has no shapes."""
        plain = None if decision.set is None else decision.set.plain
        if plain is None or decision.pattern is None:
            return None
        pattern = replace(decision.pattern, onset=None, ending=None)
        decision = replace(decision, set=plain, pattern=pattern)
        self._playing = replace(self._playing, decision=decision)
        return decision

    def refused(self, decision: Decision, error: CommandRefused) -> Decision:
        """Return silence in place of the last decision, which a ledger has refused."""
        decision = replace(
            decision,
            set=PlateSet(ramp=FADE_RAMP),
            pattern=None,
            refusal=str(error),
            retry_at=error.until,
        )
        self._playing = _Playback(decision)
        return decision

    def renewal(self, now: float) -> PlateSet | None:
        """Return the set that prolongs the playback, if due at a time [s]; else None."""
        decision = self._playing.decision
        if decision is None or decision.set is None:
            return None
        confirmed_until = self._confirmed_until(decision.selection)
        if not self._playing.validity.is_renewal_due(now, confirmed_until=confirmed_until):
            return None
        lasts = valid_for(decision.selection, confirmed_until=confirmed_until, now=now)
        return self._builder.build_renewal(decision.set, valid_for=lasts)

    def confirm_renewal(self, played: Played, *, now: float) -> None:
        """Note that the amplifiers have accepted a renewal."""
        if self._playing.decision is not None:
            validity = self._validity(played, self._playing.decision.selection, now)
            self._playing = replace(self._playing, validity=validity)

    def refuse_renewal(self, until: float | None) -> None:
        """Note that a ledger has refused a renewal until a time [s], None: the playback ends."""
        due = math.inf if until is None else until
        validity = replace(self._playing.validity, renewal_due=due)
        self._playing = replace(self._playing, validity=validity)

    def ended(self, now: float) -> Decision | None:
        """Return the end of a playback that has come by itself at a time [s], once; else None."""
        decision = self._playing.decision
        if decision is None or not self._playing.drive or now < self._playing.validity.ends_at:
            return None
        self._playing = replace(self._playing, drive={})
        return replace(decision, set=None, pattern=None, refusal=ENDED, triggered_at=now)

    def decide(self, now: float) -> Decision | None:
        """Decide at a time [s]; None if nothing changes."""
        self.expire(now)
        contacts, playing = self._tracker.contacts, self._playing
        triggered_at = now if self._triggered_at is None else min(self._triggered_at, now)
        self._triggered_at = None
        if playing.drive:
            self._played_until = now
        from_rest = now - self._played_until >= _RING_DOWN
        decision, has_failed = None, False
        try:
            selection = self._select(contacts, now)
            is_new = selection != self._selected or _is_due(playing.retry_at, now)
            draft = Decision(contacts, selection, from_rest, triggered_at)
            decision = self._with_pattern(draft, now) if is_new else None
        except Exception as error:
            has_failed = True
            selection = Selection((), contacts, None, failure_text(error))
            is_new = selection != self._selected
            draft = Decision(contacts, selection, from_rest, triggered_at)
            if is_new:
                _logger.exception("loop: decision failed, silencing all channels")
        if decision is None and is_new:
            decision = draft
            if not playing.is_silent:
                end = self._end(contacts, now, has_failed=has_failed)
                decision = replace(draft, set=end)
        if decision is not None and decision.set is not None:
            self._playing = _Playback(decision)
        elif is_new and playing.decision is not None:
            self._playing = replace(playing, decision=replace(playing.decision, retry_at=None))
        self._selected = selection
        return decision

    def _select(self, contacts: tuple[Contact, ...], now: float) -> Selection:
        """Query the intent, and the table for it."""
        self._intent_due = None
        intent = self._intent_source.intent(contacts, now)
        self._intent_due = intent.due(now)
        return self._selector.select(contacts, intent, self._capabilities)

    def _with_pattern(self, draft: Decision, now: float) -> Decision | None:
        """Return a draft with the set of its pattern; None without a pattern."""
        selection = draft.selection
        if selection.pattern is None or selection.question is None:
            return None
        until = self._confirmed_until(selection)
        found, pattern = self._builder.build_pattern(
            selection.pattern,
            selection.question,
            playing=self._playing.drive,
            valid_for=valid_for(selection, confirmed_until=until, now=now),
            is_shaped=not is_short(selection.targets),
            lasts=first_lasts(selection, now),
        )
        return replace(draft, set=found, pattern=pattern)

    def _end(self, contacts: tuple[Contact, ...], now: float, *, has_failed: bool) -> PlateSet:
        """Return what ends the playback: along endings only under fingers that stay."""
        if not contacts:
            return PlateSet(ramp=RELEASE_RAMP)
        decision = self._playing.decision
        has_endings = decision is not None and decision.set is not None and decision.set.has_endings
        if has_endings and not has_failed and now >= self._playing.settled_at:
            return self._builder.build_end()
        return PlateSet(ramp=FADE_RAMP)

    def _confirmed_until(self, selection: Selection) -> float:
        """Return when [s] the first target is lifted unless a frame arrives."""
        expiries = [self._tracker.expiry_of(contact.key) for contact, _ in selection.targets]
        return min(expiries, default=-math.inf)

    def _validity(self, played: Played, selection: Selection, now: float) -> Validity:
        """Return how long a set that has been played by now [s] lasts."""
        until = self._confirmed_until(selection)
        return Validity.started(_shortest(played.layers), confirmed_until=until, now=now)

    def _note(self, change: Change, time: float) -> None:
        """Note when the first change since the last decision arrived."""
        if change and self._triggered_at is None:
            self._triggered_at = time


def _shortest(played: Mapping[str, Sequence[LayerSet]]) -> float:
    """Return the time [s] after the commit when the first amplifier ends its vibration by itself.

    Infinite where none does.
    """
    times = [
        _VALID_FOR.from_wire(one.valid_for)
        for layers in played.values()
        for one in layers
        if one.valid_for and is_vibrating(one)
    ]
    return min(times, default=math.inf)


def _is_due(moment: float | None, now: float) -> bool:
    return moment is not None and now >= moment
