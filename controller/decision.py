"""What the control loop decides, without waiting for anything: touch frames in, safe commands out.

take(frame)  ->  contacts
decide(now)  ->  contacts -> selection -> routing -> guard -> commands, if others are due
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from controller.contacts import Change, Contact, ContactTracker
from controller.routing import route
from controller.selection import PatternTable, Selection, Selector
from controller.touch import TouchFrame
from drivers.command import DriveCommand, token_after
from drivers.guard import Guard, SafeCommand
from model.pattern import Pattern
from model.perception import STRONG_DB_SL
from model.rig import Rig

# With nobody on the plate the end may be short, so that zero is reached within 20 ms of the lift;
# fingers that stay would feel so short an end as a tap.
RELEASE_RAMP = 0.010
FADE_RAMP = 0.020

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Decision:
    """What is to be done now.

    changes: of the contacts, since the last decision; commands: by amplifier, None if what plays
    stays; problem: why the selected pattern was not let through; since: when [s] the news came that
    led to this.
    """

    contacts: tuple[Contact, ...]
    changes: tuple[Change, ...]
    selection: Selection
    is_new: bool
    commands: Mapping[str, SafeCommand] | None
    problem: str | None
    since: float


class Decider:
    """Contacts, selection, routing and guard of one plate; reads no clock and waits for nothing.

    guards: by the name of the amplifier, one for each in the rig. Never raises: whatever goes wrong
    in a decision, the decision is silence.
    """

    def __init__(
        self,
        rig: Rig,
        table: PatternTable,
        *,
        guards: Mapping[str, Guard],
        level_db_sl: float = STRONG_DB_SL,
    ) -> None:
        self._rig = rig
        self._guards = guards
        self._tracker = ContactTracker(rig.plate)
        self._selector = Selector(table, level_db_sl=level_db_sl)
        self._decided: Selection | None = None
        self._is_silent = False
        self._playing: Mapping[str, DriveCommand] = {}
        self._token = 0
        self._changes: list[Change] = []
        self._since: float | None = None

    @property
    def next_expiry(self) -> float | None:
        """When [s] the next source is overdue unless it is heard; a decision is due then."""
        return self._tracker.next_expiry

    @property
    def owes_silence(self) -> bool:
        """Whether nobody touches the plate any more, but what was decided last is no silence."""
        return not self._tracker.contacts and not self._is_silent

    def take(self, frame: TouchFrame) -> Change:
        """Take over a touch frame; a decision is due if anything changed."""
        change = self._tracker.update(frame)
        self._note(change, frame.time)
        return change

    def forget(self) -> None:
        """What the amplifiers play is not known any more: the next decision has commands."""
        self._decided = None
        self._is_silent = False
        self._playing = {}

    def confirm(self, drive: Mapping[str, DriveCommand]) -> None:
        """This is what the amplifiers made of the last commands, by ERA without the silent ones."""
        self._playing = drive

    def decide(self, now: float) -> Decision:
        """Decide at a time [s]."""
        self._note(self._tracker.expire(now), now)
        contacts = self._tracker.contacts
        commands: Mapping[str, SafeCommand] | None = None
        problem = None
        try:
            selection = self._selector.select(contacts)
            is_new = selection != self._decided
            if is_new and selection.pattern is not None:
                commands, problem = self._guarded(selection.pattern)
        except Exception as error:
            selection = Selection(None, contacts, None, f"{type(error).__name__}: {error}")
            is_new = selection != self._decided
            if is_new:
                _logger.exception("the decision failed, all channels fall silent")
        if is_new and commands is None and not self._is_silent:
            commands = self.silence(ramp=FADE_RAMP if contacts else RELEASE_RAMP)
        if commands is not None:
            self._is_silent = all(command.is_silent for command in commands.values())
            self._playing = {}  # until the amplifiers have confirmed
        self._decided = selection
        decision = Decision(
            contacts=contacts,
            changes=tuple(self._changes),
            selection=selection,
            is_new=is_new,
            commands=commands,
            problem=problem,
            since=now if self._since is None else min(self._since, now),
        )
        self._changes, self._since = [], None
        return decision

    def silence(self, *, ramp: float) -> dict[str, SafeCommand]:
        """Commands that bring every wired channel to zero along a ramp [s]; never fails."""
        token = self._next_token()
        return {
            name: guard.silence(
                token,
                [wired.number for wired in self._rig.wiring.values() if wired.amplifier == name],
                ramp=ramp,
            )
            for name, guard in self._guards.items()
        }

    def _guarded(self, pattern: Pattern) -> tuple[dict[str, SafeCommand], str | None]:
        """Commands of a pattern, or silence everywhere and why, if a guard refuses any of it."""
        sets = route(
            pattern.excitation,
            self._rig,
            token=self._next_token(),
            ramp=pattern.ramp,
            playing=self._playing,
        )
        checked = {
            name: guard.check_or_silence(sets[name], ramp=FADE_RAMP)
            for name, guard in self._guards.items()
        }
        reasons = [f"{name}: {reason}" for name, (_, reason) in checked.items() if reason]
        if reasons:
            return self.silence(ramp=FADE_RAMP), "; ".join(reasons)
        return {name: safe for name, (safe, _) in checked.items()}, None

    def _next_token(self) -> int:
        """A token that all amplifiers share: 1..65535, then from 1 again."""
        self._token = token_after(self._token)
        return self._token

    def _note(self, change: Change, time: float) -> None:
        """Keep a change for the next decision, with the time of the first."""
        if change:
            self._changes.append(change)
            self._since = time if self._since is None else self._since
