"""The control loop of a plate: a cycle plans, sends what changes, then feeds the watchdogs.

plan(now):  fingers -> intent -> contents -> the layers that change, on every amplifier

The planner never waits, and reads no clock; the cycle waits and sends. Reports say what a plan
plays or silences; observers of the control loop get them.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ParamSpec

from controller.play.intent import (
    IntentSource,
    Prediction,
    Pulse,
    Selection,
    no_layer_free,
    not_served,
)
from controller.play.routing import CountedClocks, Drive, PlaybackCapabilities
from controller.play.selection import Chooser, Selector
from controller.play.slots import RELEASE_RAMP, RETRY, Check, Sets, Slot, Slots
from controller.sources.touch import (
    Change,
    Contact,
    ContactKey,
    ContactTracker,
    RejectCounter,
    TouchFrame,
)
from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    Overtaken,
    Preempted,
)
from drivers.host.group import Group
from drivers.host.joint_sets import PlayedSet
from drivers.protocol.definition import HEARTBEAT
from model.answer.answer import Layer, Limits
from model.answer.answer_report import Timing
from model.answer.plan import prepare_answers, query
from model.answer.stimulus import FADE_RAMP, MIN_LEVEL_DB_SL, Placement
from model.quantities import counted
from model.rig.rig import Rig
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from registry import threads
from registry.plugins import failure_text

ENDED = (
    "the vibration has ended by itself: it was not renewed, or a limit of time was reached; touch "
    "there again"
)

_CLOCKS_INTERVAL = 2 * HEARTBEAT  # s; after which clocks are counted though fingers change

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """What contacts feel from a moment on, and the sets for it."""

    contacts: tuple[Contact, ...]
    selection: Selection
    made_at: float
    """[s]"""
    answered: Mapping[ContactKey | None, float]
    """When [s] the fingers changed that the plan answers; None: the first that lifted."""
    sets: Sets = field(default_factory=Sets)
    """Empty where nothing changes."""
    is_reported: bool = True
    """Whether what is felt changes."""
    before: Mapping[int, Slot] = field(default_factory=dict)
    """What played before, by layer."""

    @property
    def since(self) -> float:
        """When [s] the first finger changed that it answers; when it was made, if none did."""
        return min([self.made_at, *self.answered.values()])

    @property
    def is_touch(self) -> bool:
        """Whether it answers a finger that came, moved or pressed, not lifts alone."""
        return len(self.answered) > (None in self.answered)


class Planner:
    """Plans what the contacts on one plate feel; synchronous, times are arguments.

    A plan never raises: it falls back to silence on any exception. check: asks the ledgers;
    arrived: called when contents have been chosen in the thread; it calls `look_again` and plans.
    too_late: called with the number of clicks that came too late to be felt; clock_errors: returns
    the clock errors of the amplifiers by name, rms [s].
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
        check: Check,
        arrived: Callable[[], None] = lambda: None,
        too_late: Callable[[int], None] = lambda clicks: None,
        clock_errors: Callable[[], Mapping[str, float]],
    ) -> None:
        self.capabilities = capabilities
        """The capabilities of the amplifiers together."""
        self._tracker, self._intent_source = tracker, intent_source
        self.slots = Slots(rig, capabilities, timing, check=check, expiry_of=tracker.expiry_of)
        """What each layer plays."""
        self.clocks = CountedClocks(rig, clock_errors)
        """The clock errors of the amplifiers, as answers count them."""
        self._selector = Selector(
            self._chooser_of(table),
            arrived=arrived,
            may_lead=self.slots.may_lead,
        )
        self._selected: Selection | None = None  # the last, before limits left contents out of it
        self._unplayed: Mapping[ContactKey | None, float] = {}  # answered by what was refused
        self._plan: Plan | None = None  # the last, None where what plays is unknown
        self._intent_due = math.inf  # s; when the intent may change without a touch
        self._retry_at = math.inf  # s; when a ledger may admit what it refused
        self._clocks_due = -math.inf  # s; though fingers change
        self._too_late = too_late
        self._seen: Sequence[Contact] = ()  # by the last plan
        self._awaited: dict[int, Pulse] = {}  # by identity: planned, and not known to have started
        self._pending: object = None  # the last question in the thread
        self._waiting: dict[ContactKey | None, float] = {}  # fingers that the last is for

    def replace_answers(self, table: LocalizationTable, timing: Timing) -> None:
        """Answer by another table of this plate from now on; what plays is kept until all rest."""
        self.slots.timing = timing
        self._answer_by(self._chooser_of(self.clocks.counted_by(table)))

    def replace_limits(self, limits: Limits) -> None:
        """Answer within other limits from now on: an amplifier was identified again."""
        if limits != self.capabilities.limits:
            self.capabilities = replace(self.capabilities, limits=limits)
            self._answer_by(self._selector.chooser)

    def _count_clocks(self) -> None:
        """Answer by the clocks as they are now; what plays is kept until all rest.

        It is chosen anew at once if a clock is no longer held.
        """
        chooser, known = self._selector.chooser, self.clocks.known
        is_one_lost = self.clocks.is_one_lost(known)
        counted = self.clocks.counted_by(chooser.table, known)
        if counted is not chooser.table:
            self._answer_by(replace(chooser, table=counted), at_once=is_one_lost)

    def _chooser_of(self, table: LocalizationTable) -> Chooser:
        """Make a chooser by a table, whose envelopes are of the timing in use."""
        shape = partial(self.capabilities.envelope_support.shape, self.slots.timing)
        return Chooser(table, shape)

    def _answer_by(self, chooser: Chooser, *, at_once: bool = False) -> None:
        """Answer by another chooser once all rest, or at once; at once where nothing plays, too."""
        selector = self._selector
        selector.chooser = chooser
        if at_once or not (self.slots.may_play or selector.pending):
            selector.choose_anew()
        self.look_again()

    def prepare(self) -> None:
        """Precompute what the first touch would have to wait for; seconds, of a large rig.

        The table without clock errors, by which statuses say what leaks, shares all of that with
        the one with them. Raises InputError for a table without a pattern for these amplifiers.
        """
        mode, timing = self.capabilities.drive_mode, self.slots.timing
        prepare_answers(self._selector.chooser.table, mode)
        self._count_clocks()
        table = self._selector.chooser.table
        timing.prepare(table.frequencies.tolist())
        plate, support = table.plate, self.capabilities.envelope_support
        placed = Placement(((plate.length / 2, plate.width / 2),), ((0.0, 0.0),))
        band = self.capabilities.limits.frequencies
        (layer,) = query(table, placed, MIN_LEVEL_DB_SL, drive_mode=mode, band_hz=band).layers
        onset, ending = support.onset_knots > 0, support.ending_knots > 0
        timing.with_envelopes(layer, placed, onset=onset, ending=ending)

    @property
    def due(self) -> float:
        """When [s] to plan next even if nothing arrives.

        Then an intent expires, a ledger may admit what it refused, or a finger that moved rests.
        """
        return min(self._intent_due, self._retry_at, self._selector.due)

    @property
    def is_waiting(self) -> bool:
        """Whether a change of fingers is not answered yet, or contents are being chosen."""
        return bool(self._tracker.changed) or self._selector.pending is not None

    @property
    def is_silence_pending(self) -> bool:
        """Whether the last contact has lifted and silence has not been commanded yet."""
        return not self._tracker.contacts and not self.slots.is_silent

    def note_lifts(self, up: Sequence[Contact]) -> None:
        """Note that contacts have lifted."""
        seen = {each.key for each in self._seen}
        if unseen := sum(each.key not in seen for each in up):
            self._too_late(unseen)

    def look_again(self) -> None:
        """Note that the next plan may differ though no contact has changed."""
        self._intent_due = -math.inf

    def forget(self) -> None:
        """Discard the known playback: the next plan has a set; fingers keep their layers."""
        self._plan, self._retry_at = None, math.inf
        self.slots.forget()

    def not_played(self, plan: Plan, *, is_known: bool) -> None:
        """Have the fingers of a plan that was not played wait for the next one.

        What plays is discarded, unless it is known to be what played before; what the plan ends may
        play, and is ended by the next.
        """
        if plan.is_reported or not is_known:
            self.forget()
        if plan.is_reported:
            self._tracker.wait_again(plan.answered)
            sets = plan.sets
            left = plan.before.keys() - (sets.layers.keys() - sets.started) if is_known else ()
            self.slots.contents = {number: plan.before[number] for number in left}

    def only_ends(self, plan: Plan) -> Plan:
        """Return a plan that starts and prolongs nothing; what it would start is planned again."""
        if not plan.is_reported:
            return replace(plan, sets=Sets())
        if not plan.sets.started:
            return plan
        self.not_played(plan, is_known=True)
        ends = {n: each for n, each in plan.sets.layers.items() if n not in plan.sets.started}
        return replace(plan, sets=Sets(ends), is_reported=False)

    def confirm(self, sets: Sets, played: PlayedSet, *, now: float) -> None:
        """Note what the amplifiers play of sets by now [s].

        Pulses start where the last amplifier does.
        """
        for pulse in self._pulses(sets.started):
            if pulse.started_at is None:
                if played.starts_at > pulse.end:
                    self._too_late(1)
                pulse.started_at = played.starts_at
                self._intent_due = min(self._intent_due, pulse.end)
        self.slots.confirm(sets, played, now)

    def refused(self, plan: Plan, refusal: CommandRefused, *, now: float) -> Plan:
        """Return silence in place of a plan that amplifiers refused though the ledgers admit it.

        It is planned again when the refusal ends, or after RETRY where that is unknown.
        """
        if not plan.is_reported and self.slots.contents:
            self.slots.not_renewed(plan.sets, refusal)
            return replace(plan, sets=Sets())
        if refusal.until is None or refusal.until > now:  # not of a wire that is too slow or busy
            self._awaited.clear()
        until = now + RETRY if refusal.until is None else refusal.until
        self._retry_at = max(until, now + HEARTBEAT)
        self._unplayed = plan.answered
        silence = replace(self.slots.silence(FADE_RAMP, now), reason=str(refusal))
        return replace(plan, sets=silence, is_reported=True)

    def plan(self, now: float) -> Plan | None:
        """Plan at a time [s], for the contacts as of `expire`; None if nothing changes."""
        for number, pulse in [*self._awaited.items()]:
            if pulse.started_at is not None or now >= pulse.end:
                del self._awaited[number]
                if pulse.started_at is None:
                    self._too_late(1)
        before, contacts, has_failed = self._plan, self._tracker.contacts, False
        playing = self.slots.contents
        try:
            # Where fingers change only if none was counted for long: their answer waits for it.
            if now >= self._clocks_due or not self._tracker.changed:
                self._clocks_due = now + _CLOCKS_INTERVAL
                self._count_clocks()
            if before is not None and not (self._tracker.changed or now >= self.due):
                return self._go_on(before, now)
            self._seen = contacts
            self._intent_due = math.inf
            fingers = tuple([each for each in contacts if not each.why_load_alone])
            intent = self._intent_source.intent(fingers, now)
            self._intent_due = intent.due(now)
            chosen = self._selector.select(contacts, intent, self.capabilities, now=now)
            selected = chosen.weakened(intent.gains_db)
            if before is not None and selected == self._selected and now < self._retry_at:
                self._answered(())
                return self._go_on(before, now)
            if self._unplayed:
                down = {each.key for each in contacts}
                self._tracker.wait_again({k: at for k, at in self._unplayed.items() if k in down})
                self._unplayed = {}
            selection, sets = self._playable(selected), Sets()
            if is_felt := len(selection.contents) > 0:
                sets = self.slots.plan(selection.contents, now)
                if sets.skipped:
                    selection = selection.without(sets.skipped, sets.reason)
        except Exception as error:
            has_failed, is_felt, sets = True, False, Sets(retry_at=now + HEARTBEAT)
            self._selector.due, self._retry_at = math.inf, sets.retry_at
            selected = selection = Selection((), contacts, (), failure_text(error))
            if before is not None and selected == self._selected:
                return None
            _logger.exception("loop: plan failed, silencing all channels")
        self._retry_at, self._selected = sets.retry_at, selected
        is_awaited = not is_felt and selected.is_pending and not self.slots.may_play
        if not (is_felt or is_awaited):
            sets = self._end(contacts, now, has_failed=has_failed)
        for pulse in self._pulses(sets.started):
            self._awaited[id(pulse)] = pulse
        answered = self._answered(sets.started)
        self._plan = plan = Plan(contacts, selection, now, answered, sets, before=playing)
        if sets or not (is_felt or is_awaited):
            return plan
        said = () if before is None else before.selection.predictions
        return self._go_on(plan, now) if is_awaited or selection.predictions == said else plan

    def _go_on(self, plan: Plan, now: float) -> Plan | None:
        """Plan what is due where nothing changes: contents have ended or are to be prolonged."""
        if now < self.slots.due:
            return None
        if contents := self.slots.ended(now):
            selection = plan.selection.without(contents, ENDED)
            self._plan = replace(plan, selection=selection, sets=Sets(), made_at=now, answered={})
            return self._plan
        renewal = self.slots.renewal(now)
        return replace(plan, sets=renewal, is_reported=False) if renewal else None

    def _playable(self, selection: Selection) -> Selection:
        """Return a selection without what has ended by itself, and what has no layer."""
        if over := self.slots.over_of(selection.contents):
            selection = selection.without(over, ENDED)
        count = self.capabilities.layers
        if len(selection.contents) > count:  # of each content all voices have one, or none
            served = [*self.slots.numbered(selection.contents).values()]
            lacking = [each.targets for each in selection.contents if each not in served]
            left = [each for each in selection.contents if each.targets in lacking]
            selection = selection.without(left, no_layer_free(count))
        return selection

    def _end(self, contacts: tuple[Contact, ...], now: float, *, has_failed: bool) -> Sets:
        """Return the sets that end all that plays; along endings only under fingers that stay."""
        if not contacts:
            return self.slots.silence(RELEASE_RAMP, now)
        if has_failed or not self.slots.have_settled(now):
            return self.slots.silence(FADE_RAMP, now)
        return self.slots.plan((), now)

    def _answered(self, started: Collection[int]) -> dict[ContactKey | None, float]:
        """Return when [s] the fingers changed that are answered; None: the first that lifted.

        While contents are being chosen, only lifts and pulses that start are answered, and with a
        content that lasts also the fingers of the choice before.
        """
        changed, pending = self._tracker.changed, self._selector.pending
        before, waiting = self._waiting, dict[ContactKey | None, float]()
        answered = {**changed, **before}
        if pending is not None:
            contents = [self.slots.contents[number].content for number in started]
            short = [each for each in contents if each.targets[0][1].is_short]
            keys = {None, *[contact.key for each in short for contact, _ in each.targets]}
            answered = {key: at for key, at in answered.items() if key in keys}
            if pending is self._pending:
                changed.pop(None, None)
                return answered
            waiting = {key: at for key, at in changed.items() if key not in keys}
            if len(short) < len(contents):
                answered |= before
            else:
                waiting |= before
        changed.clear()
        self._pending, self._waiting = pending, waiting
        return answered

    def _pulses(self, numbers: Iterable[int]) -> list[Pulse]:
        """Return the pulses that play in layers."""
        return [
            target.pulse
            for number in numbers
            for _, target in self.slots.contents[number].content.targets
            if target.pulse is not None
        ]


@dataclass(frozen=True)
class PlayReport:
    """The contents that amplifiers play since their last confirmed set, or why they are silent."""

    contacts: tuple[Contact, ...]
    """All contacts, in order of arrival."""
    targets: tuple[Prediction, ...]
    """A prediction for each contact that is to feel something; of silence with the reason."""
    latency: float | None
    """Time [s] from the touch frame to the last byte of the command; None if none was needed."""
    time: float
    """When [s] that byte was sent, or the report made."""
    is_touch: bool = False
    """As of the plan."""
    reason: str = ""
    """Why all channels are silent."""
    contents: Mapping[int, Slot] = field(default_factory=dict)
    """Copies of the slots as they are played, by layer, the newest one last; none in silence."""
    quiet: tuple[Contact, ...] = ()
    """Contacts that are to feel nothing of what plays."""
    quiet_levels: Mapping[ContactKey, Sequence[float]] = field(default_factory=dict)
    """Foreign levels at quiet contacts (`Selection.foreign_levels`)."""
    settled_after: float = 0.0
    """Time [s] until the last fade or envelope has ended."""
    lasts: bool = True
    """Whether all contents play until their contacts change."""

    @property
    def newest(self) -> Slot:
        """The content that changed last."""
        return [*self.contents.values()][-1]

    @property
    def layer(self) -> Layer:
        """The layer of the newest content as it plays."""
        return self.newest.layer

    @property
    def drive(self) -> Drive:
        """The tones of the newest content, by ERA, without silent ones."""
        return self.newest.drive

    @property
    def felt(self) -> Prediction | None:
        """The prediction for the finger of the newest content; None where none plays."""
        every = [each for one in self.contents.values() for each in one.content.predictions[:1]]
        return every[-1] if every else None


def play_report(
    plan: Plan, playing: Mapping[int, Slot], *, sent_at: float | None, now: float
) -> PlayReport:
    """Report what plays after a plan, by layer; sent_at [s]: when it starts, None if before."""
    selection = plan.selection
    known = partial(
        PlayReport,
        plan.contacts,
        latency=None if sent_at is None else sent_at - plan.since,
        is_touch=plan.is_touch,
    )
    if plan.sets.silence is not None or not selection.contents:
        reason = plan.sets.reason or selection.reason or ""
        said = {each.contact.key: each for each in selection.not_served}
        targets = dict.fromkeys([contact for contact, _ in selection.targets])
        silent = tuple([said.get(each.key) or not_served(each, reason) for each in targets])
        return known(silent, time=now, reason=reason)
    order = sorted(
        [number for number, one in playing.items() if one.content in selection.contents],
        key=plan.sets.started.__contains__,
    )
    return known(
        selection.predictions,
        time=now if sent_at is None else sent_at,
        contents={number: replace(playing[number]) for number in order},
        quiet=selection.quiet,
        quiet_levels={
            each.key: selection.foreign_levels.get(each.key, ()) for each in selection.quiet
        },
        settled_after=plan.sets.settled_after,
        lasts=all(
            target.pulse is None for each in selection.contents for _, target in each.targets
        ),
    )


@dataclass(frozen=True)
class Observers:
    """Callbacks of the control loop by event, called within it in order: they must return at once.

    Their exceptions are logged and go no further.
    """

    contacts_changed: list[Callable[[tuple[Contact, ...], Change], object]] = field(
        default_factory=list
    )
    reported: list[Callable[[PlayReport], object]] = field(default_factory=list)
    refused: list[Callable[[str], object]] = field(default_factory=list)
    link_lost: list[Callable[[str], object]] = field(default_factory=list)
    cycle_completed: list[Callable[[], object]] = field(default_factory=list)
    """Called after each cycle of the loop, at least once a second."""


# s; the loop runs even with nothing to do, for a supervisor that checks whether it is alive.
IDLE_INTERVAL = 0.5

_P = ParamSpec("_P")


class Cycle:
    """The control loop of one plate; contacts are followed while it waits, too.

    group: all amplifiers, which are opened and armed elsewhere.
    """

    def __init__(self, plate: Plate, group: Group) -> None:
        self.group = group
        """All amplifiers together; replaced while `sending` is held."""
        self.planner: Planner | None = None
        """Plans for the amplifiers; None until they were open."""
        self.observers = Observers()
        self.tracker = ContactTracker(plate)
        """The contacts, also while no amplifier is open."""
        self.sending = asyncio.Lock()
        """Held while a turn sends."""
        self.is_closed = False
        """Whether `run` ends."""
        self.rejects = RejectCounter(_logger)
        """Counter of all rejected touches, at the sources and as contacts."""
        self.clicks_too_late = 0
        """Number of short vibrations that came too late to be felt while armed, since the start.

        They were over, or had lost their touch, before the amplifiers could play them, as under
        fingers that came and left within a cycle. Refusals by a ledger do not count.
        """
        self._plan: Plan | None = None  # that is on its way to the amplifiers
        self._wake = asyncio.Event()
        self._heartbeat_due = 0.0
        self._is_armed_anew = False  # until the next turn, which sends again what is to play
        self._expiry: asyncio.TimerHandle | None = None

    @property
    def is_preparing(self) -> bool:
        """Whether a change of contacts is on its way to the amplifiers."""
        planner, plan = self.planner, self._plan
        is_unsent = plan is not None and self.group.members.last_sent_at < plan.since
        return planner is not None and (is_unsent or planner.is_waiting)

    async def run(self) -> None:
        """Run the loop until `close` or cancellation, also while amplifiers are lost or closed.

        It sends only while they are armed. A loss is reported to observers once all others are
        stopped; a loss while disarmed shows in the next request of the supervisor.
        """
        while not self.is_closed:
            await self.step()
            _report(self.observers.cycle_completed)
            await self._wait_for_event()

    async def step(self) -> None:
        """Run the loop once: plan, send what changes, then the heartbeat if it is due."""
        planner, now = self.planner, threads.now()
        self._expire(now)
        self._wake.clear()
        if planner is None:
            return
        if self._is_armed_anew:  # not amid a turn, whose set may be on the wire
            self._is_armed_anew = False
            planner.forget()
        plan = planner.plan(now)
        try:
            async with self.sending:
                with suppress(LinkDegraded):  # what plays is unknown, and planned anew; others feed
                    if plan is not None and self.group.is_armed:
                        await self._send(planner, plan)
                # Not after a set that was given up: the next cycle silences it first.
                if self._is_heartbeat_due(planner):
                    # From its beginning: the watchdog has run since its request was sent.
                    due = self._heartbeat_due = threads.now() + HEARTBEAT
                    try:
                        await self.group.beat()
                    finally:
                        if self._heartbeat_due == due:  # none replies again since
                            rest = HEARTBEAT / 2  # on a slow wire
                            self._heartbeat_due = max(due, threads.now() + rest)
        except (Preempted, LinkDegraded):
            pass  # what plays is unknown, and planned anew
        except LinkError as error:
            _report(self.observers.link_lost, str(error))
        except DriverError as error:
            _report(self.observers.refused, str(error))

    async def _send(self, planner: Planner, plan: Plan) -> None:
        """Send what a plan changes, and report the outcome; raises DriverError.

        While an amplifier is degraded nothing starts or is prolonged.
        """
        if self.group.members.degraded:
            plan = planner.only_ends(plan)
        self._plan = plan
        try:
            outcome = await self._play(planner, plan)
            if isinstance(outcome, CommandRefused):
                plan = planner.refused(plan, outcome, now=threads.now())
                outcome = await self._play(planner, plan)
        finally:
            self._plan = None
        if reason := plan.sets.reason:
            _report(self.observers.refused, reason)
        if plan.is_reported:
            sent_at = outcome if isinstance(outcome, float) else None
            applied = play_report(plan, planner.slots.contents, sent_at=sent_at, now=threads.now())
            _report(self.observers.reported, applied)

    async def _play(self, planner: Planner, plan: Plan) -> float | CommandRefused | None:
        """Play the sets of a plan on all amplifiers, from one moment on.

        Returns when [s] they start, None where nothing is sent, or the refusal. It is unknown what
        plays if anything is raised.
        """
        if not (sets := plan.sets):
            return None
        try:
            if sets.silence is not None:
                sent_at = await self.group.silence(sets.silence)
                planner.slots.may_play = frozenset()
                return sent_at
            if self.group.sets.is_in_doubt:
                await self.group.silence(RELEASE_RAMP)  # before the next pattern
            played = await self.group.apply(
                sets.by_amplifier,
                (lambda: self._wake.is_set() and threads.now() < sets.preempted_until)
                if sets.endings
                else None,
            )
        except Overtaken:  # endings, by what has come since: they follow it
            return None
        except BaseException as error:
            is_overtaken = isinstance(error, Preempted) or not self.group.is_armed
            if isinstance(error, CommandRefused) and not is_overtaken and sets.silence is None:
                return error
            is_known = isinstance(error, LinkDegraded) and not self.group.sets.is_in_doubt
            planner.not_played(plan, is_known=is_known and sets.silence is None)
            raise
        planner.confirm(sets, played, now=threads.now())
        return played.starts_at

    def count_too_late(self, clicks: int) -> None:
        """Count clicks that came too late to be felt, while armed."""
        if self.group.is_armed:
            self.clicks_too_late += clicks
            _logger.warning(
                "%s came too late to be felt: replies are late", counted(clicks, "click")
            )

    def wake(self) -> None:
        """Begin the next cycle at once."""
        self._wake.set()

    def feed_at_once(self) -> None:
        """Begin the next cycle at once, and feed the watchdogs in it."""
        self._heartbeat_due = threads.now()
        self._wake.set()

    def note_armed(self, limits: Limits, *, was_armed: bool) -> None:
        """Note that the amplifiers have been armed: the next cycle sends all and feeds watchdogs.

        limits: of the amplifiers as they are now; was_armed: also before, so that what plays goes
        on. Raises CommandError without a planner.
        """
        if self.planner is None:
            raise CommandError("controller must be open; call open() first")
        self._is_armed_anew = True
        if not was_armed:
            self.planner.slots.may_play = frozenset()
        self.planner.replace_limits(limits)
        self._schedule_expiry()  # fingers may have rested since before
        self.feed_at_once()

    def deliver(self, frame: TouchFrame) -> None:
        """Process a touch frame; to be called in the loop's thread."""
        # Contacts that came since the last cycle have not been decided yet.
        is_undecided = self._wake.is_set() and self.group.is_armed
        change = self.tracker.update(frame, keeps_taps=is_undecided)
        if change:
            self._follow(change)
        self._schedule_expiry()
        for reason in change.rejected:
            self.rejects.count(reason, f"touch of {frame.source}")

    def lift(self, prefix: str) -> None:
        """Lift the contacts of all sources whose names have a prefix; failures are only logged."""
        for source in self.tracker.sources_of(prefix):
            try:
                self.deliver(TouchFrame(source, threads.now(), ()))
            except Exception:
                _logger.exception("loop: fingers of %s not lifted", source)

    def request_update(self) -> None:
        """Query the intent source again, because its intent changed without a touch."""
        if self.planner is not None:
            self.planner.look_again()
        self._wake.set()

    def _is_heartbeat_due(self, planner: Planner) -> bool:
        """Whether to feed the watchdogs now; pending silence has priority."""
        if not self.group.is_armed or planner.is_silence_pending:
            return False
        return threads.now() >= min(self._heartbeat_due, self.group.members.lost_from)

    def _follow(self, change: Change) -> None:
        """Act on a change of contacts, also while amplifiers are being awaited."""
        planner = self.planner
        self._wake.set()
        if change.up and planner is not None:  # else the amplifiers were never open
            planner.note_lifts(change.up)
            if planner.is_silence_pending:
                self.group.abort_exchange()
        _report(self.observers.contacts_changed, self.tracker.contacts, change)

    def _schedule_expiry(self) -> None:
        """Check for expired sources when the next one times out.

        A timer that is due before stays: nothing is set anew for every frame of a source.
        """
        due = self.tracker.next_expiry
        if self._expiry is not None:
            if self._expiry.when() <= due < math.inf:
                return
            self._expiry.cancel()
            self._expiry = None
        if due < math.inf:
            pause = max(0.0, due - threads.now())
            self._expiry = asyncio.get_running_loop().call_later(pause, self._time_out)

    def _time_out(self) -> None:
        self._expiry = None
        self._expire(threads.now())
        self._schedule_expiry()

    def _expire(self, now: float) -> None:
        """Lift contacts that no source has confirmed in time; called before every plan."""
        if (change := self.tracker.expire(now)).up:
            self._follow(change)

    async def _wait_for_event(self) -> None:
        """Wait for a change, a heartbeat, or the expiry of an intent."""
        if self._wake.is_set():
            return
        now = threads.now()
        until = now + IDLE_INTERVAL
        if self.planner is not None:
            until = min(until, self.planner.due)
        if self.group.is_armed:
            until = min(until, self._heartbeat_due, self.group.members.lost_from)
            if self.planner is not None and now < (due := self.planner.slots.ending_due):
                until = min(until, due)
        pause = max(0.0, until - now)
        timer = asyncio.get_running_loop().call_later(pause, self._wake.set)
        try:
            await self._wake.wait()
        finally:
            timer.cancel()


def _report(callbacks: Iterable[Callable[_P, object]], *args: _P.args, **kwargs: _P.kwargs) -> None:
    """Call all observers of an event; log their exceptions."""
    for callback in callbacks:
        try:
            callback(*args, **kwargs)
        except Exception:
            _logger.exception("loop: observer failed")
