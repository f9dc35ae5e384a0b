"""Reports of the control loop to a demo, a log or a dashboard."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

from controller.loop.decision import Decision
from controller.loop.routing import Drive
from controller.loop.selection import Prediction
from controller.sources.contacts import Change, Contact
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.timing import Timing


@dataclass(frozen=True)
class Applied:
    """A pattern that the amplifiers have confirmed.

    contacts: all, in order of arrival; targets: a prediction for each; quiet: quiet contacts;
    pattern: as it is played, with its ramp and envelopes; drive: what the amplifiers play, by ERA,
    without silent ones; latency [s]: from the touch frame to the last byte of the command on the
    wire; time [s] of that byte; from_rest: whether the plate was at rest; settled_after [s]: when
    its last fade or envelope has ended; lasts: whether it plays until its contacts change.
    """

    contacts: tuple[Contact, ...]
    targets: tuple[Prediction, ...]
    quiet: tuple[Contact, ...]
    pattern: Pattern
    drive: Drive
    latency: float
    time: float
    from_rest: bool = True
    settled_after: float = 0.0
    lasts: bool = True
    question: Question | None = field(default=None, repr=False)
    timing: Timing | None = field(default=None, repr=False, compare=False)

    @cached_property
    def transient_contrast_db(self) -> float | None:
        """Predicted contrast over the first 100 ms [dB], with the onset as it is played.

        Computed when it is first read, in about two milliseconds, so that no touch waits for it.
        None without quiet contacts, within 0.4 s of another pattern, whose ringing it does not
        include, or without `timing`.
        """
        if self.timing is None or self.question is None or not (self.from_rest and self.quiet):
            return None
        measured = self.timing.with_transient_measures(self.question, self.pattern)
        return measured.transient_contrast_db


@dataclass(frozen=True)
class Silenced:
    """All channels are silent, for a reason; latency and time [s].

    targets: contacts for which a pattern was requested. latency: up to the last byte of the
    command, None if none was needed.
    """

    contacts: tuple[Contact, ...]
    targets: tuple[Contact, ...]
    reason: str
    latency: float | None
    time: float


def applied_by(
    decision: Decision,
    pattern: Pattern,
    *,
    drive: Drive,
    sent_at: float,
    timing: Timing | None,
) -> Applied:
    """Report a decision whose pattern plays; sent_at [s]: of its last byte."""
    return Applied(
        contacts=decision.contacts,
        targets=decision.selection.predictions,
        quiet=decision.selection.quiet,
        pattern=pattern,
        drive=drive,
        latency=sent_at - decision.triggered_at,
        time=sent_at,
        from_rest=decision.from_rest,
        settled_after=0.0 if decision.set is None else decision.set.settled_after,
        lasts=all(target.pulse is None for _, target in decision.selection.targets),
        question=decision.selection.question,
        timing=timing,
    )


def silenced_by(decision: Decision, *, sent_at: float | None, now: float) -> Silenced:
    """Report a decision for silence; sent_at [s]: of its last byte, None if nothing was sent."""
    return Silenced(
        contacts=decision.contacts,
        targets=tuple(contact for contact, _ in decision.selection.targets),
        reason=decision.refusal or decision.selection.reason or "",
        latency=None if sent_at is None else sent_at - decision.triggered_at,
        time=now,
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
