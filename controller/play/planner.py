"""Planner: from the contacts on a plate to the layers that change, on every amplifier.

plan(now):  contacts -> intent -> selection of contents -> sets of layers

The planner reads no clock and never waits. `controller.play.loop` sends its plans.
"""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from functools import partial

from controller.play.changes import ChangeTimes, WaitingChanges
from controller.play.chooser import Chooser
from controller.play.intent import IntentSource, Pulse, Selection, no_layer_free
from controller.play.routing import CountedClocks, PlaybackCapabilities
from controller.play.selection import Selector
from controller.play.slots import RELEASE_RAMP, RETRY, Check, Sets, Slot, Slots
from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Contact
from drivers.errors import CommandRefused
from drivers.host.joint_sets import PlayedSet
from drivers.protocol.definition import HEARTBEAT
from model.answer.answer import Limits
from model.answer.answer_report import Timing
from model.answer.plan import prepare_answers, query
from model.answer.stimulus import FADE_RAMP, MIN_LEVEL_DB_SL, Placement
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry.plugins import failure_text

ENDED = (
    "the vibration has ended: it was not renewed, or a time limit was reached; touch there again"
)

_CLOCKS_INTERVAL = 2 * HEARTBEAT  # s; longest time without counting clocks while fingers change

_logger = logging.getLogger(__name__)


class PlanKind(Enum):
    """The effect of a plan's sets on the contents that play."""

    CHANGE = auto()
    """Contents start, change or end; observers get a report."""
    ENDS = auto()
    """Contents end; the contents that the plan was to start wait for the next plan."""
    PROLONGATION = auto()
    """The same contents continue: renewals, endings, pieces of courses."""


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
    kind: PlanKind = PlanKind.CHANGE
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
        self._changes = WaitingChanges(tracker)

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

    def plan(self, now: float) -> Plan | None:
        """Plan at a time [s], after expired contacts were lifted; None if nothing changes."""
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
                self._changes.answered_by((), self._selector.pending)
                return self._prolonged(last_plan, now)
            self._changes.wait_again_after_refusal()
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
        started = [self.slots.by_layer[number].content for number in sets.started]
        answered = self._changes.answered_by(started, self._selector.pending)
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
        if not renewal:
            return None
        return replace(plan, sets=renewal, kind=PlanKind.PROLONGATION)

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

    def _pulses_in(self, numbers: Iterable[int]) -> list[Pulse]:
        """Return the pulses that play in layers."""
        contents = [self.slots.by_layer[number].content for number in numbers]
        return [pulse for content in contents for pulse in content.pulses]

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
        is_change = plan.kind is PlanKind.CHANGE
        if is_change or not is_known:
            self.forget()
        if not is_change:
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
        if plan.kind is PlanKind.PROLONGATION:
            return replace(plan, sets=Sets())
        started = plan.sets.started
        if not started:
            return plan
        self.not_played(plan, is_known=True)
        endings = {
            number: layer for number, layer in plan.sets.layers.items() if number not in started
        }
        return replace(plan, sets=Sets(endings), kind=PlanKind.ENDS)

    def confirm(self, sets: Sets, played: PlayedSet, *, now: float) -> None:
        """Note how the amplifiers play sets, which were committed before now [s].

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
        """Return a plan in place of one that amplifiers refused although the ledgers admit it.

        A refused prolongation sends nothing, and its contents end. Any other refused plan becomes
        silence, and its contents are planned again when the refusal ends, or after RETRY if that is
        unknown.
        """
        if plan.kind is PlanKind.PROLONGATION:
            self.slots.not_renewed(plan.sets, refusal)
            return replace(plan, sets=Sets())
        is_by_limit = refusal.until is None or refusal.until > now
        if is_by_limit:  # otherwise the wire is too slow or busy, and a pulse is too late
            self._unstarted_pulses.clear()
        retry_at = now + RETRY if refusal.until is None else refusal.until
        self._retry_at = max(retry_at, now + HEARTBEAT)
        self._changes.refused = plan.answered
        silence = self.slots.silence(FADE_RAMP, now)
        sets = replace(silence, reason=str(refusal))
        return replace(plan, sets=sets, kind=PlanKind.CHANGE)

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


def _is_felt_alike(plan: Plan, last_plan: Plan | None) -> bool:
    """Whether the sensations of two plans are equal."""
    last_sensations = () if last_plan is None else last_plan.selection.finger_sensations
    return plan.selection.finger_sensations == last_sensations
