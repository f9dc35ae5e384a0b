"""What the control loop decides, without waiting for anything: touch frames in, safe commands out.

take(frame)  ->  contacts
decide(now)  ->  contacts -> intents -> selection -> routing -> guard -> order, if another is due
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.envelopes import ENVELOPE_TIME, PLAIN
from controller.loop.intent import IntentSource
from controller.loop.loading_times import LoadingTimes
from controller.loop.orders import FADE_RAMP, Order, OrderMaker, PatternTiming
from controller.loop.selection import PatternTable, Selection, Selector
from controller.sources.contacts import Change, Contact, ContactTracker
from controller.sources.touch import TouchFrame
from drivers.command import DriveCommand
from drivers.guard import Guard
from model.rig.rig import Rig
from model.table.question import Question
from registry.plugins import failure_text

# With nobody on the plate the end may be short, so that zero is reached within 20 ms of the lift.
RELEASE_RAMP = 0.010

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Decision:
    """What is to be done now.

    changes: of the contacts, since the last decision; is_new: whether the selection is another;
    order: what the amplifiers shall do, None if what plays stays; from_rest: whether nothing played
    before; since: when [s] the news came that led to this.
    """

    contacts: tuple[Contact, ...]
    changes: tuple[Change, ...]
    selection: Selection
    is_new: bool
    order: Order | None
    from_rest: bool
    since: float


@dataclass(frozen=True)
class _Playing:
    """What the amplifiers do since the last order, as far as that is known.

    drive: what they made of it, by ERA, nothing until they have confirmed; has_brakes: whether it
    ends by these; brake_due [s]: when they fit; again_at [s]: when what a guard refused may be
    asked for again.
    """

    order: Order | None = None
    drive: Mapping[str, DriveCommand] = field(default_factory=dict)
    has_brakes: bool = False
    brake_due: float | None = None
    again_at: float | None = None

    @property
    def is_silent(self) -> bool:
        """Whether nothing plays, for certain."""
        return self.order is not None and self.order.is_silence


class Decider:
    """Contacts, intents, selection and orders of one plate; reads no clock and waits for nothing.

    guards: by the name of the amplifier, one for each in the rig; envelope_time: longest [s] that
    loading envelopes may take. Never raises while it decides: whatever goes wrong, the decision is
    silence.
    """

    def __init__(
        self,
        rig: Rig,
        table: PatternTable,
        *,
        guards: Mapping[str, Guard],
        capabilities: PlaybackCapabilities,
        intent_source: IntentSource,
        timing: PatternTiming | None = None,
        envelope_time: float = ENVELOPE_TIME,
    ) -> None:
        self._rig = rig
        self._table = table
        self._timing = timing
        self._capabilities = capabilities
        self._loadings = LoadingTimes(envelope_time)
        self._tracker = ContactTracker(rig.plate)
        self._intent_source = intent_source
        self._intent_due: float | None = None  # when it may be another
        self._selector = Selector(table)
        self._orders = OrderMaker(rig, guards, timing=timing)
        self._decided: Selection | None = None
        self._playing = _Playing()
        self._changes: list[Change] = []
        self._since: float | None = None

    @property
    def capabilities(self) -> PlaybackCapabilities:
        """What the amplifiers can play."""
        return self._capabilities

    def prepare(self) -> None:
        """Work out what the first touch would have to wait for; tens of milliseconds.

        Raises InputError for a table that has no answer which these amplifiers play.
        """
        self._table.prepare(self._capabilities.drive_mode)
        if self._timing is None:
            return
        self._timing.prepare(self._table.frequencies.tolist())
        plate, shaping = self._table.plate, self._capabilities.shaping
        anybody = Question(
            ((plate.length / 2, plate.width / 2),),
            ((0.0, 0.0),),
            level_db_sl=-100.0,
            drive_mode=self._capabilities.drive_mode,
            playable=self._capabilities.playable,
            frequencies=self._capabilities.frequencies,
            envelopes=shaping.onsets,
        )
        pattern = self._timing.with_envelopes(
            anybody, self._table.query(anybody), onset=shaping.onsets, ending=shaping.endings
        )
        self._timing.with_transient_measures(anybody, pattern)

    @property
    def due(self) -> float | None:
        """When [s] a decision is due, news or not.

        A source is overdue then, an intent expires, what plays has settled and gets its brakes, or
        a guard lets through what it refused.
        """
        moments = (
            *(self._tracker.next_expiry, self._intent_due),
            *(self._playing.brake_due, self._playing.again_at),
        )
        return min((moment for moment in moments if moment is not None), default=None)

    @property
    def next_expiry(self) -> float | None:
        """When [s] the next source is overdue unless it is heard."""
        return self._tracker.next_expiry

    @property
    def owes_silence(self) -> bool:
        """Whether nobody touches the plate any more, but what was decided last is no silence."""
        return not self._tracker.contacts and not self._playing.is_silent

    def take(self, frame: TouchFrame) -> Change:
        """Take over a touch frame; a decision is due if anything changed."""
        change = self._tracker.update(frame)
        self._note(change, frame.time)
        return change

    def expire(self, now: float) -> Change:
        """Lift the contacts of sources that are overdue now [s]; a decision is due if any are."""
        change = self._tracker.expire(now)
        self._note(change, now)
        return change

    def forget(self) -> None:
        """What the amplifiers play is not known any more: the next decision has commands."""
        self._decided = None
        self._playing = _Playing()

    def confirm(self, drive: Mapping[str, DriveCommand], *, now: float) -> None:
        """This is what the amplifiers made of the last order, by ERA, silent ones left out."""
        self._playing = replace(self._playing, drive=drive)
        order = self._playing.order
        if order is None or order.pattern is None:
            return
        if order.is_brake:
            self._playing = replace(self._playing, has_brakes=True)
        elif self._capabilities_at(now).shaping.endings and self._timing is not None:
            self._playing = replace(self._playing, brake_due=now + order.settled_after)

    def loaded_in(self, duration: float, *, now: float) -> None:
        """Loading the envelopes took so long [s]; where that is too long, ramps serve for now."""
        self._loadings.took(duration, now=now)

    def plain_because(self, now: float) -> str | None:
        """Why touches begin along plain ramps though the amplifiers play envelopes."""
        return self._loadings.problem(now) if self._capabilities.shaping else None

    def decide(self, now: float) -> Decision:
        """Decide at a time [s]."""
        self.expire(now)
        contacts = self._tracker.contacts
        before = self._playing
        is_calm = True
        try:
            selection = self._select(contacts, now)
            is_new = selection != self._decided or _has_come(before.again_at, now)
            order = self._order_for(selection, now, is_new=is_new)
        except Exception as error:
            is_calm = False
            selection = Selection((), contacts, None, failure_text(error))
            is_new, order = selection != self._decided, None
            if is_new:
                _logger.exception("the decision failed, all channels fall silent")
        if is_new and order is None and not before.is_silent:
            order = self._ending(contacts, by_brakes=before.has_brakes and is_calm)
        if order is not None:
            self._playing = _Playing(order, again_at=order.again_at)
        else:
            self._playing = replace(
                before,
                again_at=None if is_new else before.again_at,
                brake_due=None if _has_come(before.brake_due, now) else before.brake_due,
            )
        self._decided = selection
        decision = Decision(
            contacts=contacts,
            changes=tuple(self._changes),
            selection=selection,
            is_new=is_new,
            order=order,
            from_rest=not before.drive,
            since=now if self._since is None else min(self._since, now),
        )
        self._changes, self._since = [], None
        return decision

    def silence(self, *, ramp: float) -> Order:
        """The order that brings every wired channel to zero along a ramp [s]; never fails."""
        return self._orders.silence(ramp=ramp)

    def _capabilities_at(self, now: float) -> PlaybackCapabilities:
        """What is to be played by at a time [s]: without envelopes while these take too long."""
        return (
            replace(self._capabilities, shaping=PLAIN)
            if self._loadings.problem(now)
            else self._capabilities
        )

    def _select(self, contacts: tuple[Contact, ...], now: float) -> Selection:
        """What is wished for, and what the table has for it."""
        self._intent_due = None
        intent = self._intent_source.intent(contacts, now)
        self._intent_due = intent.due(now)
        return self._selector.select(contacts, intent, self._capabilities_at(now))

    def _order_for(self, selection: Selection, now: float, *, is_new: bool) -> Order | None:
        """The order that a selection with a pattern needs: to play it, or to give it its brakes."""
        playing, pattern, question = self._playing, selection.pattern, selection.question
        if pattern is None or question is None:
            return None
        if is_new:
            is_shaped = self._capabilities_at(now).shaping.onsets
            return self._orders.play(pattern, question, is_shaped=is_shaped, playing=playing.drive)
        if playing.drive and _has_come(playing.brake_due, now):
            return self._orders.brake(pattern, question, playing=playing.drive)
        return None

    def _ending(self, contacts: tuple[Contact, ...], *, by_brakes: bool) -> Order:
        """How what plays ends: by its brakes only for fingers that stay."""
        if not contacts:
            return self.silence(ramp=RELEASE_RAMP)
        return self._orders.end() if by_brakes else self.silence(ramp=FADE_RAMP)

    def _note(self, change: Change, time: float) -> None:
        """Keep a change for the next decision, with the time of the first."""
        if change:
            self._changes.append(change)
            self._since = time if self._since is None else self._since


def _has_come(moment: float | None, now: float) -> bool:
    """Whether it is time [s]."""
    return moment is not None and now >= moment
