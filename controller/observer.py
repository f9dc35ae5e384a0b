"""What the control loop tells whoever watches it: a demo, a log, a dashboard."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from controller.contacts import Change, Contact
from controller.selection import Selection
from drivers.command import DriveCommand
from model.pattern import Pattern


@dataclass(frozen=True)
class Applied:
    """A pattern that the amplifiers have confirmed.

    contacts: all of them, in order of arrival; target, quiet: as it was chosen; drive: what the
    amplifiers really play, by ERA, silent ones left out; latency [s]: from the touch frame that
    asked for it to the last byte of the command on the wire; time [s] of that byte.
    """

    contacts: tuple[Contact, ...]
    target: Contact
    quiet: tuple[Contact, ...]
    pattern: Pattern
    drive: Mapping[str, DriveCommand]
    latency: float
    time: float


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
