"""What the control loop tells whoever watches it: a demo, a log, a dashboard."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from controller.loop.decision import Decision
from controller.loop.orders import PatternTiming
from controller.loop.selection import Felt, Selection
from controller.sources.contacts import Change, Contact
from drivers.command import DriveCommand
from model.table.pattern import Pattern
from model.table.question import Question


@dataclass(frozen=True)
class Applied:
    """A pattern that the amplifiers have confirmed.

    contacts: all of them, in order of arrival; targets: who feels it, with the level and the
    contrast of each, and quiet: who must not, as it was chosen; pattern: as it is played, with its
    mode, its ramp, and envelopes where there are any; drive: what the amplifiers really play, by
    ERA, silent ones left out; latency [s]: from the touch frame that asked for it to the last byte
    of the command on the wire; time [s] of that byte; from_rest: whether nothing played before.
    """

    contacts: tuple[Contact, ...]
    targets: tuple[Felt, ...]
    quiet: tuple[Contact, ...]
    pattern: Pattern
    drive: Mapping[str, DriveCommand]
    latency: float
    time: float
    from_rest: bool = True
    question: Question | None = field(default=None, repr=False)
    timing: PatternTiming | None = field(default=None, repr=False, compare=False)

    @cached_property
    def transient_contrast_db(self) -> float | None:
        """Predicted contrast over the first 100 ms [dB], with the onset as it is played.

        Worked out when it is first asked for, some two milliseconds: not before the touch is on its
        way. None where nobody is to be quiet, where another pattern played before, or where the
        controller knows no `timing`.
        """
        if self.timing is None or self.question is None or not (self.from_rest and self.quiet):
            return None
        measured = self.timing.with_transient_measures(self.question, self.pattern)
        return measured.transient_contrast_db


@dataclass(frozen=True)
class Silenced:
    """All channels were brought to zero, or stay there, for a reason; latency and time [s].

    latency counts to the last byte of the command, or is None where silence needed none.
    """

    contacts: tuple[Contact, ...]
    selection: Selection
    reason: str
    latency: float | None
    time: float


def applied_by(
    decision: Decision,
    pattern: Pattern,
    *,
    drive: Mapping[str, DriveCommand],
    sent: float,
    timing: PatternTiming | None,
) -> Applied:
    """What is told of a decision by which a pattern plays; sent [s]: its last byte."""
    return Applied(
        contacts=decision.contacts,
        targets=decision.selection.felt,
        quiet=decision.selection.quiet,
        pattern=pattern,
        drive=drive,
        latency=sent - decision.since,
        time=sent,
        from_rest=decision.from_rest,
        question=decision.selection.question,
        timing=timing,
    )


def silenced_by(decision: Decision, *, sent: float | None, now: float) -> Silenced:
    """What is told of a decision by which nothing plays; sent, now [s]: None where none was."""
    problem = None if decision.order is None else decision.order.problem
    return Silenced(
        contacts=decision.contacts,
        selection=decision.selection,
        reason=problem or decision.selection.reason or "",
        latency=None if sent is None else sent - decision.since,
        time=now,
    )


def _ignore(*_: object) -> None:
    """Nobody listens."""


@dataclass(frozen=True)
class Observer:
    """Callbacks of the control loop, called within it: they must return at once.

    What they raise is logged and goes no further.
    """

    contacts_changed: Callable[[tuple[Contact, ...], Change], None] = _ignore
    pattern_applied: Callable[[Applied], None] = _ignore
    silenced: Callable[[Silenced], None] = _ignore
    refused: Callable[[str], None] = _ignore
    link_lost: Callable[[str], None] = _ignore
    source_failed: Callable[[str], None] = _ignore
    turned: Callable[[], None] = _ignore
    """The loop has run once more: at least every second, whatever happens or does not."""
