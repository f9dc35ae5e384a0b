"""Slots: plan what each layer plays, and note what the amplifiers confirm.

Planning (`plan`, `silence`, `endings`, `renewals`) returns sets and changes nothing. `adopt` takes
planned sets as the playback before they are sent, and `confirm` notes that the amplifiers have
committed them. The ledgers are queried in planning: contents that they refuse are planned along
plain ramps, then without the newest content; if no content is left, nothing plays.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from controller.play.intent import FADED_AFTER
from controller.play.layer_sets import SetBuilder, Sets
from controller.play.layers import LayerAllocation, Slot, SlotPhase, settling_time
from controller.play.routing import (
    HELD,
    PlateLayer,
    full_drive,
    tones_by_era,
)
from controller.play.selected_contents import Content
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import ContactKey
from drivers.errors import CommandRefused
from drivers.host.joint_sets import PlayedSet
from drivers.host.set_admission import StagedSet
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import is_vibrating
from model.answer import answer
from model.answer.answer_report import Timing
from model.rig.rig import Rig

# With no finger left on the plate the end may be short: zero within 20 ms of the lift.
RELEASE_RAMP = 0.010

RETRY = 1.0
"""Time [s] after which a set that was refused for an unknown time is planned again."""

_VALID_FOR = QUANTITIES["valid_for"]

Check = Callable[[Mapping[str, StagedSet]], CommandRefused | None]
"""Returns why the ledgers would refuse layers (by amplifier) now; None if they would admit them."""

_logger = logging.getLogger(__name__)


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
        check: Check = lambda sets: None,
        expiry_of: Callable[[ContactKey], float],
    ) -> None:
        self._rig = rig
        self.check = check
        self.layers = LayerAllocation(capabilities.layers)
        """The slots by layer, and the layers that may play."""
        self.is_silence_planned = False
        """Whether silence of all layers was the last plan to be adopted."""
        self._make_builder = partial(SetBuilder, rig, timing=timing, expiry_of=expiry_of)
        self._builder = self._make_builder(capabilities)
        self._fades_until = -math.inf  # s; for contents that were ended or replaced
        self._ended_contents: Sequence[Content] = ()  # by themselves

    def replace_capabilities(self, capabilities: PlaybackCapabilities) -> None:
        """Use other capabilities of the amplifiers from the next plan on."""
        self.layers.limit_to(capabilities.layers)
        self._builder = self._make_builder(capabilities)

    @property
    def by_layer(self) -> Mapping[int, Slot]:
        """The slots by layer; empty while the playback is unknown."""
        return self.layers.slots

    @property
    def due(self) -> float:
        """When [s] the next event of a slot is due."""
        return min([slot.due for slot in self.by_layer.values()], default=math.inf)

    def next_update_after(self, now: float) -> float:
        """Return when [s] the next ending, piece of a course or fall is due; infinite for never.

        An update that is overdue at a time [s] could not be sent in this cycle, such as a piece
        whose fingers are no longer confirmed. The loop does not wake for it, but tries it again in
        its next cycle.
        """
        update_due = min([slot.update_due for slot in self.by_layer.values()], default=math.inf)
        return update_due if update_due > now else math.inf

    def plan(self, contents: Sequence[Content], now: float) -> Sets:
        """Return the sets that let layers play only these contents from a time [s] on.

        Contents that play already do not change. If the ledgers refuse the sets, the contents are
        played along plain ramps; if they refuse these, too, without the newest content.
        """
        remaining = [*contents]
        skipped = list[Content]()
        reason = ""
        retry_at = math.inf
        sets, refusal = self._shaped_or_plain(remaining, now)
        while refusal is not None:
            reason = str(refusal)
            retry_at = self._retry_at(refusal, sets, contents, now)
            newest = max([sets.slots[number] for number in sets.started], key=_requested_at)
            for content in [*remaining]:
                if content.targets == newest.content.targets:  # a voice of the newest content
                    skipped.append(content)
                    remaining.remove(content)
            sets, refusal = self._shaped_or_plain(remaining, now)
        if not skipped:
            return sets
        return replace(sets, skipped=skipped, reason=reason, retry_at=retry_at)

    def _shaped_or_plain(
        self, contents: Sequence[Content], now: float
    ) -> tuple[Sets, CommandRefused | None]:
        """Return sets that the ledgers admit, with envelopes or along ramps, or the last refusal.

        Sets that only end contents are not checked.
        """
        for is_shaped in (True, False):
            sets = self._sets(contents, now, is_shaped=is_shaped)
            if not sets.started:
                return sets, None
            refusal = self.refusal_of(sets)
            if refusal is None:
                break
            form = "shaped" if is_shaped else "plain"
            _logger.info("loop: ledger refused %s contents: %s", form, refusal)
        return sets, refusal

    def refusal_of(self, sets: Sets) -> CommandRefused | None:
        """Return why the ledgers would refuse sets now; None if they would admit them."""
        return self.check(sets.by_amplifier)

    def _sets(self, contents: Sequence[Content], now: float, *, is_shaped: bool) -> Sets:
        """Return the sets for these contents, with the slots of all layers then."""
        allocated = self.layers.allocate(contents)
        slots = dict[int, Slot]()
        for number, slot in self.by_layer.items():
            content = allocated.get(number)
            if content is not None and slot.content == content:
                slots[number] = replace(slot, content=content)  # with the present sensations
        # Side bands can start while their carrier plays: phases count on one clock.
        starting = [number for number in allocated if number not in slots]
        layers = dict[int, PlateLayer]()
        settled_after = 0.0
        for number in starting:
            content = allocated[number]
            plate_layer, slot = self._builder.start(
                number,
                content,
                now,
                former=self.by_layer.get(number),
                fade=self.layers.fade_time(number, content),
                among=len(starting),
                is_shaped=is_shaped,
            )
            layers[number] = plate_layer
            slots[number] = slot
            settled_after = max(settled_after, settling_time(slot.layer))
        ramp = self._builder.end_ramp(contents)
        for number in self.layers.may_play - allocated.keys():
            ended_slot = None
            if is_shaped:
                ended_slot = self.by_layer.get(number)
                falling = self.layers.falling_slot(number, contents, now)
                if falling is not None:
                    slots[number] = falling
                    continue
            layers[number] = self._builder.end(number, ended_slot, now, ramp=ramp)
            settled_after = max(settled_after, ramp)
        return Sets(layers, slots, frozenset(starting), settled_after=settled_after)

    def _retry_at(
        self, refusal: CommandRefused, sets: Sets, contents: Sequence[Content], now: float
    ) -> float:
        """Return when [s] to plan contents again whose sets were refused.

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
        if now < self._fades_until or self._ends_contents(sets):
            ends.append(now)
        return max(ends, default=now + RETRY) + FADED_AFTER

    def _ends_contents(self, sets: Sets) -> bool:
        """Whether sets end contents, or replace contents that play."""
        has_ends = len(sets.layers) > len(sets.started)
        driven = [number for number, slot in self.by_layer.items() if slot.drive]
        return has_ends or not sets.started.isdisjoint(driven)

    def can_crossfade_to(self, contents: Sequence[Content], now: float) -> bool:
        """Whether the present contents can be cross-faded to these at a time [s].

        Each content must replace a content that plays. If its frequency differs it needs a free
        layer, and the ledgers must admit both contents together.
        """
        if not self.layers.can_crossfade_to(contents):
            return False
        sets = self._sets(contents, now, is_shaped=True)
        return self.refusal_of(sets) is None

    def silence(self, ramp: float) -> Sets:
        """Return the sets that silence all layers along a ramp [s]; empty if that is planned."""
        if self.is_silence_planned:
            return Sets()
        return Sets(silence=ramp)

    def endings(self, now: float) -> Sets:
        """Return the sets with the endings, falls and pieces of courses due at a time [s].

        Endings have sets of their own, so that no touch waits for them. If a ledger refuses the
        ending of a content, the content will end along a plain ramp. The next piece of a course is
        sent while sources confirm its contacts.
        """
        layers = dict[int, PlateLayer]()
        updates = dict[int, answer.Layer]()
        first_piece_end = math.inf
        due = [number for number, slot in self.by_layer.items() if slot.update_due <= now]
        for number in due:
            slot = self.by_layer[number]
            content = slot.content
            if slot.phase is SlotPhase.FALLING:
                layers[number], updates[number] = self._builder.fall(number, slot)
            elif content.course is None:
                layers[number], updates[number] = self._builder.ending(number, slot, now)
            else:
                first_piece_end = min(first_piece_end, slot.piece_until)
                if now < self._builder.confirmed_until(content):
                    layers[number], updates[number] = self._builder.piece(
                        number, content, now, former=slot, among=len(due), is_first=False
                    )
        return Sets(layers, updates=updates, preempted_until=first_piece_end - HELD / 2)

    def renewals(self, now: float) -> Sets:
        """Return the sets that prolong contents, if due at a time [s]."""
        layers = dict[int, PlateLayer]()
        for number, slot in self.by_layer.items():
            if slot.renewal_due > now:
                continue
            plate_layer = self._builder.renewal(number, slot, now)
            if plate_layer is not None:
                layers[number] = plate_layer
        return Sets(layers)

    def have_settled(self, now: float) -> bool:
        """Whether all layers that may play have settled, so that their endings fit."""
        for number in self.layers.may_play:
            slot = self.by_layer.get(number)
            if slot is None or not slot.can_end_shaped(now):
                return False
        return len(self.layers.may_play) > 0

    def adopt(self, sets: Sets, now: float) -> None:
        """Take planned sets as the playback from a time [s] on, before they are sent."""
        if sets.silence is not None:
            self.layers.start_silence()
            self.is_silence_planned = True
            self._fades_until = now + FADED_AFTER
        elif sets.layers:
            if self._ends_contents(sets):
                self._fades_until = now + FADED_AFTER
            self.layers.take(sets.slots, sets.started)
            self.is_silence_planned = False

    def confirm(self, sets: Sets, played: PlayedSet, now: float) -> None:
        """Note how the amplifiers play sets that were committed before now [s]."""
        self.layers.confirm(sets.layers.keys())
        for number in sets.layers.keys() & self.by_layer.keys():
            slot = self.by_layer[number]
            valid_for = _shortest(played, number)
            confirmed_until = self._builder.confirmed_until(slot.content)
            slot.confirm_validity(valid_for, now, confirmed_until=confirmed_until)
            update = sets.updates.get(number)
            if slot.content.course is not None:
                drive = full_drive(slot.content.layer.excitation, self._rig)
                piece = update or slot.layer
                slot.confirm_piece(piece, drive, now, starts_at=played.starts_at)
            elif number in sets.started:
                drive = tones_by_era(played.layers, self._rig, number)
                slot.confirm_start(drive, now, valid_for=valid_for)
            elif update is not None:
                slot.confirm_update(update)

    def put_off(self, sets: Sets, refusal: CommandRefused) -> None:
        """Note that layers are not prolonged; after a final refusal they end."""
        until = math.inf if refusal.until is None else refusal.until
        for number in sets.layers:
            self.by_layer[number].put_off(until, is_update=number in sets.updates)

    def forget(self, *, except_for: Mapping[int, Slot]) -> None:
        """Discard the playback, except for known slots by layer; fingers keep their layers."""
        self.layers.reset(except_for)
        self.is_silence_planned = False
        self._ended_contents = ()

    def end_expired(self, now: float) -> Sequence[Content]:
        """Note the contents that have ended by themselves by a time [s]; return them once.

        A course continues if its next piece is due, because the host was late.
        """
        newly_ended = list[Content]()
        for number, slot in [*self.by_layer.items()]:
            if now < slot.ends_at or self._has_piece_due(slot, now):
                continue
            if slot.phase is SlotPhase.FALLING:
                self.layers.end(number)
            else:
                slot.end()
                newly_ended.append(slot.content)
        self._ended_contents = (*self._ended_contents, *newly_ended)
        return newly_ended

    def _has_piece_due(self, slot: Slot, now: float) -> bool:
        """Whether the next piece of a slot's course is due, and its contacts are confirmed."""
        return slot.piece_due <= now < self._builder.confirmed_until(slot.content)

    def ended_among(self, contents: Sequence[Content]) -> Sequence[Content]:
        """Return the contents that have ended by themselves, with any strength."""
        return [
            content
            for content in contents
            if any(_is_same(content, ended) for ended in self._ended_contents)
        ]

    def keep_ended(self, contents: Sequence[Content]) -> None:
        """Forget which contents have ended by themselves, except these."""
        self._ended_contents = self.ended_among(contents)


def _is_same(content: Content, other: Content) -> bool:
    """Whether contents are equal, apart from their strength."""
    are_fingers_same = content.key == other.key and content.targets == other.targets
    return are_fingers_same and content.placement == other.placement


def _requested_at(slot: Slot) -> float:
    """Return when [s] the pulse of a content was requested, or its contact came."""
    content = slot.content
    if content.target.pulse is None:
        return content.contact.since
    return content.target.pulse.requested_at


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
