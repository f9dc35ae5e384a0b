"""Reports of the control loop about the playback after a plan, and the observers of the loop."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from controller.play.intent import FingerSensation, Selection, not_served
from controller.play.planner import Plan
from controller.play.routing import Drive
from controller.play.slot import Slot
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
    """Copies of the slots as they are played, by layer, the newest one last; empty in silence."""
    quiet: tuple[Contact, ...] = ()
    """Contacts without a target, which are kept quiet."""
    quiet_levels: Mapping[ContactKey, Sequence[float]] = field(default_factory=dict)
    """Foreign levels at quiet contacts by threshold set (`Selection.foreign_levels`)."""
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
    # The slots that the plan started come last.
    numbers = sorted(playing, key=lambda number: number in plan.sets.started)
    contents = {
        number: replace(playing[number])
        for number in numbers
        if playing[number].content in selection.contents
    }
    quiet_levels = {
        contact.key: selection.foreign_levels.get(contact.key, ()) for contact in selection.quiet
    }
    return PlayReport(
        plan.contacts,
        selection.finger_sensations,
        latency=latency,
        time=now if sent_at is None else sent_at,
        is_touch=plan.is_touch,
        contents=contents,
        quiet=selection.quiet,
        quiet_levels=quiet_levels,
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
