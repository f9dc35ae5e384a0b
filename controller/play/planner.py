"""Planner: from the contacts on a plate to the layers that change, on every amplifier.

plan(now):  contacts -> intent -> selection of contents -> sets of layers

The planner never waits. `controller.play.loop` sends its plans, and reports to the planner whether
the amplifiers play them.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from functools import partial

from controller.play.chooser import Chooser
from controller.play.counted_clocks import CountedClocks
from controller.play.intent import IntentSource, Pulse
from controller.play.layer_sets import Sets
from controller.play.layers import Slot
from controller.play.selected_contents import Content, Selection, no_layer_free
from controller.play.selection import Selector
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.play.slots import RELEASE_RAMP, RETRY, Check, Slots
from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Contact, ContactKey
from drivers.errors import CommandRefused
from drivers.host.joint_sets import PlayedSet
from drivers.protocol.definition import HEARTBEAT
from model.answer.answer_report import Timing
from model.answer.envelope import FADE_RAMP
from model.answer.plan import prepare_answers, query
from model.answer.stimulus import MIN_LEVEL_DB_SL, Placement
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry.plugins import failure_text

ENDED = (
    "the vibration has ended: it was not renewed, or a time limit was reached; touch there again"
)

_NO_SLOTS: Mapping[int, Slot] = {}

_CLOCKS_INTERVAL = 2 * HEARTBEAT  # s; longest time without counting clocks while fingers change

ChangeTimes = Mapping[ContactKey | None, float]
"""When [s] fingers changed, by contact; the key None is for the first finger that lifted."""

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

    @property
    def surviving_slots(self) -> dict[int, Slot]:
        """Slots that surely still play if its sets are not played, by layer.

        Layers that it ends may be silent or not; the next plan ends these again.
        """
        ended_layers = self.sets.layers.keys() - self.sets.started
        slots = {**self.former_slots}
        for number in ended_layers:
            slots.pop(number, None)
        return slots


class Planner:
    """Plans the vibrations for the contacts on one plate; synchronous, times are arguments.

    check: queries the ledgers; arrived: called when contents have been chosen in the thread; it
    calls `look_again` and plans; too_late: called with the number of clicks that came too late to
    be felt; clock_errors: returns the clock errors of the amplifiers by name, rms [s].
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
        self._timing = timing
        self.slots = Slots(rig, capabilities, timing, check=check, expiry_of=tracker.expiry_of)
        """The contents of all layers."""
        self.clocks = CountedClocks(rig, clock_errors)
        """Clock errors of the amplifiers, as the table includes them."""
        self._selector = Selector(
            self._chooser_of(table), arrived=arrived, can_crossfade=self.slots.can_crossfade_to
        )
        self._intent_due = math.inf  # s; when the intent may change without a touch
        self._retry_at = math.inf  # s; when a ledger may admit a refused set
        self._clocks_due = -math.inf  # s; when clocks are counted even if fingers have changed
        self._last_plan: Plan | None = None  # None if it is unknown which contents play
        self._last_selection: Selection | None = None  # including contents that limits left out
        self._planned_contacts: Sequence[Contact] = ()
        self._unstarted_pulses: dict[int, Pulse] = {}  # planned, but not started; by identity

    @property
    def due(self) -> float:
        """When [s] to plan next even if nothing arrives.

        The intent expires then, a ledger may admit a refused set, or a finger that moved rests.
        """
        return min(self._intent_due, self._retry_at, self._selector.due)

    @property
    def selection(self) -> Selection | None:
        """The contents of the last plan; None if it is unknown which contents play."""
        return None if self._last_plan is None else self._last_plan.selection

    @property
    def is_waiting(self) -> bool:
        """Whether a change of fingers is not planned yet, or contents are being chosen."""
        return bool(self._tracker.changed) or self._selector.pending is not None

    @property
    def is_silence_pending(self) -> bool:
        """Whether the last contact has lifted and silence has not been planned yet."""
        return not self._tracker.contacts and not self.slots.is_silence_planned

    def plan(self, now: float) -> Plan | None:
        """Plan at a time [s], after expired contacts were lifted; None if nothing changes.

        Any exception becomes a plan of silence.
        """
        try:
            return self._next_plan(now)
        except Exception as error:
            return self._plan_silence(error, now)

    def _next_plan(self, now: float) -> Plan | None:
        """Plan the contents for the present contacts and intent; None if nothing changes."""
        self._drop_ended_pulses(now)
        self._count_clocks_if_due(now)
        last_plan = self._last_plan
        if last_plan is not None and not self._is_due(now):
            return self._prolonged(last_plan, now)
        selected = self._select(now)
        if last_plan is not None and self._is_planned(selected, now):
            self._take_changes((), now)
            return self._prolonged(last_plan, now)
        self.slots.keep_ended(selected.contents)
        playable = self._playable(selected)
        if not playable.contents:
            return self._plan_end(selected, playable, now)
        sets = self.slots.plan(playable.contents, now)
        if sets.skipped:
            playable = playable.without(sets.skipped, sets.reason)
        plan = self._adopt(selected, playable, sets, now)
        changes_nothing = sets.is_empty and _is_felt_alike(plan, last_plan)
        return self._prolonged(plan, now) if changes_nothing else plan

    def _plan_end(self, selected: Selection, playable: Selection, now: float) -> Plan | None:
        """Plan the end of all contents; None while the first contents are being chosen."""
        is_awaited = selected.is_pending and not self.slots.layers.may_play
        if is_awaited:
            plan = self._adopt(selected, playable, Sets(), now)
            return self._prolonged(plan, now)
        if self._tracker.contacts and self.slots.have_settled(now):
            sets = self.slots.plan((), now)
        else:
            sets = self._silence()
        return self._adopt(selected, playable, sets, now)

    def _plan_silence(self, error: Exception, now: float) -> Plan | None:
        """Plan silence after a failure; None if the last plan is silence for the same reason."""
        self._selector.wait_for_change()
        failure = Selection((), self._tracker.contacts, reason=failure_text(error))
        plan = None
        if self._last_plan is None or failure != self._last_selection:
            _logger.error("loop: plan failed, silencing all channels", exc_info=error)
            plan = self._adopt(failure, failure, self._silence(), now)
        self._retry_at = now + HEARTBEAT
        return plan

    def _silence(self) -> Sets:
        """Return the sets that silence all layers; quickly if no finger is left on the plate."""
        return self.slots.silence(FADE_RAMP if self._tracker.contacts else RELEASE_RAMP)

    def _adopt(self, selected: Selection, playable: Selection, sets: Sets, now: float) -> Plan:
        """Make a plan, and take it as the present playback.

        selected: the contents that fingers are to feel; playable: the contents that play then.
        """
        former_slots = self.slots.by_layer
        self.slots.adopt(sets, now)
        started = [sets.slots[number].content for number in sets.started]
        for content in started:
            for pulse in content.pulses:
                self._unstarted_pulses[id(pulse)] = pulse
        answered = self._take_changes(started, now)
        contacts = self._tracker.contacts
        plan = Plan(contacts, playable, now, answered, sets, former_slots=former_slots)
        self._last_plan = plan
        self._last_selection = selected
        self._retry_at = sets.retry_at
        return plan

    def _take_changes(self, started: Sequence[Content], now: float) -> ChangeTimes:
        """Return the changes that a plan responds to at a time [s]; they no longer wait.

        While contents are chosen in the thread, the plan responds to lifts and to the fingers whose
        contents start. A lasting content can start while its finger moves on; then the change that
        the thread chooses for has just come.
        """
        if self._selector.pending is None:
            return self._tracker.take_changes()
        keys: set[ContactKey | None] = {None}
        moved = dict[ContactKey | None, float]()
        for content in started:
            keys.update(content.contact_keys)
            if not content.target.is_short:
                moved |= dict.fromkeys(content.contact_keys, now)
        answered = self._tracker.take_changes(keys)
        self._tracker.wait_again(moved)
        return answered

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
            self._count_clocks(self.clocks.present_errors)

    def _is_due(self, now: float) -> bool:
        """Whether fingers have changed, or the time for a new plan [s] has come."""
        return bool(self._tracker.changed) or now >= self.due

    def _select(self, now: float) -> Selection:
        """Return the selection for the contacts by the present intent, with its strengths."""
        contacts = self._tracker.contacts
        self._planned_contacts = contacts
        self._intent_due = math.inf
        fingers = tuple([contact for contact in contacts if not contact.why_load_alone])
        intent = self._intent_source.intent(fingers, now)
        self._intent_due = intent.due(now)
        selection = self._selector.select(contacts, intent, self.capabilities, now=now)
        return selection.weakened(intent.gains_db)

    def _prolonged(self, plan: Plan, now: float) -> Plan | None:
        """Return a due change while a plan continues: contents have ended, or must be prolonged."""
        if now < self.slots.due:
            return None
        ended_contents = self.slots.end_expired(now)
        if ended_contents:
            selection = plan.selection.without(ended_contents, ENDED)
            self._last_plan = replace(
                plan, selection=selection, sets=Sets(), made_at=now, answered={}
            )
            return self._last_plan
        for prolonging in (self.slots.endings, self.slots.renewals):
            sets = prolonging(now)
            if sets.is_empty:
                continue
            refusal = self.slots.refusal_of(sets)
            if refusal is None:
                return replace(plan, sets=sets, kind=PlanKind.PROLONGATION)
            self.slots.put_off(sets, refusal)
        return None

    def _playable(self, selection: Selection) -> Selection:
        """Return a selection without contents that have ended by themselves or have no layer."""
        ended_contents = self.slots.ended_among(selection.contents)
        if ended_contents:
            selection = selection.without(ended_contents, ENDED)
        layer_count = self.capabilities.layers
        if len(selection.contents) <= layer_count:
            return selection
        # All voices of a content have a layer, or none has.
        allocated = [*self.slots.layers.allocate(selection.contents).values()]
        lacking = [content.targets for content in selection.contents if content not in allocated]
        skipped = [content for content in selection.contents if content.targets in lacking]
        return selection.without(skipped, no_layer_free(layer_count))

    def count_unplanned_lifts(self, lifted: Sequence[Contact]) -> None:
        """Count the lifted contacts that no plan included although they had an effect."""
        planned_keys = {contact.key for contact in self._planned_contacts}
        count = 0
        for contact in lifted:
            is_planned = contact.key in planned_keys
            is_finger = contact.why_load_alone is None
            if not is_planned and is_finger and self._intent_source.has_effect_at(contact):
                count += 1
        if count:
            self._count_too_late(count)

    def look_again(self) -> None:
        """Note that the next plan can differ even if no contact changes."""
        self._intent_due = -math.inf

    def forget(self, *, except_for: Mapping[int, Slot] = _NO_SLOTS) -> None:
        """Discard the playback, except for known slots by layer.

        The next plan has a set, and fingers keep their layers.
        """
        self._last_plan = None
        self._retry_at = math.inf
        self.slots.forget(except_for=except_for)

    def not_played(self, plan: Plan, *, is_known: bool) -> None:
        """Let the fingers of a plan that was not played wait for the next plan.

        is_known: whether the former contents still play; otherwise, the playback is unknown.
        """
        if not is_known:
            self.forget()
        elif plan.kind is PlanKind.CHANGE:
            self.forget(except_for=plan.surviving_slots)
        if plan.kind is PlanKind.CHANGE:
            self._tracker.wait_again(plan.answered)

    def drop_starts(self, plan: Plan) -> Plan:
        """Return a plan that only ends contents; contents that the plan starts wait again.

        Prolongations are dropped, so that their contents end by themselves.
        """
        started = plan.sets.started
        if plan.kind is PlanKind.CHANGE and not started:
            return plan
        if plan.kind is PlanKind.PROLONGATION:
            return replace(plan, sets=Sets())
        self.not_played(plan, is_known=True)
        ends = {
            number: layer for number, layer in plan.sets.layers.items() if number not in started
        }
        return replace(plan, sets=Sets(ends), kind=PlanKind.ENDS)

    def confirm(self, sets: Sets, played: PlayedSet, *, now: float) -> None:
        """Note how the amplifiers play sets, which were committed before now [s].

        Pulses start when the last amplifier starts.
        """
        for number in sets.started:
            for pulse in self.slots.by_layer[number].content.pulses:
                if pulse.started_at is not None:
                    continue
                if played.starts_at > pulse.end:
                    self._count_too_late(1)
                pulse.started_at = played.starts_at
                self._intent_due = min(self._intent_due, pulse.end)
        self.slots.confirm(sets, played, now)

    def confirm_silence(self) -> None:
        """Note that all layers are silent for certain."""
        self.slots.layers.confirm_silence()

    def replace_refused(self, plan: Plan, refusal: CommandRefused, *, now: float) -> Plan:
        """Return a plan in place of one that amplifiers refused although the ledgers admit it.

        A refused prolongation sends nothing, and its contents end. Any other refused plan becomes
        silence, and its contents are planned again when the refusal ends, or after RETRY if that is
        unknown.
        """
        if plan.kind is PlanKind.PROLONGATION:
            self.slots.put_off(plan.sets, refusal)
            return replace(plan, sets=Sets())
        is_by_limit = refusal.until is None or refusal.until > now
        if is_by_limit:  # otherwise the wire is too slow or busy, and a pulse is too late
            self._unstarted_pulses.clear()
        retry_at = now + RETRY if refusal.until is None else refusal.until
        self._retry_at = max(retry_at, now + HEARTBEAT)
        silence = self.slots.silence(FADE_RAMP)
        self.slots.adopt(silence, now)
        sets = replace(silence, reason=str(refusal))
        return replace(plan, sets=sets, kind=PlanKind.CHANGE)

    def precompute(self, clock_errors: Mapping[str, float]) -> None:
        """Compute everything that the first touch would wait for; seconds for a large rig.

        Runs in a thread, before the first plan. clock_errors: of the amplifiers by name, rms [s].
        The table without clock errors, from which statuses compute foreign levels, shares the
        results. Raises InputError for a table without a pattern for these amplifiers.
        """
        drive_mode = self.capabilities.drive_mode
        prepare_answers(self._selector.chooser.table, drive_mode)
        self._count_clocks(clock_errors)
        table = self._selector.chooser.table
        self._timing.prepare(table.frequencies.tolist())
        center = (table.plate.length / 2, table.plate.width / 2)
        placement = Placement((center,), ((0.0, 0.0),))
        band = self.capabilities.limits.frequencies
        pattern = query(table, placement, MIN_LEVEL_DB_SL, drive_mode=drive_mode, band_hz=band)
        (layer,) = pattern.layers
        support = self.capabilities.envelope_support
        self._timing.with_envelopes(
            layer, placement, onset=support.onset_knots > 0, ending=support.ending_knots > 0
        )

    def replace_capabilities(self, capabilities: PlaybackCapabilities) -> None:
        """Use other capabilities, because an amplifier was identified again."""
        if capabilities != self.capabilities:
            self.capabilities = capabilities
            self.slots.replace_capabilities(capabilities)
            self._use(self._chooser_of(self._selector.chooser.table))

    def _count_clocks(self, errors: Mapping[str, float]) -> None:
        """Update the table to clock errors, rms [s]; contents continue until all fingers rest.

        If a clock is no longer held, contents are chosen again immediately.
        """
        chooser = self._selector.chooser
        is_clock_lost = self.clocks.is_one_lost(errors)
        table = self.clocks.counted_by(chooser.table, errors)
        if table is not chooser.table:
            self._use(replace(chooser, table=table), immediately=is_clock_lost)

    def _chooser_of(self, table: LocalizationTable) -> Chooser:
        """Make a chooser with a table, whose envelopes follow the timing in use."""
        shape = partial(self.capabilities.envelope_support.shape, self._timing)
        return Chooser(table, shape)

    def _use(self, chooser: Chooser, *, immediately: bool = False) -> None:
        """Use another chooser: immediately, if nothing plays or so requested, or once all rest."""
        selector = self._selector
        selector.chooser = chooser
        is_idle = not self.slots.layers.may_play and selector.pending is None
        if immediately or is_idle:
            selector.choose_again()
        self.look_again()


def _is_felt_alike(plan: Plan, last_plan: Plan | None) -> bool:
    """Whether the sensations of two plans are equal."""
    last_sensations = () if last_plan is None else last_plan.selection.finger_sensations
    return plan.selection.finger_sensations == last_sensations
