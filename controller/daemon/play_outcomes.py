"""Outcomes of the effects that clients request: when they start and at which level, or why not."""

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Literal, cast

from controller.api.methods import OtherFinger, PlayResult
from controller.daemon.plate_view import PlateView, finite
from controller.effects.player import EffectPlayer, Play
from controller.operation.operation_states import DaemonState
from controller.operation.supervisor import Supervisor
from controller.play.intent import Target
from controller.play.planner import Planner
from controller.play.selected_contents import Content, FingerSensation, Selection
from controller.sources.touch import Contact
from model.answer.answer import HELD_BACK
from registry import threads

_TIMEOUT = 2.0  # s; a choice of contents is given up after 1 s

_LATE = (
    "it was not ready in time: the choice of a vibration or the replies of amplifiers took too "
    "long; play it again"
)
_ENDED = "its finger was lifted, or the same effect was played there again"


class PlayOutcomes:
    """Finds the outcome of requested plays after every cycle of the control loop."""

    def __init__(self, supervisor: Supervisor, player: EffectPlayer, view: PlateView) -> None:
        self._supervisor = supervisor
        self._cycle = supervisor.controller.cycle
        self._player = player
        self._view = view
        self._changed = asyncio.Event()  # a cycle was completed, or the daemon's state changed
        self._cycle.observers.cycle_completed.append(self._changed.set)
        supervisor.current.observers.append(lambda old, new: self._changed.set())

    async def wait_for(self, play: Play, contact: Contact) -> PlayResult:
        """Wait until a play at a contact is played or given up, at most 2 s; return its outcome."""
        targets = list[Target]()  # of all intents since the request
        with suppress(TimeoutError):
            async with asyncio.timeout(_TIMEOUT):
                while True:
                    targets += [target for target in play.targets or () if target not in targets]
                    outcome = self._outcome(play, contact, targets)
                    if outcome is not None:
                        return outcome
                    self._changed.clear()
                    await self._changed.wait()
        return _not_played("pending", self._reason_at(contact))

    def _outcome(self, play: Play, contact: Contact, targets: list[Target]) -> PlayResult | None:
        """Return the outcome of a play with these targets so far; None while it is undecided."""
        operation = self._supervisor.operation
        if operation.state is not DaemonState.OPERATION_ENABLED:
            return _not_played("held back", operation.cause)
        planner = self._cycle.planner
        selection = None if planner is None else planner.selection
        if planner is not None and selection is not None:
            decided = self._decided(planner, selection, contact, targets)
            if decided is not None:
                return decided
        now = threads.now()
        if any(_is_late(target, now) for target in targets):
            return _not_played("late", self._silence_reason or _LATE)
        if not self._player.is_active(play, contact.key):
            return _not_played("held back", _ENDED)
        if play.targets == () and not targets:  # it begins with a pause, or waits for a movement
            return _not_played("pending", play.why_paused)
        return None

    def _decided(
        self, planner: Planner, selection: Selection, contact: Contact, targets: list[Target]
    ) -> PlayResult | None:
        """Return the outcome according to the last plan; None if it does not decide."""
        for content in selection.contents:
            if not _is_requested(content, contact, targets):
                continue
            start = self._start_of(planner, content)
            if start is None:
                return None
            for felt in content.finger_sensations:
                if felt.contact.key == contact.key:
                    return _played(selection, felt, start)
        is_decided = any(
            finger.contact.key == contact.key and finger.target in targets
            for finger in selection.targets
        )
        for unserved in selection.unserved:
            if is_decided and unserved.contact.key == contact.key:
                others = _other_fingers(selection, contact)
                return _not_played("held back", unserved.held_back, others)
        return None

    def _start_of(self, planner: Planner, content: Content) -> float | None:
        """Return when [s] the amplifiers start a content; None before they have confirmed it."""
        report = self._view.report
        slots = planner.slots.by_layer.values()
        is_confirmed = any(slot.content == content and slot.drive for slot in slots)
        if not is_confirmed or report is None:
            return None
        pulse = content.target.pulse
        if pulse is None or pulse.started_at is None:
            return report.time
        return pulse.started_at

    @property
    def _silence_reason(self) -> str | None:
        """Why the amplifiers play nothing, if they or a ledger refused it."""
        report = self._view.report
        return None if report is None or report.contents else report.reason or None

    def _reason_at(self, contact: Contact) -> str | None:
        """Return the reason that the status gives for a contact."""
        for status in self._view.contact_statuses():
            if (status.source, status.id) == contact.key:
                return status.held_back
        return _ENDED


def _is_requested(content: Content, contact: Contact, targets: list[Target]) -> bool:
    """Whether a content plays one of these targets at a contact."""
    for finger in content.targets:
        if finger.contact.key != contact.key:
            continue
        if finger.target in targets:
            return True
        # A click over a continuous effect can be raised.
        pulses = [target.pulse for target in targets]
        return finger.target.is_short and any(finger.target.pulse is pulse for pulse in pulses)
    return False


def _is_late(target: Target, now: float) -> bool:
    """Whether the pulse of a target is over at a time [s] and has not started."""
    pulse = target.pulse
    return pulse is not None and pulse.started_at is None and now >= pulse.end


def _not_played(
    outcome: Literal["late", "held back", "pending"],
    reason: str | None,
    other_fingers: Sequence[OtherFinger] = (),
) -> PlayResult:
    """Return the outcome of a play that does not start, or not yet."""
    return PlayResult(
        outcome=outcome,
        reason=reason,
        promised_contrast_db=None,
        other_fingers=[*other_fingers],
    )


def _played(selection: Selection, felt: FingerSensation, start: float) -> PlayResult:
    """Return the outcome of a play whose content starts at a time [s]."""
    sensation = felt.sensation
    other_fingers = _other_fingers(selection, felt.contact)
    if sensation.verdict == HELD_BACK:
        return _not_played("held back", felt.held_back, other_fingers)
    return PlayResult(
        outcome="played",
        reason=felt.held_back,
        start_s=start,
        frequency_hz=felt.frequency,
        level_db_sl=finite(sensation.level_db_sl),
        promised_level_db_sl=finite(sensation.promised_level_db_sl),
        promised_contrast_db=finite(sensation.promised_contrast_db),
        verdict=cast(Any, sensation.verdict),
        other_fingers=other_fingers,
    )


def _other_fingers(selection: Selection, contact: Contact) -> list[OtherFinger]:
    """Describe all contacts of a selection but one, in order of arrival."""
    fingers = list[OtherFinger]()
    contacts = sorted(selection.contacts.values(), key=lambda other: other.since)
    for other in contacts:
        if other.key == contact.key:
            continue
        levels = selection.foreign_levels.get(other.key, ())
        fingers.append(
            OtherFinger(
                source=other.key.source,
                id=other.key.id,
                x_m=other.x,
                y_m=other.y,
                foreign_level_db_sl=finite(max(levels, default=None)),
                rig_foreign_level_db_sl=finite(next(iter(levels), None)),
            )
        )
    return fingers
