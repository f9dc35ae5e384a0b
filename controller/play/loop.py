"""Control loop of a plate: each cycle plans, sends the changes and feeds the watchdogs.

plan(now):  fingers -> intent -> contents -> the layers that change, on every amplifier

The planner never waits and reads no clock; the cycle waits and sends. Observers of the loop get a
report whenever a plan changes the contents that play.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ParamSpec

from controller.play.chooser import Chooser
from controller.play.intent import (
    Content,
    FingerSensation,
    IntentSource,
    Pulse,
    Selection,
    no_layer_free,
    not_served,
)
from controller.play.routing import CountedClocks, Drive, PlaybackCapabilities
from controller.play.selection import PendingChoice, Selector
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

_CLOCKS_INTERVAL = 2 * HEARTBEAT  # s; longest time without counting clocks while fingers change

ChangeTimes = Mapping[ContactKey | None, float]
"""When [s] fingers changed, by contact; the key None is for the first finger that lifted."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """The contents that play from a moment on, and the sets that start them."""

    contacts: tuple[Contact, ...]
    selection: Selection
    made_at: float
    """[s]"""
    answered: ChangeTimes
    """Changes of fingers that the plan responds to."""
    sets: Sets = field(default_factory=Sets)
    """Empty if no layer changes."""
    is_reported: bool = True
    """Whether observers get a report, because a finger feels a difference."""
    former_slots: Mapping[int, Slot] = field(default_factory=dict)
    """Slots before the plan, by layer."""

    @property
    def since(self) -> float:
        """When [s] the first of the fingers changed; when the plan was made, if none did."""
        return min([self.made_at, *self.answered.values()])

    @property
    def is_touch(self) -> bool:
        """Whether it responds to a finger that came, moved or pressed, not to lifts alone."""
        return any(key is not None for key in self.answered)


class Planner:
    """Plans the vibrations for the contacts on one plate; synchronous, times are arguments.

    A plan never raises: it falls back to silence on any exception. check: queries the ledgers;
    arrived: called when contents have been chosen in the thread; it calls `look_again` and plans;
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
        self._tracker = tracker
        self._intent_source = intent_source
        self._count_too_late = too_late
        self.slots = Slots(rig, capabilities, timing, check=check, expiry_of=tracker.expiry_of)
        """The contents of all layers."""
        self.clocks = CountedClocks(rig, clock_errors)
        """Clock errors of the amplifiers, as the table includes them."""
        self._selector = Selector(
            self._chooser_of(table), arrived=arrived, may_lead=self.slots.may_lead
        )
        self._intent_due = math.inf  # s; when the intent may change without a touch
        self._retry_at = math.inf  # s; when a ledger may admit a refused set
        self._clocks_due = -math.inf  # s; when clocks are counted even if fingers have changed
        self._last_plan: Plan | None = None  # None if it is unknown which contents play
        self._last_selection: Selection | None = None  # including contents that limits left out
        self._planned_contacts: Sequence[Contact] = ()
        self._unstarted_pulses: dict[int, Pulse] = {}  # planned, but not started; by identity
        self._refused_changes: ChangeTimes = {}  # of a plan that amplifiers refused
        self._last_choice: PendingChoice | None = None
        self._waiting_changes: dict[ContactKey | None, float] = {}  # wait for that choice

    def replace_limits(self, limits: Limits) -> None:
        """Use other limits, because an amplifier was identified again."""
        if limits != self.capabilities.limits:
            self.capabilities = replace(self.capabilities, limits=limits)
            self._use(self._selector.chooser)

    def _count_clocks(self) -> None:
        """Update the table to the present clock errors; contents continue until all fingers rest.

        If a clock is no longer held, contents are chosen again immediately.
        """
        chooser = self._selector.chooser
        errors = self.clocks.known
        is_clock_lost = self.clocks.is_one_lost(errors)
        table = self.clocks.counted_by(chooser.table, errors)
        if table is not chooser.table:
            self._use(replace(chooser, table=table), immediately=is_clock_lost)

    def _chooser_of(self, table: LocalizationTable) -> Chooser:
        """Make a chooser with a table, whose envelopes follow the timing in use."""
        shape = partial(self.capabilities.envelope_support.shape, self.slots.timing)
        return Chooser(table, shape)

    def _use(self, chooser: Chooser, *, immediately: bool = False) -> None:
        """Use another chooser: immediately, if nothing plays or so requested, or once all rest."""
        selector = self._selector
        selector.chooser = chooser
        is_idle = not self.slots.may_play and selector.pending is None
        if immediately or is_idle:
            selector.choose_again()
        self.look_again()

    def prepare(self) -> None:
        """Compute in advance everything the first touch would wait for; seconds for a large rig.

        The table without clock errors, from which statuses compute foreign levels, shares these
        results. Raises InputError for a table without a pattern for these amplifiers.
        """
        drive_mode = self.capabilities.drive_mode
        prepare_answers(self._selector.chooser.table, drive_mode)
        self._count_clocks()
        table = self._selector.chooser.table
        timing = self.slots.timing
        timing.prepare(table.frequencies.tolist())
        centre = (table.plate.length / 2, table.plate.width / 2)
        placement = Placement((centre,), ((0.0, 0.0),))
        band = self.capabilities.limits.frequencies
        pattern = query(table, placement, MIN_LEVEL_DB_SL, drive_mode=drive_mode, band_hz=band)
        (layer,) = pattern.layers
        support = self.capabilities.envelope_support
        timing.with_envelopes(
            layer, placement, onset=support.onset_knots > 0, ending=support.ending_knots > 0
        )

    @property
    def due(self) -> float:
        """When [s] to plan next even if nothing arrives.

        The intent expires then, a ledger may admit a refused set, or a finger that moved rests.
        """
        return min(self._intent_due, self._retry_at, self._selector.due)

    @property
    def is_waiting(self) -> bool:
        """Whether a change of fingers is not planned yet, or contents are being chosen."""
        return bool(self._tracker.changed) or self._selector.pending is not None

    @property
    def is_silence_pending(self) -> bool:
        """Whether the last contact has lifted and silence has not been commanded yet."""
        return not self._tracker.contacts and not self.slots.is_silent

    def note_lifts(self, up: Sequence[Contact]) -> None:
        """Note that contacts have lifted."""
        planned_keys = {contact.key for contact in self._planned_contacts}
        unplanned = [contact for contact in up if contact.key not in planned_keys]
        if unplanned:
            self._count_too_late(len(unplanned))

    def look_again(self) -> None:
        """Note that the next plan can differ even if no contact changes."""
        self._intent_due = -math.inf

    def forget(self) -> None:
        """Discard the known playback; the next plan has a set, and fingers keep their layers."""
        self._last_plan = None
        self._retry_at = math.inf
        self.slots.forget()

    def not_played(self, plan: Plan, *, is_known: bool) -> None:
        """Let the fingers of a plan that was not played wait for the next plan.

        The known playback is discarded. If is_known, the former contents still play, except that
        layers ended by the plan may be silent or not; the next plan ends these again.
        """
        if plan.is_reported or not is_known:
            self.forget()
        if not plan.is_reported:
            return
        self._tracker.wait_again(plan.answered)
        self.slots.by_layer = {}
        if is_known:
            ended_layers = plan.sets.layers.keys() - plan.sets.started
            for number, slot in plan.former_slots.items():
                if number not in ended_layers:
                    self.slots.by_layer[number] = slot

    def only_ends(self, plan: Plan) -> Plan:
        """Return a plan that starts and prolongs nothing; contents to be started wait again."""
        if not plan.is_reported:
            return replace(plan, sets=Sets())
        started = plan.sets.started
        if not started:
            return plan
        self.not_played(plan, is_known=True)
        endings = {
            number: layer for number, layer in plan.sets.layers.items() if number not in started
        }
        return replace(plan, sets=Sets(endings), is_reported=False)

    def confirm(self, sets: Sets, played: PlayedSet, *, now: float) -> None:
        """Note how the amplifiers play sets by now [s].

        Pulses start when the last amplifier starts.
        """
        for pulse in self._pulses_in(sets.started):
            if pulse.started_at is not None:
                continue
            if played.starts_at > pulse.end:
                self._count_too_late(1)
            pulse.started_at = played.starts_at
            self._intent_due = min(self._intent_due, pulse.end)
        self.slots.confirm(sets, played, now)

    def refused(self, plan: Plan, refusal: CommandRefused, *, now: float) -> Plan:
        """Return silence in place of a plan that amplifiers refused although the ledgers admit it.

        The contents are planned again when the refusal ends, or after RETRY if that is unknown.
        """
        if not plan.is_reported and self.slots.by_layer:
            self.slots.not_renewed(plan.sets, refusal)
            return replace(plan, sets=Sets())
        is_by_limit = refusal.until is None or refusal.until > now
        if is_by_limit:  # otherwise the wire is too slow or busy, and a pulse is too late
            self._unstarted_pulses.clear()
        retry_at = now + RETRY if refusal.until is None else refusal.until
        self._retry_at = max(retry_at, now + HEARTBEAT)
        self._refused_changes = plan.answered
        silence = self.slots.silence(FADE_RAMP, now)
        return replace(plan, sets=replace(silence, reason=str(refusal)), is_reported=True)

    def plan(self, now: float) -> Plan | None:
        """Plan at a time [s], for the contacts as of `expire`; None if nothing changes."""
        self._drop_ended_pulses(now)
        contacts = self._tracker.contacts
        last_plan = self._last_plan
        former_slots = self.slots.by_layer
        try:
            self._count_clocks_if_due(now)
            if last_plan is not None and not self._is_due(now):
                return self._prolonged(last_plan, now)
            selected = self._select(contacts, now)
            if last_plan is not None and self._is_planned(selected, now):
                self._take_answered_changes(())
                return self._prolonged(last_plan, now)
            self._wait_again_after_refusal(contacts)
            selection, sets = self._playback_of(selected, now)
        except Exception as error:
            return self._plan_silence(error, contacts, former_slots, now)
        self._last_selection = selected
        if sets is None:  # no content
            self._retry_at = math.inf
            is_awaited = selected.is_pending and not self.slots.may_play
            if is_awaited:
                plan = self._adopt(contacts, selection, Sets(), former_slots, now)
                return self._prolonged(plan, now)
            sets = self._end(contacts, now)
            return self._adopt(contacts, selection, sets, former_slots, now)
        self._retry_at = sets.retry_at
        plan = self._adopt(contacts, selection, sets, former_slots, now)
        changes_nothing = not sets and _is_felt_alike(plan, last_plan)
        return self._prolonged(plan, now) if changes_nothing else plan

    def _plan_silence(
        self,
        error: Exception,
        contacts: tuple[Contact, ...],
        former_slots: Mapping[int, Slot],
        now: float,
    ) -> Plan | None:
        """Plan silence after a failure; None if the last plan is silence for the same reason."""
        self._selector.due = math.inf
        self._retry_at = now + HEARTBEAT
        failure = Selection((), contacts, reason=failure_text(error))
        if self._last_plan is not None and failure == self._last_selection:
            return None
        _logger.error("loop: plan failed, silencing all channels", exc_info=error)
        self._last_selection = failure
        sets = self._end(contacts, now, has_failed=True)
        return self._adopt(contacts, failure, sets, former_slots, now)

    def _adopt(
        self,
        contacts: tuple[Contact, ...],
        selection: Selection,
        sets: Sets,
        former_slots: Mapping[int, Slot],
        now: float,
    ) -> Plan:
        """Return the plan for a selection and its sets, and keep it as the last plan."""
        for pulse in self._pulses_in(sets.started):
            self._unstarted_pulses[id(pulse)] = pulse
        answered = self._take_answered_changes(sets.started)
        plan = Plan(contacts, selection, now, answered, sets, former_slots=former_slots)
        self._last_plan = plan
        return plan

    def _is_planned(self, selected: Selection, now: float) -> bool:
        """Whether the last plan is for the same selection and no refused set is due again."""
        return selected == self._last_selection and now < self._retry_at

    def _drop_ended_pulses(self, now: float) -> None:
        """Count pulses that ended before the amplifiers started them."""
        for number, pulse in [*self._unstarted_pulses.items()]:
            if pulse.started_at is not None:
                del self._unstarted_pulses[number]
            elif now >= pulse.end:
                del self._unstarted_pulses[number]
                self._count_too_late(1)

    def _count_clocks_if_due(self, now: float) -> None:
        """Count the clocks; while fingers wait for a plan, at most every other heartbeat."""
        if now >= self._clocks_due or not self._tracker.changed:
            self._clocks_due = now + _CLOCKS_INTERVAL
            self._count_clocks()

    def _is_due(self, now: float) -> bool:
        """Whether fingers have changed, or the time for a new plan [s] has come."""
        return bool(self._tracker.changed) or now >= self.due

    def _select(self, contacts: tuple[Contact, ...], now: float) -> Selection:
        """Return the selection for contacts by the present intent, with its strengths."""
        self._planned_contacts = contacts
        self._intent_due = math.inf
        fingers = tuple([contact for contact in contacts if not contact.why_load_alone])
        intent = self._intent_source.intent(fingers, now)
        self._intent_due = intent.due(now)
        selection = self._selector.select(contacts, intent, self.capabilities, now=now)
        return selection.weakened(intent.gains_db)

    def _wait_again_after_refusal(self, contacts: Sequence[Contact]) -> None:
        """Let fingers wait again whose plan was refused, unless they have lifted."""
        if not self._refused_changes:
            return
        contact_keys = {contact.key for contact in contacts}
        changes: ChangeTimes = {
            key: changed_at
            for key, changed_at in self._refused_changes.items()
            if key in contact_keys
        }
        self._tracker.wait_again(changes)
        self._refused_changes = {}

    def _playback_of(self, selected: Selection, now: float) -> tuple[Selection, Sets | None]:
        """Return the playable part of a selection, and its sets; None if it has no contents."""
        playable = self._playable(selected)
        if not playable.contents:
            return playable, None
        sets = self.slots.plan(playable.contents, now)
        if sets.skipped:
            playable = playable.without(sets.skipped, sets.reason)
        return playable, sets

    def _prolonged(self, plan: Plan, now: float) -> Plan | None:
        """Return a due change while a plan continues: contents have ended, or must be prolonged."""
        if now < self.slots.due:
            return None
        ended_contents = self.slots.ended(now)
        if ended_contents:
            selection = plan.selection.without(ended_contents, ENDED)
            self._last_plan = replace(
                plan, selection=selection, sets=Sets(), made_at=now, answered={}
            )
            return self._last_plan
        renewal = self.slots.renewal(now)
        return replace(plan, sets=renewal, is_reported=False) if renewal else None

    def _playable(self, selection: Selection) -> Selection:
        """Return a selection without contents that have ended by themselves or have no layer."""
        ended_contents = self.slots.over_of(selection.contents)
        if ended_contents:
            selection = selection.without(ended_contents, ENDED)
        layer_count = self.capabilities.layers
        if len(selection.contents) <= layer_count:
            return selection
        # All voices of a content have a layer, or none has.
        numbered = [*self.slots.numbered(selection.contents).values()]
        lacking = [content.targets for content in selection.contents if content not in numbered]
        skipped = [content for content in selection.contents if content.targets in lacking]
        return selection.without(skipped, no_layer_free(layer_count))

    def _end(self, contacts: tuple[Contact, ...], now: float, *, has_failed: bool = False) -> Sets:
        """Return the sets that end all contents; along their endings if fingers remain."""
        if not contacts:
            return self.slots.silence(RELEASE_RAMP, now)
        if has_failed or not self.slots.have_settled(now):
            return self.slots.silence(FADE_RAMP, now)
        return self.slots.plan((), now)

    def _take_answered_changes(self, started: Collection[int]) -> dict[ContactKey | None, float]:
        """Return the changes of fingers that a plan with starting layers responds to.

        These changes no longer wait. While contents are being chosen in the thread, the plan
        responds only to lifts and to fingers whose pulses start. A lasting content that starts
        comes from the previous choice, and responds to the changes that waited for that choice.
        """
        changes = self._tracker.changed
        choice = self._selector.pending
        waiting_changes = self._waiting_changes
        if choice is None:
            answered = {**changes, **waiting_changes}
            changes.clear()
            self._last_choice = None
            self._waiting_changes = {}
            return answered
        contents = [self.slots.by_layer[number].content for number in started]
        answered_keys: set[ContactKey | None] = {None, *_contact_keys_of_pulses(contents)}
        answered = {
            key: at for key, at in {**changes, **waiting_changes}.items() if key in answered_keys
        }
        if choice is self._last_choice:
            changes.pop(None, None)
            return answered
        new_changes = {key: at for key, at in changes.items() if key not in answered_keys}
        changes.clear()
        has_lasting_start = any(not content.target.is_short for content in contents)
        if has_lasting_start:
            answered |= waiting_changes
        else:
            new_changes |= waiting_changes
        self._last_choice = choice
        self._waiting_changes = new_changes
        return answered

    def _pulses_in(self, numbers: Iterable[int]) -> list[Pulse]:
        """Return the pulses that play in layers."""
        contents = [self.slots.by_layer[number].content for number in numbers]
        return [pulse for content in contents for pulse in content.pulses]


def _is_felt_alike(plan: Plan, last_plan: Plan | None) -> bool:
    """Whether the sensations of two plans are equal."""
    last_sensations = () if last_plan is None else last_plan.selection.finger_sensations
    return plan.selection.finger_sensations == last_sensations


def _contact_keys_of_pulses(contents: Iterable[Content]) -> set[ContactKey]:
    """Return the contacts that feel the short pulses among contents."""
    keys = set[ContactKey]()
    for content in contents:
        if content.target.is_short:
            keys.update(content.contact_keys)
    return keys


@dataclass(frozen=True)
class PlayReport:
    """The contents that amplifiers play since their last confirmed set, or why they are silent."""

    contacts: tuple[Contact, ...]
    """All contacts, in order of arrival."""
    targets: tuple[FingerSensation, ...]
    """The sensation of each contact with a target; without a content it has the reason."""
    latency: float | None
    """Time [s] from the touch frame to the last byte of the command; None if none was needed."""
    time: float
    """When [s] that byte was sent, or the report made."""
    is_touch: bool = False
    """As in the plan."""
    reason: str = ""
    """Why all channels are silent."""
    contents: Mapping[int, Slot] = field(default_factory=dict)
    """Copies of the slots as they are played, by layer, the newest one last; empty in silence."""
    quiet: tuple[Contact, ...] = ()
    """Contacts without a target, which are kept quiet."""
    quiet_levels: Mapping[ContactKey, Sequence[float]] = field(default_factory=dict)
    """Foreign levels at quiet contacts (`Selection.foreign_levels`), by the rig's set first."""
    settled_after: float = 0.0
    """Time [s] until the last fade or envelope has ended."""

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
    def felt(self) -> FingerSensation | None:
        """The sensation of the newest content's finger; None without a content."""
        for slot in reversed([*self.contents.values()]):
            if slot.content.sensations:  # not a side band
                return slot.content.finger_sensations[0]
        return None


def play_report(
    plan: Plan, playing: Mapping[int, Slot], *, sent_at: float | None, now: float
) -> PlayReport:
    """Report the contents that play after a plan.

    playing: slots by layer; sent_at [s]: when the sets start, None if there are no sets.
    """
    latency = None if sent_at is None else sent_at - plan.since
    is_silent = plan.sets.silence is not None or not plan.selection.contents
    if is_silent:
        reason = plan.sets.reason or plan.selection.reason or ""
        return PlayReport(
            plan.contacts,
            _silent_targets(plan.selection, reason),
            latency=latency,
            time=now,
            is_touch=plan.is_touch,
            reason=reason,
        )
    selection = plan.selection
    numbers = [number for number, slot in playing.items() if slot.content in selection.contents]
    numbers.sort(key=plan.sets.started.__contains__)
    return PlayReport(
        plan.contacts,
        selection.finger_sensations,
        latency=latency,
        time=now if sent_at is None else sent_at,
        is_touch=plan.is_touch,
        contents={number: replace(playing[number]) for number in numbers},
        quiet=selection.quiet,
        quiet_levels={
            contact.key: selection.foreign_levels.get(contact.key, ())
            for contact in selection.quiet
        },
        settled_after=plan.sets.settled_after,
    )


def _silent_targets(selection: Selection, reason: str) -> tuple[FingerSensation, ...]:
    """Return the targets of a selection that is not played, with their own reasons or this one."""
    unserved = {finger.contact.key: finger for finger in selection.unserved}
    contacts = dict.fromkeys([finger.contact for finger in selection.targets])
    return tuple([unserved.get(contact.key) or not_served(contact, reason) for contact in contacts])


@dataclass(frozen=True)
class Observers:
    """Callbacks of the control loop by event, called within it in order; they must not wait.

    Their exceptions are only logged.
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
        self._plan: Plan | None = None  # being sent to the amplifiers
        self._wake = asyncio.Event()
        self._heartbeat_due = 0.0
        self._is_newly_armed = False  # until the next turn, which sends all contents again
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
        if self._is_newly_armed:  # not during a turn, whose set may be on the wire
            self._is_newly_armed = False
            planner.forget()
        plan = planner.plan(now)
        try:
            async with self.sending:
                with suppress(LinkDegraded):  # the next plan starts afresh; feed the others
                    if plan is not None and self.group.is_armed:
                        await self._send(planner, plan)
                # Not after a set that was given up: the next cycle silences it first.
                if self._is_heartbeat_due(planner):
                    await self._beat()
        except (Preempted, LinkDegraded):
            pass  # the playback is unknown; the next plan starts afresh
        except LinkError as error:
            _report(self.observers.link_lost, str(error))
        except DriverError as error:
            _report(self.observers.refused, str(error))

    async def _beat(self) -> None:
        """Feed the watchdogs, and note when that is due next."""
        # Counted from the request: the watchdog has run since that was sent.
        due = threads.now() + HEARTBEAT
        self._heartbeat_due = due
        try:
            await self.group.beat()
        finally:
            if self._heartbeat_due == due:  # not hastened meanwhile (`feed_at_once`)
                pause = HEARTBEAT / 2  # for a slow wire
                self._heartbeat_due = max(due, threads.now() + pause)

    async def _send(self, planner: Planner, plan: Plan) -> None:
        """Send the changes of a plan, and report the outcome; raises DriverError.

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
        if plan.sets.reason:
            _report(self.observers.refused, plan.sets.reason)
        if not plan.is_reported:
            return
        sent_at = outcome if isinstance(outcome, float) else None
        report = play_report(plan, planner.slots.by_layer, sent_at=sent_at, now=threads.now())
        _report(self.observers.reported, report)

    async def _play(self, planner: Planner, plan: Plan) -> float | CommandRefused | None:
        """Play the sets of a plan on all amplifiers, from one moment on.

        Returns when [s] they start, None if nothing is sent, or the refusal. After an exception it
        is unknown which contents play.
        """
        sets = plan.sets
        if not sets:
            return None

        def is_overtaken_by_touch() -> bool:
            return self._wake.is_set() and threads.now() < sets.preempted_until

        try:
            if sets.silence is not None:
                sent_at = await self.group.silence(sets.silence)
                planner.slots.may_play = frozenset()
                return sent_at
            if self.group.sets.is_in_doubt:
                await self.group.silence(RELEASE_RAMP)  # before the next pattern
            is_preempted = is_overtaken_by_touch if sets.endings else None
            played = await self.group.apply(sets.by_amplifier, is_preempted)
        except Overtaken:  # the endings follow the sets of the next plan
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
        """Begin the next cycle immediately."""
        self._wake.set()

    def feed_at_once(self) -> None:
        """Begin the next cycle immediately, and feed the watchdogs in it."""
        self._heartbeat_due = threads.now()
        self._wake.set()

    def note_armed(self, limits: Limits, *, was_armed: bool) -> None:
        """Note that the amplifiers have been armed.

        The next cycle sends all contents and feeds the watchdogs. limits: present limits of the
        amplifiers; was_armed: whether they were armed before, so that contents continue. Raises
        CommandError without a planner.
        """
        if self.planner is None:
            raise CommandError("controller must be open; call open() first")
        self._is_newly_armed = True
        if not was_armed:
            self.planner.slots.may_play = frozenset()
        self.planner.replace_limits(limits)
        self._schedule_expiry()  # fingers may have rested since before
        self.feed_at_once()

    def deliver(self, frame: TouchFrame) -> None:
        """Process a touch frame; call it in the loop's thread."""
        # No plan includes the contacts that came since the last cycle.
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
        """Query the intent source again, because its intent has changed without a touch."""
        if self.planner is not None:
            self.planner.look_again()
        self._wake.set()

    def _is_heartbeat_due(self, planner: Planner) -> bool:
        """Whether to feed the watchdogs now; pending silence has priority."""
        if not self.group.is_armed or planner.is_silence_pending:
            return False
        return threads.now() >= min(self._heartbeat_due, self.group.members.lost_from)

    def _follow(self, change: Change) -> None:
        """Act on a change of contacts, also while the loop waits for amplifiers."""
        planner = self.planner
        self._wake.set()
        if change.up and planner is not None:  # else the amplifiers were never open
            planner.note_lifts(change.up)
            if planner.is_silence_pending:
                self.group.abort_exchange()
        _report(self.observers.contacts_changed, self.tracker.contacts, change)

    def _schedule_expiry(self) -> None:
        """Check for expired sources when the next one times out.

        An earlier timer is kept, so that not every frame of a source sets a new one.
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
        change = self.tracker.expire(now)
        if change.up:
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
            if self.planner is not None and now < self.planner.slots.ending_due:
                until = min(until, self.planner.slots.ending_due)
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
