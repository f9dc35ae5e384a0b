"""What a host owes within a time: silence, patterns and stops; looked at when the time is over."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.config import TimeLimits
from sim.witness.known_inputs import KnownInputs


@dataclass
class _Deadline:
    """What must have happened when a time [s] is over; is_done is asked then."""

    due: float
    is_done: Callable[[], bool]
    invariant: str
    session: AmplifierSession
    sentence: str


class Deadlines:
    """Those of a host of these amplifiers; what a fault of a wire excuses is not complained of."""

    def __init__(
        self, sessions: Mapping[str, AmplifierSession], inputs: KnownInputs, *, times: TimeLimits
    ) -> None:
        self._sessions = sessions
        self._inputs = inputs
        self._times = times
        self._due: list[_Deadline] = []

    def advance(self, time: float) -> None:
        """Look at those whose time is over."""
        if any(deadline.due < time for deadline in self._due):
            over = [deadline for deadline in self._due if deadline.due < time]
            self._due = [deadline for deadline in self._due if deadline.due >= time]
            for deadline in over:
                if not (deadline.session.is_disturbed(deadline.due) or deadline.is_done()):
                    deadline.session.report(deadline.invariant, deadline.due, deadline.sentence)

    def silence(self, last_lift: float) -> None:
        """The last finger has gone."""
        for session in self._sessions.values():
            self._due.append(
                _Deadline(
                    last_lift + self._times.lift,
                    lambda session=session: self._is_released(session, last_lift),  # type: ignore[misc]
                    "lift",
                    session,
                    f"the last finger was lifted at {last_lift:.4f} s, and "
                    f"{self._times.lift * 1e3:g} ms later {session.name} was not told to be silent",
                )
            )

    def pattern(self, contact: Hashable, since: float) -> None:
        """A finger has come."""
        if not self._can_play():
            return
        self._due.append(
            _Deadline(
                since + self._times.touch,
                lambda: self._is_answered(contact, since),
                "touch",
                next(iter(self._sessions.values())),
                f"a finger came at {since:.4f} s, and {self._times.touch * 1e3:g} ms later no "
                "amplifier plays a pattern for it",
            )
        )

    def stop(self, session: AmplifierSession, time: float) -> None:
        """A stop was wished."""
        session.stop_requested_at = time
        self._due.append(
            _Deadline(
                time + self._times.stop,
                lambda: session.stop_requested_at != time or not session.is_open,
                "stop",
                session,
                f"a stop was wished at {time:.4f} s, and {self._times.stop * 1e3:g} ms later "
                f"{session.name} has not been told",
            )
        )

    def expect_all_amplifiers(self, first: AmplifierSession, time: float, token: int) -> None:
        """Where one amplifier plays a set, all do, or it is silenced."""
        for session in self._sessions.values():
            if session is first or not session.amplifier.is_enabled:
                continue
            self._due.append(
                _Deadline(
                    time + self._times.together,
                    lambda session=session: (  # type: ignore[misc]
                        # Where nobody is left on the first one's wire, its watchdog silences it.
                        token in session.told
                        or not first.vibrates
                        or first.last_silenced >= time  # since when it may play another set
                        or not first.is_open
                    ),
                    "commit",
                    session,
                    f"{first.name} was told at {time:.4f} s to play set {token}, and "
                    f"{self._times.together * 1e3:g} ms later {session.name} was not",
                )
            )

    def _is_released(self, session: AmplifierSession, last_lift: float) -> bool:
        """Whether it was told to be silent after a lift, or has a good reason not to be."""
        is_touched_again = self._inputs.last_touch >= last_lift
        told = not session.vibrates or session.amplifier.is_in_fault or not session.is_open
        has_given_up = session.last_feed is None  # since some trouble
        return told or is_touched_again or has_given_up or self._inputs.stalled_since is not None

    def _can_play(self) -> bool:
        sessions = self._sessions.values()
        return self._inputs.stalled_since is None and all(
            session.is_open and session.amplifier.is_enabled and not session.is_stopped
            for session in sessions
        )

    def _is_answered(self, contact: Hashable, since: float) -> bool:
        """Whether a pattern plays since then, or there is a good reason why none does."""
        return (
            any(session.last_vibration >= since for session in self._sessions.values())
            or contact not in (self._inputs.contacts or ())
            or self._inputs.last_silencing >= since
            or self._inputs.stalled_since is not None
            or any(
                session.amplifier.is_in_fault or not session.is_open
                for session in self._sessions.values()
            )
        )
