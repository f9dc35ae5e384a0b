"""Reports of the control loop to a demo, a log or a dashboard."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from controller.play.content import Prediction, not_served
from controller.play.layer_content import LayerContent
from controller.play.planner import Plan
from controller.play.routing import Drive
from controller.sources.contacts import Change, Contact, ContactKey
from model.answer.answer import Layer
from model.answer.answer_report import Timing
from model.answer.stimulus import Placement


@dataclass(frozen=True)
class PlayReport:
    """The contents that amplifiers play since their last confirmed set.

    contacts: all, in order of arrival; targets: a prediction for each; quiet: quiet contacts, and
    what they feel at most (`Selection.foreign_levels`);
    contents: as they are played, by layer, the newest one last; latency [s]: from the touch frame
    to the last byte of the command on the wire, None if none was needed; time [s] of that byte, or
    of the report; from_rest: whether the plate
    was at rest; settled_after [s]: when the last fade or envelope has ended; lasts: whether all
    play until their contacts change; is_touch: as of the plan.
    """

    contacts: tuple[Contact, ...]
    targets: tuple[Prediction, ...]
    quiet: tuple[Contact, ...]
    quiet_levels: Mapping[ContactKey, Sequence[float]]
    contents: Mapping[int, LayerContent]
    latency: float | None
    time: float
    from_rest: bool
    settled_after: float
    lasts: bool
    is_touch: bool
    timing: Timing = field(repr=False, compare=False)

    @property
    def newest(self) -> LayerContent:
        """The content that changed last."""
        return [*self.contents.values()][-1]

    @property
    def layer(self) -> Layer:
        """What plays of the newest content."""
        return self.newest.layer

    @property
    def drive(self) -> Drive:
        """What the amplifiers play of the newest content, by ERA, without silent ones."""
        return self.newest.drive

    @property
    def placement(self) -> Placement:
        """Where the fingers of the newest content are, and all others."""
        return self.newest.content.placement

    @cached_property
    def transient_contrast_db(self) -> float | None:
        """Predicted contrast over the first 100 ms [dB], with the onset as it is played.

        Computed when it is first read, in about two milliseconds, so that no touch waits for it.
        None without quiet contacts, within 0.4 s of another pattern, whose ringing it does not
        include, or beside other contents.
        """
        is_alone = self.from_rest and len(self.contents) == 1
        if not (is_alone and self.quiet):
            return None
        return self.timing.transient_contrast_db(self.layer, self.placement)

    @property
    def felt(self) -> Prediction | None:
        """What the finger of the newest content is predicted to feel; None where none plays."""
        every = [each for one in self.contents.values() for each in one.content.predictions[:1]]
        return every[-1] if every else None


@dataclass(frozen=True)
class SilenceReport:
    """All channels are silent, for a reason; latency and time [s].

    targets: of contacts that were to feel something, with the reason for each. latency: up to the
    last byte of the command, None if none was needed.
    """

    contacts: tuple[Contact, ...]
    targets: tuple[Prediction, ...]
    reason: str
    latency: float | None
    time: float
    is_touch: bool = False


def play_report(
    plan: Plan,
    playing: Mapping[int, LayerContent],
    *,
    sent_at: float | None,
    now: float,
    timing: Timing,
) -> PlayReport:
    """Report what plays after a plan, by layer; sent_at [s]: when it starts, None if before."""
    selection = plan.selection
    order = sorted(
        (number for number, one in playing.items() if one.content in selection.contents),
        key=plan.sets.started.__contains__,
    )
    return PlayReport(
        contacts=plan.contacts,
        targets=selection.predictions,
        quiet=selection.quiet,
        quiet_levels={
            each.key: selection.foreign_levels.get(each.key, ()) for each in selection.quiet
        },
        contents={number: playing[number] for number in order},
        latency=None if sent_at is None else sent_at - plan.since,
        time=now if sent_at is None else sent_at,
        from_rest=plan.from_rest,
        settled_after=plan.sets.settled_after,
        lasts=all(
            target.pulse is None for each in selection.contents for _, target in each.targets
        ),
        is_touch=plan.is_touch,
        timing=timing,
    )


def silence_report(plan: Plan, *, sent_at: float | None, now: float) -> SilenceReport:
    """Report a plan for silence; sent_at [s]: of its last byte, None if nothing was sent."""
    selection = plan.selection
    reason = plan.sets.reason or selection.reason or ""
    known = {each.contact.key: each for each in selection.not_served}
    return SilenceReport(
        contacts=plan.contacts,
        targets=tuple(
            known.get(contact.key) or not_served(contact, reason)
            for contact in dict.fromkeys(contact for contact, _ in selection.targets)
        ),
        reason=reason,
        latency=None if sent_at is None else sent_at - plan.since,
        time=now,
        is_touch=plan.is_touch,
    )


@dataclass(frozen=True)
class Observers:
    """Callbacks of the control loop by event, called within it in order: they must return at once.

    Their exceptions are logged and go no further.
    """

    contacts_changed: list[Callable[[tuple[Contact, ...], Change], object]] = field(
        default_factory=list
    )
    pattern_applied: list[Callable[[PlayReport], object]] = field(default_factory=list)
    silenced: list[Callable[[SilenceReport], object]] = field(default_factory=list)
    refused: list[Callable[[str], object]] = field(default_factory=list)
    link_lost: list[Callable[[str], object]] = field(default_factory=list)
    cycle_completed: list[Callable[[], object]] = field(default_factory=list)
    """Called after each cycle of the loop, at least once a second."""
