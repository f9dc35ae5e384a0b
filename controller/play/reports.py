"""Reports of the control loop about the playback after a plan, and the observers of the loop."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from controller.play.layers import Slot
from controller.play.planner import Plan
from controller.play.routing import Drive
from controller.play.selected_contents import FingerSensation, Selection, not_served
from controller.sources.touch import Change, Contact, ContactKey
from model.answer.answer import Layer


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
    """Whether the plan responds to a touch, not to lifts alone."""
    reason: str = ""
    """Why all channels are silent."""
    contents: Mapping[int, Slot] = field(default_factory=dict)
    """Copies of the slots as they are played, by layer; empty in silence. The slots that the plan
    started come last."""
    quiet: tuple[Contact, ...] = ()
    """Contacts without a target, which are kept quiet."""
    quiet_levels: Mapping[ContactKey, Sequence[float]] = field(default_factory=dict)
    """Foreign levels at quiet contacts by threshold set (`Selection.foreign_levels`)."""
    settled_after: float = 0.0
    """Time [s] until the last fade or envelope has ended."""

    @property
    def newest(self) -> Slot:
        """The last slot, which is a started one if the plan started any."""
        return [*self.contents.values()][-1]

    @property
    def layer(self) -> Layer:
        """The layer of the newest slot as it plays."""
        return self.newest.layer

    @property
    def drive(self) -> Drive:
        """The tones of the newest slot, by ERA, without silent ones."""
        return self.newest.drive

    @property
    def felt(self) -> FingerSensation | None:
        """The sensation of the finger that owns the newest content; None without a content."""
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
    selection = plan.selection
    latency = None if sent_at is None else sent_at - plan.since
    if plan.sets.silence is not None or not selection.contents:
        reason = plan.sets.reason or selection.reason or ""
        return PlayReport(
            plan.contacts,
            _silent_targets(selection, reason),
            latency=latency,
            time=now,
            is_touch=plan.is_touch,
            reason=reason,
        )
    quiet_levels = dict[ContactKey, Sequence[float]]()
    for contact in selection.quiet:
        quiet_levels[contact.key] = selection.foreign_levels.get(contact.key, ())
    return PlayReport(
        plan.contacts,
        selection.finger_sensations,
        latency=latency,
        time=now if sent_at is None else sent_at,
        is_touch=plan.is_touch,
        contents=_played_slots(plan, playing),
        quiet=selection.quiet,
        quiet_levels=quiet_levels,
        settled_after=plan.sets.settled_after,
    )


def _played_slots(plan: Plan, playing: Mapping[int, Slot]) -> dict[int, Slot]:
    """Return copies of the slots of a plan by layer; the slots that it started come last."""
    former_slots = dict[int, Slot]()
    started_slots = dict[int, Slot]()
    for number, slot in playing.items():
        if slot.content not in plan.selection.contents:
            continue
        slots = started_slots if number in plan.sets.started else former_slots
        slots[number] = replace(slot)
    return former_slots | started_slots


def _silent_targets(selection: Selection, reason: str) -> tuple[FingerSensation, ...]:
    """Return the targets of a selection that is not played, with their own reasons or this one."""
    targets = dict[ContactKey, FingerSensation]()
    for contact, _ in selection.targets:
        targets[contact.key] = not_served(contact, reason)
    for unserved in selection.unserved:
        if unserved.contact.key in targets:
            targets[unserved.contact.key] = unserved
    return tuple(targets.values())


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
