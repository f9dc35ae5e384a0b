"""The host's communication with one amplifier, as far as rules need to remember it."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.playback import Playback
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from sim.witness.config import AmplifierConfig
from sim.witness.expected_amplifier import ExpectedAmplifier
from sim.witness.expected_outputs import silent
from sim.witness.violation import ReportViolation

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
