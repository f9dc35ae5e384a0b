"""One simulated amplifier: requests in, replies out; time is passed in.

Events happen at their own time: a watchdog that expired between two calls expired when it was due,
and outputs are descriptions in time (`sim.waveform`), not samples.

Not modelled: the rise time of high voltage, and the voltage waveform of a tone.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, TypeAlias

from drivers.command import CommandSet
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AddressSet,
    AmplifierEvent,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Fault,
    FaultList,
    FaultRecord,
    Feature,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    Hello,
    Identity,
    LoadEnvelope,
    Measure,
    Measured,
    Measurement,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    SetAddress,
    Stage,
    Status,
    Stop,
)
from sim.amplifier.channels import Channels, PlayableSet
from sim.amplifier.set_store import RefusedSet, SetStore
from sim.amplifier.states import ENABLED, next_state
from sim.amplifier.thermal_model import DERATE_ABOVE, DERATED, FAULT_ABOVE, GOOD_BELOW, ThermalState
from sim.waveform import Output

SILENCING_RAMP = 0.005  # s; a fault must be silent 5 ms after the watchdog expires
_Q = PROTOCOL.quantities
_FAULTS_KEPT = 16
_HIGH_VOLTAGE = 1800.0  # V
_CAPACITANCE = 1e-9  # F; of an actuator
_DISCHARGE = 0.02  # s; time constant of the supply once it is off
_SLOTS = 63
VOICES = 8
"""Voices of a channel: enough for a set every 10 ms that fades along 50 ms."""

FEATURES = (
    Feature.WHOLE
    | Feature.EVENTS
    | Feature.BROADCAST
    | Feature.INTERLOCK
    | Feature.ELECTRICAL
    | Feature.ADDRESS
)
_ENDING = (AmplifierState.SWITCHED_ON, AmplifierState.FAULT_REACTION_ACTIVE)
_LATCHED = (AmplifierState.QUICK_STOP_ACTIVE, AmplifierState.FAULT)
_FEEDING_REQUESTS = (Arm, Ping, Stage, Commit, Apply)  # with the session that is held
_STAGING_REQUESTS = (Stage, Commit)

SensorRequest: TypeAlias = GetSensors | Measure | GetReading | GetBlock


class SensorPort(Protocol):
    """Sensors that an amplifier reports."""

    def handle(self, request: SensorRequest, now: float) -> Reply:
        """Reply to a request at a time [s]."""

    def changed(self, moment: float) -> None:
        """Note that what plays changes at a time [s]."""

    def forget(self) -> None:
        """Forget the reading, as without supply."""


def capabilities(channels: int, voices: int = VOICES) -> Capabilities:
    """Capabilities of a simulated amplifier with these numbers of channels and voices."""
    return Capabilities(
        channels=channels,
        frequency_min=10.0,  # the guard's floor: below it a plate only rocks
        frequency_max=_Q.frequency.high,
        frequency_step=_Q.frequency.step,
        level_max=_Q.level.high,
        level_step=_Q.level.step,
        phase_step=_Q.phase.step,
        ramp_max=_Q.ramp.high,
        watchdog_min=_Q.watchdog.low,
        watchdog_max=_Q.watchdog.high,
        envelope_knots=_Q.envelope_knots.maximum,
        envelope_slots=_SLOTS,
        envelope_step_min=0.001,
        envelope_step_max=_Q.envelope_step.high,
        features=FEATURES,
        voices=voices,
    )


class SimulatedAmplifier:
    """An amplifier with a name, and numbers of channels and voices; times [s] of any one clock.

    listeners: called with every change of state or fault, and its time [s]. capabilities: others
    hold from the next restart. is_output: whether its levels and outputs are of a voltage.
    """

    def __init__(
        self, name: str, *, channels: int, voices: int = VOICES, is_output: bool = False
    ) -> None:
        self.identity = Identity(
            vendor="era-haptics",
            product="simulated amplifier",
            serial_number=f"SIM-{name}",
            firmware="1",
            versions=(PROTOCOL.version,),
        )
        self.capabilities = capabilities(channels, voices)
        if is_output:
            features = FEATURES | Feature.VOLTAGE
            self.capabilities = replace(self.capabilities, features=features)
        self.state = AmplifierState.SWITCH_ON_DISABLED
        self.fault = Fault.NONE
        self.listeners: list[Callable[[AmplifierEvent, float], None]] = []
        self._heat = ThermalState(since=-math.inf)
        self._faults: deque[tuple[Fault, int | None, float]] = deque(maxlen=_FAULTS_KEPT)
        self.session = 0  # held while armed, or the one that ended last
        self.latch = 0
        self._is_interlock_open = False
        self.committed_at = -math.inf  # [s]; of the set played last
        self._sensing: SensorPort | None = None
        self._start()

    def attach(self, sensing: SensorPort) -> None:
        """Give it sensors."""
        self._sensing = sensing
        features = self.capabilities.features | Feature.SENSORS
        self.capabilities = replace(self.capabilities, features=features)

    @property
    def token(self) -> int:
        """Token of the set played last since arming; 0: none."""
        return self._sets.token

    def _start(self) -> None:
        """Reset all but the temperature and the fault history."""
        self._channels = Channels(self.capabilities.channels, self.capabilities.voices)
        self._sets = SetStore(self.capabilities)
        self._watchdog = 0.0
        self._last_fed = 0.0
        self._vibration_end = math.inf
        self._silent_from = -math.inf  # end of the last silencing ramp
        self._is_derated = False

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The output of each channel from now on, without further events.

        The same object until they change.
        """
        return self._channels.outputs

    @property
    def next_event(self) -> float:
        """Time of the next event [s], up to which `outputs` holds."""
        if self.state not in ENABLED:
            return min(self._vibration_end, self._silence_reached)
        return min(self._vibration_end, self._watchdog_end, self._overtemperature_from)

    @property
    def is_derated(self) -> bool:
        """Whether its levels are reduced, until a tick finds it cool again."""
        return self._is_derated

    def tick(self, now: float) -> None:
        """Process the events due by now, in order."""
        while (moment := self.next_event) <= now:
            if moment == self._vibration_end:
                self._channels.end(moment)
                self._vibration_end = math.inf
                self._changed(moment)
            elif moment == self._watchdog_end:
                self.trip(Fault.WATCHDOG, moment)
            elif moment == self._silence_reached:
                silent = self.state is AmplifierState.FAULT_REACTION_ACTIVE
                self._enter(
                    AmplifierState.FAULT if silent else AmplifierState.SWITCH_ON_DISABLED, moment
                )
            else:
                self._handle_overtemperature(moment)
        if self._is_derated and self._heat.at(now) < GOOD_BELOW:
            self._is_derated = False

    def handle(self, request: Request, now: float) -> Reply:
        """Reply to a request at a time [s]; a Nak means that nothing was applied."""
        self.tick(now)
        following = next_state(self.state, type(request))
        if isinstance(request, _STAGING_REQUESTS) and Feature.STAGING not in self._features:
            return Nak(NakCode.UNKNOWN_TYPE)
        if following is None:
            return Nak(NakCode.WRONG_STATE)
        if isinstance(request, _FEEDING_REQUESTS) and self._is_foreign(request.session, request):
            return Nak(NakCode.WRONG_SESSION)
        if isinstance(request, Arm) and self._is_interlock_open:
            return Nak(NakCode.WRONG_STATE)
        try:
            reply = self._carry_out(request, following, now)
        except RefusedSet as refusal:
            reply = refusal.nak
        is_feeding = isinstance(request, _FEEDING_REQUESTS) and self.state in ENABLED
        if is_feeding and not isinstance(reply, Nak):
            self._last_fed = now
        # After feeding the watchdog, so that the status shows it full.
        return self.status(now) if reply is None else reply

    def status(self, now: float) -> Status:
        """Status at a time [s] up to which it has been ticked."""
        levels = self._channels.levels(now)
        is_watched = self.state in ENABLED and Feature.WATCHDOG in self._features
        left = self._last_fed + self._watchdog - now if is_watched else 0.0
        is_on = self.state in (AmplifierState.SWITCHED_ON, *ENABLED) or any(levels)
        decayed = math.exp(min(0.0, (self._silent_from - now) / _DISCHARGE))
        return Status(
            state=self.state,
            fault=self.fault,
            token=self._sets.token,
            high_voltage=is_on,
            temperature=self._heat.at(now),
            watchdog_left=left,
            levels=levels,
            voltage=_HIGH_VOLTAGE if is_on else round(_HIGH_VOLTAGE * decayed),
            latch=self.latch,
            interlock_open=self._is_interlock_open,
        )

    def trip(self, fault: Fault, moment: float, *, channel: int | None = None) -> None:
        """Enter a fault: silent within the shortest ramp, then high voltage off, latched.

        While disarmed it is only added to the fault history.
        """
        self._faults.appendleft((fault, channel, moment))
        if self.state in (*ENABLED, AmplifierState.SWITCHED_ON, AmplifierState.QUICK_STOP_ACTIVE):
            self._silence(moment, ramp=SILENCING_RAMP)
            self.fault = fault
            self._count_latch()
            self._enter(AmplifierState.FAULT_REACTION_ACTIVE, moment, channel=channel)

    def set_interlock(self, moment: float, *, is_open: bool) -> None:
        """Open or close the interlock, with its consequences."""
        if is_open and self.state is not AmplifierState.SWITCH_ON_DISABLED:
            self.trip(Fault.INTERLOCK, moment)
        self._is_interlock_open = is_open

    def set_temperature(self, temperature: float, moment: float) -> None:
        """Set the temperature [°C], with its consequences."""
        self._heat = ThermalState(moment, temperature, self._heat.final)
        if temperature > DERATE_ABOVE and not self._is_derated:
            self._handle_overtemperature(moment)
        if temperature > FAULT_ABOVE:
            self._handle_overtemperature(moment)

    def restart(self, moment: float) -> None:
        """Power-cycle: silent at once, disarmed, without sets and envelopes."""
        self._heat = ThermalState(moment, self._heat.at(moment))
        self.fault = Fault.NONE
        self._start()
        if self._sensing is not None:
            self._sensing.forget()
        self._enter(AmplifierState.SWITCH_ON_DISABLED, moment)

    def _carry_out(self, request: Request, following: AmplifierState, now: float) -> Reply | None:
        """Execute an allowed request; None where the reply is the status."""
        match request:
            case Hello():
                return self.identity
            case GetCaps():
                return self.capabilities
            case GetFaults():
                return FaultList(
                    tuple(
                        FaultRecord(fault, channel, now - at) for fault, channel, at in self._faults
                    )
                )
            case Arm(watchdog=watchdog, session=session):
                return self._arm(watchdog, session, now)
            case Disarm(ramp=ramp) | Stop(ramp=ramp):
                if isinstance(request, Stop):
                    self._count_latch()
                self._silence(now, ramp=self._stopping_ramp(ramp))
                self._enter(following, now)
                self.tick(now)
            case Clear(latch=latch):
                if latch != self.latch and self.state in _LATCHED:
                    return Nak(NakCode.WRONG_LATCH)
                if self._silent_from <= now and self._is_cause_gone(now):
                    self.fault = Fault.NONE
                    self._enter(following, now)
            case SetAddress(address=address):
                return AddressSet(address)
            case GetMeasured():
                return self._measured(now)
            case GetSensors() | Measure() | GetReading() | GetBlock():
                if self._sensing is None or Feature.SENSORS not in self._features:
                    return Nak(NakCode.UNKNOWN_TYPE)
                return self._sensing.handle(request, now)
            case LoadEnvelope(envelope=envelope):
                return self._sets.load(envelope)
            case Stage(command_set=wanted):
                return self._sets.stage(self._prepared(wanted), now)
            case Commit(token=token):
                active = self._sets.active
                if active is not None and active.token == token:
                    return active.achieved
                return self._play(self._sets.staged_as(token, now), now)
            case Apply(command_set=wanted):
                active = self._sets.active
                if active is not None and self._sets.is_repeated(wanted):
                    return active.achieved
                return self._play(self._prepared(wanted), now)
            case _:  # GetStatus, Ping
                pass
        return None

    def _measured(self, now: float) -> Reply:
        """What a capacitor of a typical actuator draws at the present levels."""
        if Feature.ELECTRICAL not in self._features:
            return Nak(NakCode.UNKNOWN_TYPE)
        channels = []
        for level, output in zip(self._channels.levels(now), self.outputs, strict=True):
            # Force goes with the voltage squared, at half the frequency.
            voltage = _HIGH_VOLTAGE * math.sqrt(level / 2)
            frequency = max((tone.frequency for tone in output), default=0.0) / 2
            channels.append(Measurement(voltage, 2 * math.pi * frequency * _CAPACITANCE * voltage))
        return Measured(tuple(channels))

    def _is_foreign(self, session: int, request: Request) -> bool:
        """Whether a session is not the one that is held, or to arm, has ended."""
        if self.state in ENABLED:
            return session != self.session
        return isinstance(request, Arm) and session == self.session != 0

    def _count_latch(self) -> None:
        """Number a stop or fault: 1 to 255, then 1 again."""
        self.latch = self.latch % _Q.latch.maximum + 1

    def _arm(self, watchdog: float, session: int, now: float) -> Reply | None:
        low, high = self.capabilities.watchdog_min, self.capabilities.watchdog_max
        if not low <= watchdog <= high:
            return Nak(NakCode.BAD_VALUE)
        self._watchdog = watchdog
        if self.state in ENABLED:  # the same again: its reply was lost
            return None
        # Arming starts at level zero, even if the last session left a fade.
        self._silence(now, ramp=SILENCING_RAMP)
        self.session = session
        self._last_fed = now
        self._sets.forget()
        self._enter(AmplifierState.OPERATION_ENABLED, now)
        return None

    def _prepared(self, wanted: CommandSet) -> PlayableSet:
        return self._sets.prepare(wanted, derating_factor=self._derating_factor)

    def _play(self, playable: PlayableSet, now: float) -> Achieved:
        """Play a set now, unless a channel has no room for it."""
        channel = self._channels.without_room(playable, now)
        if channel is not None:
            raise RefusedSet(NakCode.FADING, channel)
        self._sets.activate(playable)
        self._channels.play(playable, now)
        self.committed_at = now
        self._changed(now)
        wanted = playable.command_set
        ends = wanted.valid_for > 0 and not wanted.is_silent
        self._vibration_end = now + wanted.valid_for if ends else math.inf
        return playable.achieved

    @property
    def _features(self) -> Feature:
        return self.capabilities.features

    @property
    def _derating_factor(self) -> float:
        """Factor on every level."""
        return DERATED if self._is_derated else 1.0

    def _stopping_ramp(self, ramp: float) -> float:
        """The nearest allowed ramp: a stop is never refused for its ramp."""
        if math.isnan(ramp):
            return SILENCING_RAMP
        return min(max(ramp, 0.0), self.capabilities.ramp_max)

    def _silence(self, moment: float, *, ramp: float) -> None:
        """Silence every channel within the ramp [s], and discard the staged set."""
        self._channels.silence(moment, ramp=ramp)
        self._silent_from = self._channels.silent_from(moment)
        self._vibration_end = math.inf
        self._sets.staged = None
        self._changed(moment)

    def _enter(self, state: AmplifierState, moment: float, *, channel: int | None = None) -> None:
        """Enter a state, and notify the listeners of a change."""
        event = AmplifierEvent(state, self.fault, channel)
        if state is not self.state:
            self.state = state
            for listener in self.listeners:
                listener(event, moment)

    @property
    def _watchdog_end(self) -> float:
        if self.state not in ENABLED or Feature.WATCHDOG not in self._features:
            return math.inf
        return self._last_fed + self._watchdog

    @property
    def _silence_reached(self) -> float:
        return self._silent_from if self.state in _ENDING else math.inf

    @property
    def _overtemperature_from(self) -> float:
        if self.state not in ENABLED:
            return math.inf
        return self._heat.when(FAULT_ABOVE if self._is_derated else DERATE_ABOVE)

    def _changed(self, moment: float) -> None:
        """Note that what plays changes."""
        if self._sensing is not None:
            self._sensing.changed(moment)
        self._heat = self._heat.driven(moment, load=self._channels.load)

    def _handle_overtemperature(self, moment: float) -> None:
        """Derate at the lower threshold, trip at the higher."""
        if self._is_derated:
            self.trip(Fault.OVER_TEMPERATURE, moment)
            return
        self._is_derated = True
        self._channels.derate(moment, DERATED)
        self._changed(moment)

    def _is_cause_gone(self, now: float) -> bool:
        """Whether the cause of the fault no longer persists."""
        if self.fault is Fault.INTERLOCK:
            return not self._is_interlock_open
        return self.fault is not Fault.OVER_TEMPERATURE or self._heat.at(now) < GOOD_BELOW
