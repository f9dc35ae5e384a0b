"""The host's communication with one amplifier, as far as rules need to remember it."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet
from drivers.protocol.table import QUANTITIES
from sim.witness.config import AmplifierConfig
from sim.witness.expected_amplifier import ExpectedAmplifier
from sim.witness.violation import ReportViolation

_TOKENS_KEPT = 16  # of commits


@dataclass
class AmplifierSession:
    """Requests to one amplifier by name, and the model of it; times [s].

    last_set: sent since Arm, token and layers; staged: the same, unless it was silenced since;
    layers: what each was sent to play, and until when; is_disturbed: whether faults were injected
    into the wire at or shortly before a time.
    """

    name: str
    config: AmplifierConfig
    amplifier: ExpectedAmplifier
    report: ReportViolation
    is_disturbed: Callable[[float], bool]
    last_set: tuple[int, tuple[LayerSet, ...]] | None = None
    staged: tuple[int, tuple[LayerSet, ...]] | None = None
    layers: dict[int, tuple[LayerSet, float]] = field(default_factory=dict)
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
    last_stop: float = -math.inf  # or status read
    last_feed: float | None = None
    heard_other_host: float = -math.inf
    constants: dict[str, Values] = field(default_factory=dict)

    def vibrates(self, time: float) -> bool:
        """Whether it vibrates by what was sent."""
        return any(until > time for _, until in self.layers.values())

    def set_sent(self, token: int, layers: Sequence[LayerSet], time: float) -> None:
        """Note a set that plays from a time on."""
        self.committed_tokens.append(token)
        for one in layers:
            before, until = self.layers.get(one.layer, (one, time))
            if one.renew and until > time:
                self.layers[one.layer] = before, _end_of(one, time)
            elif not one.renew:
                lasts = max((_lasts(each) for each in one.commands), default=0.0)
                self.layers[one.layer] = one, min(time + lasts, _end_of(one, time))

    def silence_sent(self, time: float) -> None:
        """Note a request that silences all layers and drops what is staged."""
        self.layers.clear()
        self.last_silenced, self.staged = time, None

    def check_constant(self, what: str, reported: Values, time: float) -> None:
        """Compare what must be the same for ever with what was reported before."""
        before = self.constants.setdefault(what, reported)
        if reported != before and not self.is_disturbed(time):
            self.report("constant", time, f"{self.name}: reply to {what} has changed")
        self.constants[what] = reported


def is_vibrating(layers: Sequence[LayerSet]) -> bool:
    """Whether a set makes anything vibrate, or go on to."""
    return any(one.renew or any(each.is_driven for each in one.commands) for one in layers)


def _end_of(one: LayerSet, time: float) -> float:
    valid_for = QUANTITIES["valid_for"].from_wire(one.valid_for)
    return time + valid_for if valid_for else math.inf


def _lasts(command: Command) -> float:
    """Return how long a command lasts [s]: an onset may lead to level 0."""
    if command.level or command.onset is None:
        return math.inf if command.level else 0.0
    step = QUANTITIES["envelope_step"].from_wire(command.onset.step)
    return step * (len(command.onset.knots) + 1)
