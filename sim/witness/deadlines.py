"""What must have happened by a time, later by the delays of the witness itself."""

from collections import deque
from collections.abc import Callable

from sim.witness.amplifier_session import AmplifierSession

_DELAYS_KEPT = 64


class Delays:
    """Delays of this program, in which what passed was seen late, by the time [s] of their end."""

    def __init__(self) -> None:
        self._known: deque[tuple[float, float]] = deque(maxlen=_DELAYS_KEPT)

    def note(self, until: float, duration: float) -> None:
        """Note that nothing was seen for a duration [s] until a time [s]."""
        self._known.append((until, duration))

    def since(self, time: float) -> float:
        """Sum of the delays [s] that ended after a time [s]."""
        return sum(duration for until, duration in self._known if until >= time)


Expected = tuple[str, AmplifierSession, Callable[[], bool]]
"""A rule, of which amplifier, and whether it is kept at a time."""


class Deadlines:
    """Rules for a host, each of which must be kept by a time [s].

    max_defer [s]: before a time within which delays defer it.
    """

    def __init__(self, delays: Delays, max_defer: float) -> None:
        self._delays = delays
        self._max_defer = max_defer
        self._pending: list[tuple[float, Expected, str]] = []

    def expect(self, since: float, limit: float, expected: Expected, what: str) -> None:
        """Expect a rule to be kept within a limit [s] of a time; what: to say where it is not."""
        what = f"{what} within {limit * 1e3:g} ms"
        self._pending.append((since + limit, expected, what))

    def advance(self, time: float) -> None:
        """Check the deadlines that have passed, but for those of a disturbed wire."""
        pending, self._pending = self._pending, []
        for due, expected, what in pending:
            rule, session, is_kept = expected
            if due + self._delays.since(due - self._max_defer) >= time:
                self._pending.append((due, expected, what))
            elif not (session.is_disturbed(due) or is_kept()):
                session.report_always(rule, due, what)
