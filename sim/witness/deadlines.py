"""Deadlines for hosts, from contacts and operator commands."""

import math
from collections.abc import Callable, Collection, Hashable, Mapping
from dataclasses import dataclass
from functools import partial

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.config import TimeLimits
from sim.witness.delays import Delays

_REPEATED = 0.1  # s; within which a stop that is not confirmed goes on, for each amplifier
_CONFIRMED = 0.3  # s; then the host says that it is not


@dataclass
class KnownInputs:
    """The latest inputs; times [s], -inf for what has not happened.

    contacts, is_arm_requested: None where the witness is not given them; last_silencing: of the
    last stop or disarm command; stalled_since: None while the control loop runs.
    """

    contacts: frozenset[Hashable] | None = None
    last_lift: float = -math.inf
    last_touch: float = -math.inf
    stalled_since: float | None = None
    is_arm_requested: bool | None = None
    last_command: float = -math.inf
    last_disarm: float = -math.inf
    last_silencing: float = -math.inf

    def set_contacts(self, time: float, contacts: Collection[Hashable]) -> frozenset[Hashable]:
        """Replace the contacts on the plate; returns those that are new."""
        before, self.contacts = self.contacts or frozenset(), frozenset(contacts)
        if before and not self.contacts:
            self.last_lift = time
        if new := self.contacts - before:
            self.last_touch = time
        return new

    def operator_command(self, time: float, command: str) -> None:
        """Note an operator's arm, disarm, stop or clear."""
        self.last_command = time
        if command == "disarm":
            self.last_disarm = time
        self.is_arm_requested = command == "arm" or (
            self.is_arm_requested is True and command == "clear"
        )
        if command in ("stop", "disarm"):
            self.last_silencing = time


@dataclass
class _Deadline:
    """A condition that must hold at time `due` [s]."""

    due: float
    is_met: Callable[[], bool]
    invariant: str
    session: AmplifierSession
    sentence: str


class Deadlines:
    """Pending deadlines of a host; those that end while a wire is disturbed are not checked."""

    def __init__(
        self,
        sessions: Mapping[str, AmplifierSession],
        inputs: KnownInputs,
        *,
        times: TimeLimits,
        delays: Delays,
    ) -> None:
        self._sessions = sessions
        self._delays = delays
        self._inputs = inputs
        self._times = times
        self._pending: list[_Deadline] = []

    def advance(self, time: float) -> None:
        """Check the deadlines that have passed."""
        passed = [deadline for deadline in self._pending if self._due(deadline) < time]
        if not passed:
            return
        self._pending = [one for one in self._pending if self._due(one) >= time]
        for deadline in passed:
            session = deadline.session
            if not (session.is_disturbed(deadline.due) or deadline.is_met()):
                session.report(deadline.invariant, deadline.due, deadline.sentence)

    def _due(self, deadline: _Deadline) -> float:
        """When a condition must hold [s], later by the witness's own delays until then."""
        return deadline.due + self._delays.since(deadline.due - self._times.touch)

    def expect_silence(self, last_lift: float) -> None:
        """After the last lift every amplifier must be silenced."""
        limit = self._times.lift
        for session in self._sessions.values():
            self._expect(
                last_lift + limit,
                partial(self._is_silenced, session, last_lift),
                "lift",
                session,
                f"last finger lifted at {last_lift:.4f} s, {session.name} not silenced within "
                f"{limit * 1e3:g} ms",
            )

    def expect_pattern(self, contact: Hashable, since: float) -> None:
        """A new contact must lead to a pattern."""
        if not self._can_play():
            return
        limit = self._times.touch
        self._expect(
            since + limit,
            partial(self._has_pattern, contact, since),
            "touch",
            next(iter(self._sessions.values())),
            f"touch at {since:.4f} s, no amplifier plays a pattern within {limit * 1e3:g} ms",
        )

    def expect_stop(self, session: AmplifierSession, time: float) -> None:
        """A stop command must be sent to this amplifier."""
        session.stop_requested_at = time
        limit = self._times.stop
        self._expect(
            time + limit,
            lambda: session.stop_requested_at != time or not session.is_open,
            "stop",
            session,
            f"stop requested at {time:.4f} s, not sent to {session.name} within {limit * 1e3:g} ms",
        )

    def expect_confirmation(self, session: AmplifierSession, time: float) -> None:
        """A stop must be confirmed, or go on: it is repeated, or the status is read."""
        first = session.first_stop
        if first is None or time > first + _CONFIRMED - _REPEATED:
            return
        wire = [one for one in self._sessions.values() if one.config.wire == session.config.wire]
        limit = _REPEATED * len(wire)
        self._expect(
            time + limit,
            lambda: session.first_stop != first or session.last_stop > time or not session.is_open,
            "stop",
            session,
            f"stop sent to {session.name} at {time:.4f} s, neither confirmed nor repeated within "
            f"{limit * 1e3:g} ms",
        )

    def expect_commits(self, first: AmplifierSession, time: float, token: int) -> None:
        """A set that one amplifier plays must be played by all that it was sent to, or silenced."""
        limit = self._times.together
        for session in self._sessions.values():
            is_part = session.staged is not None and session.staged[0] == token
            if session is not first and is_part and session.amplifier.is_enabled:
                self._expect(
                    time + limit,
                    partial(_is_joined, session, first, time, token),
                    "commit",
                    session,
                    f"{first.name} was commanded to play set {token} at {time:.4f} s, "
                    f"{session.name} not within {limit * 1e3:g} ms",
                )

    def _expect(
        self,
        due: float,
        is_met: Callable[[], bool],
        invariant: str,
        session: AmplifierSession,
        sentence: str,
    ) -> None:
        self._pending.append(_Deadline(due, is_met, invariant, session, sentence))

    def _is_silenced(self, session: AmplifierSession, last_lift: float) -> bool:
        """Whether it was silenced after a lift, or need not be."""
        vibrates = session.vibrates(last_lift + self._times.lift)
        is_silent = not vibrates or session.amplifier.is_in_fault or not session.is_open
        is_touched_again = self._inputs.last_touch >= last_lift
        is_given_up = session.last_feed is None  # since a disturbance
        is_stalled = self._inputs.stalled_since is not None
        return is_silent or is_touched_again or is_given_up or is_stalled

    def _can_play(self) -> bool:
        return self._inputs.stalled_since is None and all(
            session.is_open and session.amplifier.is_enabled and not session.is_stopped
            for session in self._sessions.values()
        )

    def _has_pattern(self, contact: Hashable, since: float) -> bool:
        """Whether a pattern plays since then, or none can."""
        sessions = self._sessions.values()
        return (
            any(session.last_vibration >= since for session in sessions)
            or contact not in (self._inputs.contacts or ())
            or self._inputs.last_silencing >= since
            or self._inputs.stalled_since is not None
            or any(session.amplifier.is_in_fault or not session.is_open for session in sessions)
        )


def _is_joined(session: AmplifierSession, first: AmplifierSession, time: float, token: int) -> bool:
    """Whether an amplifier plays the set of the first one too, or the first one is silenced."""
    return (
        token in session.committed_tokens
        or not first.vibrates(time)
        or first.last_silenced >= time  # since then it may play another set
        or not first.is_open  # its watchdog silences it
    )
