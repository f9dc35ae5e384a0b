"""Messages between host and amplifier, whatever the wire.

Every request has exactly one reply: the one listed with it here, or a `Nak`.
An `AmplifierEvent` comes unsolicited, on wires on which an amplifier may speak first. Codecs turn
these into bytes and back.

    Hello       Identity            identify the amplifier
    GetCaps     Capabilities        read what it can play
    Arm         Status              high voltage on, outputs enabled at level zero
    Disarm      Status              silent, then high voltage off
    Stage       Achieved            keep a set ready under its token
    Commit      Achieved            play the staged set of this token
    Apply       Achieved            Stage and Commit in one
    Stop        Status              quick stop: silent within the ramp, latched until cleared
    GetStatus   Status              read state and levels
    GetFaults   FaultList           read latched and past faults, newest first
    Clear       Status              acknowledge faults whose cause is gone
    Ping        Status              heartbeat: feeds the watchdog
    LoadEnvelope  Loaded            store an envelope in its slot, for sets that refer to it
    GetMeasured Measured            read voltage and current of each channel
    GetSensors  SensorList          read what its sensors measure, and where
    Measure     Reading             begin to measure tones at all sensors
    GetReading  Reading             read how the tones were measured
    GetBlock    SampleBlock         read raw samples of a sensor
    SetAddress  AddressSet          take another address on the line, if it has this serial number

A Commit, Stop or SetAddress may be broadcast to all amplifiers of a bus; there are no replies then.
"""

import cmath
import math
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import TypeAlias

from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.protocol.extensible_enum import ExtensibleEnum

MEASURING_ERROR = 0.002
"""Of level 1, of amplifiers that measure their levels."""


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


class Fault(ExtensibleEnum):
    """Why an amplifier is in FAULT; NONE otherwise."""

    NONE = 0
    WATCHDOG = 1
    OVER_TEMPERATURE = 2
    OVER_VOLTAGE = 3
    ARC = 4
    CHANNEL = 5
    INTERNAL = 6
    INTERLOCK = 7
    OVER_CURRENT = 8


class Feature(IntFlag):
    """Features of an amplifier; the bits are those on the wire, unknown ones are kept."""

    EVENTS = 1 << 0
    WATCHDOG = 1 << 1
    STAGING = 1 << 2
    VALID_FOR = 1 << 3
    PHASE = 1 << 4
    BROADCAST = 1 << 5
    LEVELS_MEASURED = 1 << 6
    VOLTAGE = 1 << 7
    INTERLOCK = 1 << 8
    ELECTRICAL = 1 << 9
    SENSORS = 1 << 10
    ADDRESS = 1 << 11
    WHOLE = WATCHDOG | STAGING | VALID_FOR | PHASE  # without envelopes, which have no bit


class SensorUnit(ExtensibleEnum):
    """Quantity and unit of a sensor: m/s², m/s, m, N, V."""

    ACCELERATION = 1
    VELOCITY = 2
    DISPLACEMENT = 3
    FORCE = 4
    VOLTAGE = 5


class ReadingState(IntEnum):
    """State of a reading; DISTURBED: complete, but what played changed within its window."""

    NONE = 0
    RUNNING = 1
    COMPLETE = 2
    DISTURBED = 3


class NakCode(ExtensibleEnum):
    """Reason of a refusal."""

    UNKNOWN_TYPE = 1
    BAD_LENGTH = 2
    BAD_VALUE = 3
    BAD_CHANNEL = 4
    WRONG_STATE = 5
    BAD_TOKEN = 6
    BUSY = 7
    UNSUPPORTED_VERSION = 8
    NO_ENVELOPE = 9
    WRONG_SESSION = 10
    WRONG_LATCH = 11
    FADING = 12


@dataclass(frozen=True, slots=True)
class Hello:
    """Identify yourself."""


@dataclass(frozen=True, slots=True)
class GetCaps:
    """Report the capabilities."""


@dataclass(frozen=True, slots=True)
class Arm:
    """Switch on and enable at level zero; watchdog [s]: longest time between heartbeats.

    session: a number drawn for this arming; only requests with it play and feed the watchdog.
    """

    watchdog: float
    session: int = 0


@dataclass(frozen=True, slots=True)
class Disarm:
    """Fall silent along a ramp [s], then switch the high voltage off."""

    ramp: float


@dataclass(frozen=True, slots=True)
class Stage:
    """Keep this set ready; outputs do not change."""

    command_set: CommandSet
    session: int = 0


@dataclass(frozen=True, slots=True)
class Commit:
    """Play the staged set with this token; no effect if it is already playing."""

    token: int
    session: int = 0


@dataclass(frozen=True, slots=True)
class Apply:
    """Stage and commit at once."""

    command_set: CommandSet
    session: int = 0


@dataclass(frozen=True, slots=True)
class Stop:
    """Quick stop: every channel silent along a ramp [s]; stays in QUICK_STOP_ACTIVE until Clear."""

    ramp: float


@dataclass(frozen=True, slots=True)
class GetStatus:
    """Report the status; does not feed the watchdog."""


@dataclass(frozen=True, slots=True)
class GetFaults:
    """Report latched and past faults."""


@dataclass(frozen=True, slots=True)
class Clear:
    """Acknowledge; leave FAULT or QUICK_STOP_ACTIVE if the cause is gone.

    latch: the number of the stop or fault, from a status; a newer one is not acknowledged.
    """

    latch: int


@dataclass(frozen=True, slots=True)
class Ping:
    """Heartbeat: feeds the watchdog of the session while armed."""

    session: int = 0


@dataclass(frozen=True, slots=True)
class LoadEnvelope:
    """Store this envelope in its slot until it is replaced or the supply is lost."""

    envelope: Envelope


@dataclass(frozen=True, slots=True)
class GetMeasured:
    """Report voltage and current of each channel; of amplifiers that measure them."""


@dataclass(frozen=True, slots=True)
class SetAddress:
    """Take another address on the line, for the amplifier of this serial number; others ignore it.

    It keeps the address without supply; disarmed only.
    """

    address: int
    serial_number: str


@dataclass(frozen=True, slots=True)
class GetSensors:
    """Describe the sensors from one on; of amplifiers that have any."""

    first: int = 0


@dataclass(frozen=True, slots=True)
class Measure:
    """Measure tones of these frequencies [Hz] over a window [s] that begins now.

    number: of the reading, drawn by the host; the same request again changes nothing.
    """

    number: int
    window: float
    frequencies: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class GetReading:
    """Report the reading, its sensors from one on."""

    first: int = 0


@dataclass(frozen=True, slots=True)
class GetBlock:
    """Report raw samples of a sensor within the window of the reading, from one on."""

    sensor: int
    sample: int


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of an amplifier; the serial number is unique; versions: of the protocol."""

    vendor: str
    product: str
    serial_number: str
    firmware: str
    versions: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ChannelLimits:
    """Limits of one channel: frequencies [Hz], level."""

    frequency_min: float
    frequency_max: float
    level_max: float


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Capabilities of an amplifier: frequencies [Hz], steps, watchdog range [s], longest ramp [s].

    envelope_knots: most knots of an envelope; envelope_slots: number of slots; envelope steps [s];
    all 0 without envelopes. channel_limits: of each channel; empty: those of the amplifier.
    voices: how many sets a channel can sound at once, while they fade.
    Not on the wire: has_cross_fades: whether a channel can change from one tone to another without
    silence between; has_exact_fades: whether levels follow the protocol's curve while they change.
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
    channel_limits: tuple[ChannelLimits, ...] = ()
    features: Feature = field(kw_only=True)
    voices: int = 2
    has_cross_fades: bool = field(default=True, kw_only=True)
    has_exact_fades: bool = field(default=True, kw_only=True)

    @property
    def limits_of_channels(self) -> tuple[ChannelLimits, ...]:
        """The limits of each channel."""
        each = ChannelLimits(self.frequency_min, self.frequency_max, self.level_max)
        return self.channel_limits or (each,) * self.channels


@dataclass(frozen=True, slots=True)
class Status:
    """Status of an amplifier: state, fault, playing token and present level of each channel.

    token 0: nothing played since arming; temperature [°C], NaN if not measured;
    watchdog_left [s]; voltage [V] of the high-voltage supply, 0 if not measured; latch: number of
    the last stop or fault, 0 before the first; other_flags: those that are not defined here.
    """

    state: AmplifierState
    fault: Fault
    token: int
    high_voltage: bool
    temperature: float
    watchdog_left: float
    levels: tuple[float, ...]
    voltage: float = 0.0
    latch: int = 0
    interlock_open: bool = False
    other_flags: int = 0


@dataclass(frozen=True, slots=True)
class Achieved:
    """Playback of the set of a token, after the amplifier's quantisation."""

    token: int
    commands: tuple[DriveCommand, ...]


@dataclass(frozen=True, slots=True)
class FaultRecord:
    """A fault and its age [s]."""

    fault: Fault
    channel: int | None
    age: float


@dataclass(frozen=True, slots=True)
class FaultList:
    """Latched and past faults, newest first."""

    faults: tuple[FaultRecord, ...]


@dataclass(frozen=True, slots=True)
class Loaded:
    """Confirmation that a slot holds an envelope with this number of knots."""

    slot: int
    knots: int


@dataclass(frozen=True, slots=True)
class Measurement:
    """Voltage [V] and current [A] of a channel, both rms."""

    voltage: float
    current: float


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of each channel."""

    channels: tuple[Measurement, ...]


@dataclass(frozen=True, slots=True)
class Sensor:
    """Sensor of an amplifier: its unit, and the channel whose actuator it sits at, if any.

    x, y [m]: its place on the plate, None if the amplifier does not know it. range: its largest
    reading; frequency_max [Hz]: of its tones; sample_rate [Hz]: of raw samples, 0 for none;
    count_step: of one count of a raw sample. Ranges and steps are in its unit.
    """

    unit: SensorUnit
    channel: int | None
    x: float | None
    y: float | None
    range: float
    frequency_max: float
    sample_rate: int = 0
    count_step: float = 0.0


@dataclass(frozen=True, slots=True)
class SensorList:
    """Sensors from the one that was asked for on, as many as fit; count: of all."""

    count: int
    sensors: tuple[Sensor, ...]


@dataclass(frozen=True, slots=True)
class ToneReading:
    """One tone at one sensor: amplitude × sin(2π f t + phase) [unit of the sensor, degrees]."""

    amplitude: float
    phase: float

    @property
    def phasor(self) -> complex:
        """Complex amplitude, of which the signal is Im[phasor exp(i 2π f t)]."""
        return cmath.rect(self.amplitude, math.radians(self.phase))


@dataclass(frozen=True, slots=True)
class SensorReading:
    """The tones of a reading at one sensor; is_overloaded: it was beyond its range."""

    tones: tuple[ToneReading, ...]
    is_overloaded: bool = False


@dataclass(frozen=True, slots=True)
class Reading:
    """The reading of a number, its sensors from the one that was asked for on, as many as fit.

    left [s]: until it is complete, without sensors before; start [s]: t at the first sample, 0 if
    nothing was played (token 0); saturates after 71 minutes.
    """

    number: int
    state: ReadingState
    left: float = 0.0
    start: float = 0.0
    token: int = 0
    tone_count: int = 0
    sensors: tuple[SensorReading, ...] = ()


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Raw samples [counts] of a sensor, numbered from 0 at the start of the reading's window.

    first: number of the first one here; end: the number after the newest so far.
    """

    number: int
    first: int
    end: int
    samples: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class AddressSet:
    """Confirmation of an address, still sent from the one before."""

    address: int


@dataclass(frozen=True, slots=True)
class AmplifierEvent:
    """A change of state, or a fault; channel: the one at fault, if any."""

    state: AmplifierState
    fault: Fault
    channel: int | None = None


@dataclass(frozen=True, slots=True)
class Nak:
    """Refusal: reason, and the channel at fault, if any. Nothing of the request was applied."""

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
    | GetMeasured
    | GetSensors
    | Measure
    | GetReading
    | GetBlock
    | SetAddress
)
Reply: TypeAlias = (
    Identity
    | Capabilities
    | Status
    | Achieved
    | FaultList
    | Loaded
    | Measured
    | SensorList
    | Reading
    | SampleBlock
    | AddressSet
    | Nak
)
Broadcast: TypeAlias = Commit | Stop | SetAddress
