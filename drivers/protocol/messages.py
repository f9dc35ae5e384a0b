"""What host and amplifier say to each other, whatever the wire.

A request is answered by exactly one reply: the one named beside it here, or a `Nak`.
An `AmplifierEvent` comes unsolicited, on wires on which an amplifier may speak first. Codecs turn
these into bytes and back; nothing here deals with bytes.

    Hello       Identity            who is there
    GetCaps     Capabilities        what it can play
    Arm         Status              high voltage on, outputs enabled at level zero
    Disarm      Status              silent, then high voltage off
    Stage       Achieved            keep a set ready under its token
    Commit      Achieved            play the staged set of this token
    Apply       Achieved            Stage and Commit in one
    Stop        Status              quick stop: silent within the ramp, latched until cleared
    GetStatus   Status              how it is
    GetFaults   FaultList           what went wrong, newest first
    Clear       Status              acknowledge faults whose cause is gone
    Ping        Status              heartbeat: feeds the watchdog
    LoadEnvelope  Loaded            keep an envelope under its slot, for sets that refer to it

A Commit or a Stop may be broadcast to all amplifiers of a bus; nobody answers then.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias

from drivers.command import CommandSet, DriveCommand, Envelope


class AmplifierState(IntEnum):
    """Amplifier states by their CiA 402 names; the numbers are those on the wire."""

    NOT_READY = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class Fault(IntEnum):
    """Why an amplifier is in FAULT; NONE where it is not."""

    NONE = 0
    WATCHDOG = 1
    OVER_TEMPERATURE = 2
    OVER_VOLTAGE = 3
    ARC = 4
    CHANNEL = 5
    INTERNAL = 6


class NakCode(IntEnum):
    """Why a request was refused."""

    UNKNOWN_TYPE = 1
    BAD_LENGTH = 2
    BAD_VALUE = 3
    BAD_CHANNEL = 4
    WRONG_STATE = 5
    BAD_TOKEN = 6
    BUSY = 7
    UNSUPPORTED_VERSION = 8
    NO_ENVELOPE = 9


@dataclass(frozen=True, slots=True)
class Hello:
    """Who is there?"""


@dataclass(frozen=True, slots=True)
class GetCaps:
    """What can you play?"""


@dataclass(frozen=True, slots=True)
class Arm:
    """Switch on and enable at level zero; watchdog [s] is how long silence of the host is borne."""

    watchdog: float


@dataclass(frozen=True, slots=True)
class Disarm:
    """Fall silent along a ramp [s], then switch the high voltage off."""

    ramp: float


@dataclass(frozen=True, slots=True)
class Stage:
    """Keep this set ready; nothing moves."""

    command_set: CommandSet


@dataclass(frozen=True, slots=True)
class Commit:
    """Play the staged set with this token; a token that is already playing is left alone."""

    token: int


@dataclass(frozen=True, slots=True)
class Apply:
    """Stage and commit at once."""

    command_set: CommandSet


@dataclass(frozen=True, slots=True)
class Stop:
    """Quick stop: every channel silent along a ramp [s]; stays in QUICK_STOP_ACTIVE until Clear."""

    ramp: float


@dataclass(frozen=True, slots=True)
class GetStatus:
    """How are you? Does not feed the watchdog."""


@dataclass(frozen=True, slots=True)
class GetFaults:
    """What went wrong?"""


@dataclass(frozen=True, slots=True)
class Clear:
    """I have seen the faults; leave FAULT or QUICK_STOP_ACTIVE if their cause is gone."""


@dataclass(frozen=True, slots=True)
class Ping:
    """I am alive: feeds the watchdog while armed."""


@dataclass(frozen=True, slots=True)
class LoadEnvelope:
    """Keep this envelope under its slot until another takes its place or the supply is lost."""

    envelope: Envelope


@dataclass(frozen=True, slots=True)
class Identity:
    """Who an amplifier is; the serial number tells two of a kind apart."""

    vendor: str
    product: str
    serial_number: str
    firmware: str
    protocol_version: int


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What an amplifier can play: frequencies [Hz], steps, watchdog range [s], longest ramp [s].

    envelope_knots: how many an envelope may have; envelope_slots: how many envelopes it keeps;
    their steps [s]; all 0 for an amplifier without envelopes. events: whether it speaks unasked.
    """

    channels: int
    frequency_min: float
    frequency_max: float
    frequency_step: float
    level_max: float
    level_step: float
    phase_step: float
    ramp_max: float
    watchdog_min: float
    watchdog_max: float
    envelope_knots: int
    envelope_slots: int = 0
    envelope_step_min: float = 0.0
    envelope_step_max: float = 0.0
    events: bool = False


@dataclass(frozen=True, slots=True)
class Status:
    """How an amplifier is: state, fault, the token it plays, the level each channel has now.

    token 0: nothing was played since it was armed; temperature [°C]; watchdog_left [s]; voltage
    [V] of the high-voltage supply, 0 where it is not measured.
    """

    state: AmplifierState
    fault: Fault
    token: int
    high_voltage: bool
    temperature: float
    watchdog_left: float
    levels: tuple[float, ...]
    voltage: float = 0.0


@dataclass(frozen=True, slots=True)
class Achieved:
    """What will really be played under a token, after the amplifier's own quantisation."""

    token: int
    commands: tuple[DriveCommand, ...]


@dataclass(frozen=True, slots=True)
class FaultRecord:
    """One fault and how long ago [s] it happened."""

    fault: Fault
    channel: int | None
    age: float


@dataclass(frozen=True, slots=True)
class FaultList:
    """Latched and past faults, newest first."""

    faults: tuple[FaultRecord, ...]


@dataclass(frozen=True, slots=True)
class Loaded:
    """An envelope of so many knots is kept under this slot."""

    slot: int
    knots: int


@dataclass(frozen=True, slots=True)
class AmplifierEvent:
    """The state has changed, or there is a fault; channel: the one to blame, where one is."""

    state: AmplifierState
    fault: Fault
    channel: int | None = None


@dataclass(frozen=True, slots=True)
class Nak:
    """Refused: why, and which channel where one is to blame. Nothing of the request was applied."""

    code: NakCode
    channel: int | None = None


Request: TypeAlias = (
    Hello
    | GetCaps
    | Arm
    | Disarm
    | Stage
    | Commit
    | Apply
    | Stop
    | GetStatus
    | GetFaults
    | Clear
    | Ping
    | LoadEnvelope
)
Reply: TypeAlias = Identity | Capabilities | Status | Achieved | FaultList | Loaded | Nak
Broadcast: TypeAlias = Commit | Stop
