"""What is remembered of a host for each amplifier."""

import math
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from sim.witness.config import AmplifierConfig
from sim.witness.decoded import ChannelCommand, ReportViolation, Request
from sim.witness.reference_amplifier import ReferenceAmplifier

_REMEMBERED = 16  # tokens since Arm


@dataclass
class AmplifierSession:
    """A host's side of one amplifier; complain: see `Complain`."""

    name: str
    config: AmplifierConfig
    amplifier: ReferenceAmplifier
    report: ReportViolation
    is_disturbed: Callable[[float], bool]  # at a time [s]
    pending: dict[Hashable, tuple[float, Request]] = field(default_factory=dict)
    overdue: set[Hashable] = field(default_factory=set)
    superseded: set[Hashable] = field(default_factory=set)  # the same was asked again, and answered
    abandoned: set[Hashable] = field(default_factory=set)  # asked by a host that has hung up since
    vibrates: bool = False  # the last that it was told
    last_vibration: float = -math.inf  # when a set that vibrates was granted last
    last_silenced: float = -math.inf  # when it was told to be silent last
    staged: dict[int, Request] = field(default_factory=dict)
    tokens: deque[tuple[int, Request]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    levels: dict[int, ChannelCommand] = field(default_factory=dict)
    is_identified: bool | None = None
    is_open: bool = True
    is_stopped: bool = False
    armed_at: float = -math.inf  # as it was granted last
    stop_requested_at: float | None = None
    last_feed: float | None = None
    last_token: int = 0
    told: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))  # to play
    preempted_at: float = -math.inf  # when silence went before whatever was waited for

    def forget_pending(self) -> None:
        """Nobody waits for an answer any more, though some may come yet."""
        if self.pending:
            self.abandoned = set(self.pending)
        self.pending.clear()
        self.overdue.clear()
        self.superseded.clear()
