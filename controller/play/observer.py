"""Reports of the control loop to a demo, a log or a dashboard."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from controller.play.content import Prediction, not_served
from controller.play.decision import Decision
from controller.play.playing import PlayedContent
from controller.play.routing import Drive
from controller.sources.contacts import Change, Contact, ContactKey
from model.answer.answer import Layer
from model.answer.fingers import Placement
from model.answer.timing import Timing


@dataclass(frozen=True)
class Applied:
    """The contents that amplifiers play since their last confirmed set.

    contacts: all, in order of arrival; targets: a prediction for each; quiet: quiet contacts, and
    what they feel at most (`Selection.quiet_levels`);
    contents: as they are played, by layer, the newest one last; latency [s]: from the touch frame
    to the last byte of the command on the wire, None if none was needed; time [s] of that byte, or
    of the report; from_rest: whether the plate
    was at rest; settled_after [s]: when the last fade or envelope has ended; lasts: whether all
    play until their contacts change; is_touch: as of the decision.
    """

    contacts: tuple[Contact, ...]
    targets: tuple[Prediction, ...]
    quiet: tuple[Contact, ...]
    quiet_levels: Mapping[ContactKey, float]
    contents: Mapping[int, PlayedContent]
    latency: float | None
    time: float
    from_rest: bool
    settled_after: float
    lasts: bool
    is_touch: bool
    timing: Timing = field(repr=False, compare=False)

    @property
    def newest(self) -> PlayedContent:
        """The content that changed last."""
        return [*self.contents.values()][-1]

    @property
    def pattern(self) -> Layer:
        """What plays of the newest content."""
        return self.newest.pattern

    @property
    def drive(self) -> Drive:
        """What the amplifiers play of the newest content, by ERA, without silent ones."""
        return self.newest.drive

    @property
    def question(self) -> Placement:
        """Where the fingers of the newest content are, and all others."""
        return self.newest.content.question

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
        return self.timing.transient_contrast_db(self.pattern, self.question)

    @property
    def felt(self) -> Prediction | None:
        """What the finger of the newest content is predicted to feel; None where none plays."""
        every = [each for one in self.contents.values() for each in one.content.predictions[:1]]
        return every[-1] if every else None


@dataclass(frozen=True)
class Silenced:
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


def applied_by(
    decision: Decision,
    playing: Mapping[int, PlayedContent],
    *,
    sent_at: float | None,
    now: float,
    timing: Timing,
) -> Applied:
    """Report what plays after a decision, by layer; sent_at [s]: as of `silenced_by`."""
    selected = decision.selection.contents
    order = sorted(
        (number for number, one in playing.items() if one.content in selected),
        key=decision.started.__contains__,
    )
    return Applied(
        contacts=decision.contacts,
        targets=decision.selection.predictions,
        quiet=decision.selection.quiet,
        quiet_levels=decision.selection.quiet_levels,
        contents={number: playing[number] for number in order},
        latency=None if sent_at is None else sent_at - decision.triggered_at,
        time=now if sent_at is None else sent_at,
        from_rest=decision.from_rest,
        settled_after=max((each.settled_after for each in decision.sets.values()), default=0.0),
        lasts=all(target.pulse is None for each in selected for _, target in each.targets),
        is_touch=decision.is_touch,
        timing=timing,
    )


def silenced_by(decision: Decision, *, sent_at: float | None, now: float) -> Silenced:
    """Report a decision for silence; sent_at [s]: of its last byte, None if nothing was sent."""
    selection = decision.selection
    reason = decision.refusal or selection.reason or ""
    known = {each.contact.key: each for each in selection.not_served}
    return Silenced(
        contacts=decision.contacts,
        targets=tuple(
            known.get(contact.key) or not_served(contact, reason)
            for contact, _ in selection.targets
        ),
        reason=reason,
        latency=None if sent_at is None else sent_at - decision.triggered_at,
        time=now,
        is_touch=decision.is_touch,
    )


def _ignore(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Observer:
    """Callbacks of the control loop, called within it: they must return at once.

    Their exceptions are logged and go no further.
    """

    contacts_changed: Callable[[tuple[Contact, ...], Change], None] = _ignore
    pattern_applied: Callable[[Applied], None] = _ignore
    silenced: Callable[[Silenced], None] = _ignore
    refused: Callable[[str], None] = _ignore
    link_lost: Callable[[str], None] = _ignore
    cycle_completed: Callable[[], None] = _ignore
    """Called after each cycle of the loop, at least once a second."""
