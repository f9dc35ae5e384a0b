"""Decoded frames, the same for every kind of wire."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TypeAlias

Data: TypeAlias = bytes


class RequestKind(Enum):
    """Kind of a request; READ: any read that does not concern the amplifier's state."""

    HELLO = "Hello"
    CAPABILITIES = "GetCaps"
    ARM = "Arm"
    DISARM = "Disarm"
    STAGE = "Stage"
    COMMIT = "Commit"
    APPLY = "Apply"
    STOP = "Stop"
    STATUS = "GetStatus"
    FAULTS = "GetFaults"
    CLEAR = "Clear"
    PING = "Ping"
    ENVELOPE = "LoadEnvelope"
    ADDRESS = "SetAddress"
    READ = "a read"


SETS = frozenset({RequestKind.STAGE, RequestKind.COMMIT, RequestKind.APPLY})
"""Requests that carry a token."""

STATE_CHANGING = SETS | {
    RequestKind.ARM,
    RequestKind.DISARM,
    RequestKind.STOP,
    RequestKind.CLEAR,
}
"""Requests that change what the amplifier does."""

WATCHDOG_FEEDING = SETS | {RequestKind.ARM, RequestKind.PING}
"""Requests that feed the watchdog unless they are refused."""

INCOMPLETE_SET = "incomplete set"
"""How the problem of a set with missing frames begins."""

REPLY_TO_DAMAGED_FRAME = "replies to a damaged frame"
"""The problem of a reply to a request that arrived damaged."""


@dataclass(frozen=True, slots=True)
class ChannelCommand:
    """One channel of a set: frequency [Hz], level 0..1, phase [deg], flags and envelope slots."""

    frequency: float
    level: float
    phase: float
    keep_phase: bool = False
    skip_ending: bool = False
    onset: int = 0
    ending: int = 0

    @property
    def vibrates(self) -> bool:
        """Whether it commands any vibration."""
        return self.level > 0 or self.onset > 0


@dataclass(frozen=True, slots=True)
class EnvelopeLoad:
    """An envelope for a slot: step [s] and the level of each knot."""

    slot: int
    step: float
    levels: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Request:
    """A request. address: 0 for broadcast; key: matches its reply, None where there is none.

    ramp, valid_for, watchdog [s]; session: None where the wire carries none; commands by channel;
    problem: what is wrong with it, or "".
    """

    kind: RequestKind
    address: int
    key: Hashable = None
    token: int = 0
    ramp: float = 0.0
    valid_for: float = 0.0
    watchdog: float = 0.0
    session: int | None = None
    commands: Mapping[int, ChannelCommand] = field(default_factory=dict)
    envelope: EnvelopeLoad | None = None
    problem: str = ""

    @property
    def vibrates(self) -> bool:
        """Whether its own commands ask for any vibration."""
        return any(command.vibrates for command in self.commands.values())

    @property
    def is_incomplete_set(self) -> bool:
        """Whether frames of the set are missing."""
        return self.problem.startswith(INCOMPLETE_SET)


@dataclass(frozen=True, slots=True)
class Status:
    """Reported status; None where the frame does not carry it. Times [s], temperature [°C]."""

    state: int
    fault: int
    token: int | None = None
    watchdog_left: float | None = None
    high_voltage: bool | None = None
    temperature: float | None = None
    levels: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply. key: of its request, None where it matches none; refusal: 0 if granted.

    achieved: the set as played, by channel, and its token; is_exact: whether it plays as commanded;
    constant: what must be the same in every reply to such a request; voices: of a channel, as it
    states, or 0; faults: newest first, each with its age [s]; item: index and subindex of an object
    that was read, since the time begun [s].
    """

    address: int
    key: Hashable = None
    refusal: int = 0
    status: Status | None = None
    token: int = 0
    achieved: Mapping[int, ChannelCommand] | None = None
    is_exact: bool | None = None
    constant: bytes | None = None
    voices: int = 0
    faults: tuple[tuple[int, float], ...] | None = None
    item: tuple[int, int] | None = None
    begun: float = 0.0
    problem: str = ""


@dataclass(frozen=True, slots=True)
class StateEvent:
    """An unsolicited change of state."""

    address: int
    state: int
    fault: int


@dataclass(frozen=True, slots=True)
class BootUp:
    """An amplifier, or another device with its address, has started."""

    address: int


@dataclass(frozen=True, slots=True)
class Damaged:
    """Bytes that form no frame, or a frame that decodes to no message."""

    reason: str


Message: TypeAlias = Request | Reply | StateEvent | BootUp | Damaged
DecodedFrame: TypeAlias = tuple[bytes, Message | None]
"""A frame and its message; None for part of a message, or none that concerns the rules."""
