"""One simulated amplifier: requests in, replies out, by a clock that is handed in.

Everything happens at its own time: a watchdog that ran out between two calls ran out when it did,
and what a channel plays is a description in time (`sim.waveform`), not samples. Nothing here reads
a clock or knows a wire.

Not modelled: the time high voltage takes to rise, the voltage waveform behind a tone, temperature
(always 25 °C), and every fault but the watchdog's.
"""

import math
from collections import deque
from collections.abc import Sequence

from drivers.command import CommandSet, DriveCommand
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Fault,
    FaultList,
    FaultRecord,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    LoadEnvelope,
    Nak,
    NakCode,
    Reply,
    Request,
    Stage,
    State,
    Status,
    Stop,
)
from sim.amplifier_states import ENABLED, next_state
from sim.quantiser import RefusedSet, check_and_quantise
from sim.waveform import Output, fade_to, level_of

SILENCING_RAMP = 0.005  # s; a fault must be silent within 5 ms of the watchdog's expiry
_Q = PROTOCOL.quantities
_FAULTS_KEPT = 16
_TOKENS_REMEMBERED = 16  # duplicates of old sets are older than a few exchanges at most
_NOT_FEEDING = (Hello, GetCaps, GetStatus, GetFaults)


def capabilities(channels: int) -> Capabilities:
    """What a simulated amplifier with so many channels can play."""
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
        envelope_knots=0,
    )


class SimulatedAmplifier:
    """An amplifier by its name, with a number of channels; times are seconds of any one clock."""

    def __init__(self, name: str, *, channels: int) -> None:
        self.identity = Identity(
            vendor="era-haptics",
            product="simulated amplifier",
            serial_number=f"SIM-{name}",
            firmware="1",
            protocol_version=PROTOCOL.version,
        )
        self.capabilities = capabilities(channels)
        self.state = State.SWITCH_ON_DISABLED
        self.fault = Fault.NONE
        self._outputs: list[Output] = [()] * channels
        self._staged: CommandSet | None = None
        self._active: CommandSet | None = None
        self._tokens: deque[int] = deque(maxlen=_TOKENS_REMEMBERED)
        self._faults: deque[tuple[Fault, float]] = deque(maxlen=_FAULTS_KEPT)
        self._watchdog = 0.0
        self._fed = 0.0
        self._vibration_end = math.inf
        self._ramp = 0.0  # of the set that plays
        self._silent_from = -math.inf  # when the last silence that was ordered is reached

    @property
    def outputs(self) -> Sequence[Output]:
        """What each channel plays from now on, if nothing else happens."""
        return tuple(self._outputs)

    @property
    def next_event(self) -> float:
        """When something will happen by itself: the time up to which `outputs` holds."""
        events = [self._vibration_end]
        if self.state in ENABLED:
            events.append(self._fed + self._watchdog)
        if self.state in (State.SWITCHED_ON, State.FAULT_REACTION_ACTIVE):
            events.append(self._silent_from)
        return min(events)

    def tick(self, now: float) -> None:
        """Let happen what is due by now, in its order and each thing at its own time."""
        while (moment := self.next_event) <= now:
            if moment == self._vibration_end:
                self._silence(moment, ramp=self._ramp)
            elif self.state in ENABLED:
                self._trip(moment)
            elif self.state is State.FAULT_REACTION_ACTIVE:
                self.state = State.FAULT
            else:
                self.state = State.SWITCH_ON_DISABLED

    def handle(self, request: Request, now: float) -> Reply:
        """Answer a request that arrives now [s]; a Nak means that nothing was applied."""
        self.tick(now)
        following = next_state(self.state, type(request))
        if following is None:
            return Nak(NakCode.WRONG_STATE)
        reply = self._carry_out(request, following, now)
        if not isinstance(request, _NOT_FEEDING) and not isinstance(reply, Nak):
            self._fed = now
        # A watchdog that is fed by this very request is full when its status is told.
        return self.status(now) if reply is None else reply

    def status(self, now: float) -> Status:
        """How the amplifier is at a time [s] up to which it has been ticked."""
        most = self.capabilities.level_max  # the sum of two fades may round to a little above it
        levels = tuple(min(level_of(output, now), most) for output in self._outputs)
        left = self._fed + self._watchdog - now if self.state in ENABLED else 0.0
        return Status(
            state=self.state,
            fault=self.fault,
            token=self._active.token if self._active else 0,
            high_voltage=self.state in (State.SWITCHED_ON, *ENABLED) or any(levels),
            temperature=25.0,
            watchdog_left=left,
            levels=levels,
        )

    def _carry_out(self, request: Request, following: State, now: float) -> Reply | None:
        """Do what is asked in a state that allows it; None where the reply is the status."""
        match request:
            case Hello():
                return self.identity
            case GetCaps():
                return self.capabilities
            case GetFaults():
                return FaultList(
                    tuple(FaultRecord(fault, None, now - at) for fault, at in self._faults)
                )
            case Arm(watchdog=watchdog):
                return self._arm(watchdog, now)
            case Disarm(ramp=ramp) | Stop(ramp=ramp):
                self._silence(now, ramp=self._stopping_ramp(ramp))
                self.state = following
                self.tick(now)
            case Clear():
                if self._silent_from <= now:  # else the level is not zero yet
                    self.state, self.fault = following, Fault.NONE
            case Stage(command_set=wanted):
                return self._stage(wanted)
            case Commit(token=token):
                return self._commit(token, now)
            case Apply(command_set=wanted):
                if self._active is not None and self._active.token == wanted.token:
                    return Achieved(self._active.token, self._active.commands)
                reply = self._stage(wanted)
                return reply if isinstance(reply, Nak) else self._commit(wanted.token, now)
            case LoadEnvelope():  # it has no slots
                return Nak(NakCode.UNKNOWN_TYPE)
            case _:  # GetStatus and Ping ask for nothing more
                pass
        return None

    def _arm(self, watchdog: float, now: float) -> Reply | None:
        low, high = self.capabilities.watchdog_min, self.capabilities.watchdog_max
        if not low <= watchdog <= high:
            return Nak(NakCode.BAD_VALUE)
        # To arm means level zero, also for an amplifier that another host has left playing.
        self._silence(now, ramp=SILENCING_RAMP)
        self.state = State.OPERATION_ENABLED
        self._watchdog = watchdog
        self._active = None
        self._tokens.clear()
        return None

    def _stage(self, wanted: CommandSet) -> Reply:
        if wanted.token in self._tokens:  # a late copy, which must not oust what is staged now
            return Nak(NakCode.BAD_TOKEN)
        try:
            staged = check_and_quantise(wanted, self.capabilities)
        except RefusedSet as refusal:
            return refusal.nak
        self._staged = staged
        return Achieved(staged.token, staged.commands)

    def _commit(self, token: int, now: float) -> Reply:
        if self._active is not None and self._active.token == token:
            return Achieved(token, self._active.commands)
        if self._staged is None or self._staged.token != token:
            return Nak(NakCode.BAD_TOKEN)
        wanted, self._staged = self._staged, None
        commands = {command.channel: command for command in wanted.commands}
        for channel, playing in enumerate(self._outputs):
            command = commands.get(channel, DriveCommand(channel, 0.0, 0.0))
            self._outputs[channel] = fade_to(
                playing,
                now,
                ramp=wanted.ramp,
                frequency=command.frequency,
                level=command.level,
                phase=math.radians(command.phase),
                keep_phase=command.keep_phase,
            )
        self._active = wanted
        self._tokens.append(token)
        ends = wanted.valid_for > 0 and not wanted.is_silent
        self._vibration_end = now + wanted.valid_for if ends else math.inf
        self._ramp = wanted.ramp
        return Achieved(token, wanted.commands)

    def _stopping_ramp(self, ramp: float) -> float:
        """A ramp that can be played: a stop is never refused for its ramp."""
        if math.isnan(ramp):
            return SILENCING_RAMP
        return min(max(ramp, 0.0), self.capabilities.ramp_max)

    def _silence(self, moment: float, *, ramp: float) -> None:
        """Every channel falls silent within the ramp [s], and nothing staged is left."""
        self._outputs = [fade_to(output, moment, ramp=ramp) for output in self._outputs]
        ends = [tone.silent_from for output in self._outputs for tone in output]
        self._silent_from = max([moment, *ends])
        self._vibration_end = math.inf
        self._staged = None

    def _trip(self, moment: float) -> None:
        """The host has been silent for too long."""
        self._silence(moment, ramp=SILENCING_RAMP)
        self.state = State.FAULT_REACTION_ACTIVE
        self.fault = Fault.WATCHDOG
        self._faults.appendleft((Fault.WATCHDOG, moment))
