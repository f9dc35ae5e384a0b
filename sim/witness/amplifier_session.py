"""The host's communication with one amplifier, as far as rules need to remember it, and deadlines.

What must have happened by a time is due later by the delays of the witness itself.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.playback import Playback
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from sim.witness.capture import ReportViolation
from sim.witness.config import AmplifierConfig
from sim.witness.expected_amplifier import ExpectedAmplifier
from sim.witness.expected_outputs import silent

_TOKENS_KEPT = 16  # of commits


@dataclass
class AmplifierSession:
    """Requests to one amplifier by name, and the model of it; times [s].

    report_always: for violations that no fault of the wire excuses; report: for all others.
    is_disturbed: whether faults were injected into the wire at or shortly before a time. played:
    what it was sent to play; last_set: sent since Arm, token and layers; staged: the same, unless
    it was silenced since.
    """

    name: str
    config: AmplifierConfig
    amplifier: ExpectedAmplifier
    report_always: ReportViolation
    report: ReportViolation
    is_disturbed: Callable[[float], bool]
    played: Playback = field(default_factory=silent)
    last_set: tuple[int, Sequence[LayerSet]] | None = None
    staged: tuple[int, Sequence[LayerSet]] | None = None
    session: int | None = None  # with which the host has armed it
    last_vibration: float = -math.inf  # when a vibrating set was accepted
    last_silenced: float = -math.inf  # when a silencing request was sent
    committed_tokens: deque[int] = field(default_factory=lambda: deque(maxlen=_TOKENS_KEPT))
    is_identified: bool | None = None
    is_open: bool = True
    is_stopped: bool = False
    armed_at: float = -math.inf
    stop_requested_at: float | None = None
    first_stop: float | None = None  # that is not confirmed yet
    is_disarming: bool = False  # until it has shown silence
    last_stop: float = -math.inf  # or status read
    last_feed: float | None = None
    heard_other_host: float = -math.inf
    overdue_at: float = -math.inf  # when a reply was last overdue
    is_mute: bool = False  # it has restarted, and replies to nothing until it is identified
    constants: dict[str, Values] = field(default_factory=dict)

    def vibrates(self, time: float) -> bool:
        """Whether it vibrates at a time by what was sent until now."""
        self.played.advance(time)
        return any(self.played.end_of(layer) > time for layer in self.played.tokens)

    def silence_sent(self, time: float) -> None:
        """Note a request that silences all layers and drops what is staged."""
        self.played = silent()
        self.last_silenced, self.staged = time, None

    def forget_amplifier(self) -> None:
        """Take it for another one from now on, or for one that has started."""
        self.amplifier.forget_state()
        self.constants.clear()
        self.played = silent()

    def check_constant(self, what: str, reported: Values, time: float) -> None:
        """Compare what must be the same for ever with what was reported before."""
        if reported != self.constants.setdefault(what, reported):
            self.report("constant", time, f"{self.name}: reply to {what} has changed")
        self.constants[what] = reported


def is_vibrating(layers: Sequence[LayerSet]) -> bool:
    """Whether a set makes anything vibrate, or go on to."""
    return any(one.renew or any(each.is_driven for each in one.commands) for one in layers)


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
