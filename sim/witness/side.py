"""What is remembered of a host for each amplifier."""

import math
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from sim.witness.follower import Follower
from sim.witness.plan import AmplifierPlan
from sim.witness.seen import Asked, Complain, Drive

_REMEMBERED = 16  # tokens since Arm


@dataclass
class Side:
    """A host's side of one amplifier; complain: see `Complain`."""

    name: str
    plan: AmplifierPlan
    follower: Follower
    complain: Complain
    is_troubled: Callable[[float], bool]  # at a time [s]
    pending: dict[Hashable, tuple[float, Asked]] = field(default_factory=dict)
    overdue: set[Hashable] = field(default_factory=set)
    settled: set[Hashable] = field(default_factory=set)  # the same was asked again, and answered
    abandoned: set[Hashable] = field(default_factory=set)  # asked by a host that has hung up since
    vibrates: bool = False  # the last that it was told
    vibrated_at: float = -math.inf  # when a set that vibrates was granted last
    silenced_at: float = -math.inf  # when it was told to be silent last
    staged: dict[int, Asked] = field(default_factory=dict)
    tokens: deque[tuple[int, Asked]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    levels: dict[int, Drive] = field(default_factory=dict)
    is_identified: bool | None = None
    is_open: bool = True
    is_stopped: bool = False
    armed_at: float = -math.inf  # as it was granted last
    stop_wished: float | None = None
    last_life: float | None = None
    last_token: int = 0
    told: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))  # to play
    overtaken: float = -math.inf  # when silence went before whatever was waited for

    def forget_pending(self) -> None:
        """Nobody waits for an answer any more, though some may come yet."""
        if self.pending:
            self.abandoned = set(self.pending)
        self.pending.clear()
        self.overdue.clear()
        self.settled.clear()
