"""The host's communication with one amplifier, as far as rules need to remember it."""

import math
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from sim.witness.config import AmplifierConfig
from sim.witness.decoded import ChannelCommand, Request
from sim.witness.reference_amplifier import ReferenceAmplifier
from sim.witness.violation import ReportViolation
from sim.witness.voices import Voices

_TOKENS_KEPT = 16  # of commits


@dataclass
class AmplifierSession:
    """Requests to one amplifier by name, and the reference model of it; times [s].

    pending: requests by the key of their reply, each with its time; superseded: keys of requests
    that were repeated and answered; abandoned: keys of a host that has disconnected since;
    overtaken: keys of those that were pending when a broadcast Stop was sent after them;
    is_disturbed: whether faults were injected into the wire at or shortly before a time.
    """

    name: str
    config: AmplifierConfig
    amplifier: ReferenceAmplifier
    report: ReportViolation
    is_disturbed: Callable[[float], bool]
    pending: dict[Hashable, tuple[float, Request]] = field(default_factory=dict)
    overdue: set[Hashable] = field(default_factory=set)
    superseded: set[Hashable] = field(default_factory=set)
    abandoned: set[Hashable] = field(default_factory=set)
    overtaken: set[Hashable] = field(default_factory=set)
    vibrates: bool = False  # by the last set that was sent
    last_vibration: float = -math.inf  # when a vibrating set was accepted
    last_silenced: float = -math.inf  # when a silencing request was sent
    staged: dict[int, Request] = field(default_factory=dict)
    last_set: Request | None = None  # since Arm
    active_set: Request | None = None  # applied or committed last, since Arm
    committed_tokens: deque[int] = field(default_factory=lambda: deque(maxlen=_TOKENS_KEPT))
    levels: dict[int, ChannelCommand] = field(default_factory=dict)
    is_identified: bool | None = None
    is_open: bool = True
    is_stopped: bool = False
    armed_at: float = -math.inf
    stop_requested_at: float | None = None
    last_feed: float | None = None
    last_ping: float = -math.inf
    last_token: int = 0
    preempted_at: float = -math.inf  # when a silencing request overtook pending ones
    constants: dict[str, bytes] = field(default_factory=dict)
    voices: Voices = field(default_factory=Voices)

    def check_constant(self, what: str, reported: bytes, time: float) -> None:
        """Compare what must be the same for ever with what was reported before."""
        before = self.constants.setdefault(what, reported)
        if reported != before and not self.is_disturbed(time):
            self.report("constant", time, f"{self.name}: {what} has changed")
        self.constants[what] = reported

    def forget_pending(self) -> None:
        """Abandon the pending requests; their replies may still arrive."""
        if self.pending:
            self.abandoned = set(self.pending)
        self.pending.clear()
        self.overdue.clear()
        self.superseded.clear()
        self.overtaken.clear()
