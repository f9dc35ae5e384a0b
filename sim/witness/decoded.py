"""What the witness sees on a wire, whatever kind of wire it is.

A frame becomes one of the meanings below; what is none of them was damaged.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, TypeAlias

Direction: TypeAlias = Literal["amplifier", "host"]
"""Which way bytes go."""

ReportViolation: TypeAlias = Callable[[str, float, str], None]
"""Is told of a broken rule: its name, when [s], one sentence."""

Data: TypeAlias = bytes
"""What goes over a wire."""


class RequestKind(Enum):
    """What a host asks. LOOK: only reads, and what has to do with no amplifier's state."""

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
    READ = "a look"


WATCHDOG_FEEDING = frozenset(
    {
        *(
            RequestKind.ARM,
            RequestKind.DISARM,
            RequestKind.STAGE,
            RequestKind.COMMIT,
            RequestKind.APPLY,
            RequestKind.STOP,
            RequestKind.CLEAR,
        ),
        *(RequestKind.PING, RequestKind.ENVELOPE),
    }
)
"""Those that fill the watchdog again when they are not refused."""

STATE_CHANGING = frozenset(
    {
        RequestKind.ARM,
        RequestKind.DISARM,
        RequestKind.STAGE,
        RequestKind.COMMIT,
        RequestKind.APPLY,
        RequestKind.STOP,
        RequestKind.CLEAR,
    }
)
"""Those that change what an amplifier does, or will do."""


@dataclass(frozen=True, slots=True)
class ChannelCommand:
    """One channel of a set: Hz, level 0..1, degrees, and its flags and envelope slots."""

    frequency: float
    level: float
    phase: float
    keep_phase: bool = False
    skip_ending: bool = False
    onset: int = 0
    ending: int = 0

    @property
    def vibrates(self) -> bool:
        """Whether it asks for any vibration."""
        return self.level > 0 or self.onset > 0


@dataclass(frozen=True, slots=True)
class EnvelopeLoad:
    """An envelope for a slot: step [s] and the level of each knot."""

    slot: int
    step: float
    levels: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Request:
    """A request. address: of the amplifier, 0 for all; key: what its answer is known by, or None.

    ramp, valid_for, watchdog [s]; drives by channel; problem: what is wrong with it, if anything.
    """

    kind: RequestKind
    address: int
    key: Hashable = None
    token: int = 0
    ramp: float = 0.0
    valid_for: float = 0.0
    watchdog: float = 0.0
    commands: Mapping[int, ChannelCommand] = field(default_factory=dict)
    envelope: EnvelopeLoad | None = None
    problem: str = ""

    @property
    def vibrates(self) -> bool:
        """Whether its own drives ask for any vibration."""
        return any(command.vibrates for command in self.commands.values())


@dataclass(frozen=True, slots=True)
class Status:
    """How an amplifier says it is; None where this wire does not say it here. Times [s], °C."""

    state: int
    fault: int
    token: int | None = None
    watchdog_left: float | None = None
    high_voltage: bool | None = None
    temperature: float | None = None
    levels: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply. key: None where it answers nothing that is known; refusal: 0 if it was granted.

    achieved: what the set plays, by channel, and its token.
    """

    address: int
    key: Hashable = None
    refusal: int = 0
    status: Status | None = None
    token: int = 0
    achieved: Mapping[int, ChannelCommand] | None = None
    is_exact: bool | None = None
    problem: str = ""


@dataclass(frozen=True, slots=True)
class StateEvent:
    """A change of state that an amplifier tells unasked."""

    address: int
    state: int
    fault: int


@dataclass(frozen=True, slots=True)
class BootUp:
    """An amplifier, or what calls itself one, has just got its supply."""

    address: int


@dataclass(frozen=True, slots=True)
class Damaged:
    """Bytes that make no frame, or a frame that makes no message."""

    why: str


REPLY_TO_DAMAGED_FRAME = "it answers a damaged frame"
"""What is wrong with an answer that nobody but noise can have asked for."""

Message: TypeAlias = Request | Reply | StateEvent | BootUp | Damaged
DecodedFrame: TypeAlias = tuple[bytes, Message | None]
"""The bytes of a frame and what they mean; None: a part of something, or nothing to us."""
