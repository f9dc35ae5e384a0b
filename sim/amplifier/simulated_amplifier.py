"""One simulated amplifier: requests in, replies out; time is passed in.

Requests and replies are the values of their records (`drivers.protocol.definition`), integers of
the wire. Events happen at their own time: a watchdog that expired between two calls expired when it
was due. Playback is a description in time (`drivers.playing`), not samples.

`AMPLIFIER_TRANSITIONS` lists the requests that are allowed in each state, and the next state;
any other request is rejected (WRONG_STATE). Transitions without a request: OPERATION_ENABLED to
FAULT_REACTION_ACTIVE when the watchdog expires, from there to FAULT once silent; SWITCHED_ON,
entered by Disarm, to SWITCH_ON_DISABLED once silent. Clear needs silence. Arm passes through
READY_TO_SWITCH_ON and SWITCHED_ON immediately.

Not modeled: the rise time of high voltage, the voltage waveform of a tone, and the distortion of
a limited sum of layers.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto

from drivers.playing import Playback, playback_of
from drivers.protocol.definition import (
    AHEAD_MAX,
    FAULTS,
    HIGH_WORDS,
    MESSAGES,
    NO_CHANNEL,
    QUANTITIES,
    STATES,
    STATUS_FLAGS,
    VERSION,
    high_word,
)
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import is_last, token_after
from drivers.voices import Voice
from sim.amplifier.amplifier_clock import AmplifierClock
from sim.amplifier.readings import (
    LIMITED,
    AmplifierSummary,
    FaultRecord,
    achieved,
    capabilities,
    exceeds_full,
    fault_list,
    measured,
    with_readings,
)
from sim.amplifier.set_intake import Layers, SetIntake
from sim.amplifier.thermal_state import (
    DERATE_ABOVE,
    DERATED,
    FAULT_ABOVE,
    GOOD_BELOW,
    ThermalState,
)

SILENCING_RAMP = 0.005  # s; a fault must be silent 5 ms after the watchdog expires
_FAULTS_KEPT = 16
_DISCHARGE = 0.02  # s; time constant of the supply once it is off
_DERATING_RAMP = 0.02  # s; no click
_ENABLED = "OPERATION_ENABLED"
_ONCE_SILENT = {"SWITCHED_ON": "SWITCH_ON_DISABLED", "FAULT_REACTION_ACTIVE": "FAULT"}
"""The state that follows by itself once all channels are silent."""
_LATCHED = ("QUICK_STOP_ACTIVE", "FAULT")
_Q = QUANTITIES
_OFF = ("SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON")
_KEPT_BY_STOP = ("NOT_READY", "FAULT_REACTION_ACTIVE", "FAULT")
_PLAYING = ("Set", "Commit", "Silence")
_CHANGING = (*_PLAYING, "Arm", "Disarm", "Stop", "Clear", "SetAddress")

AMPLIFIER_TRANSITIONS: Mapping[tuple[str, str], str] = {
    **{(state, name): state for state in STATES for name in MESSAGES if name not in _CHANGING},
    **{("OPERATION_ENABLED", name): "OPERATION_ENABLED" for name in _PLAYING},
    **{
        (state, "Arm"): "OPERATION_ENABLED" for state in (*_OFF, "SWITCHED_ON", "OPERATION_ENABLED")
    },
    # Silencing is allowed in every state, and never clears a latched stop or fault.
    **{(state, "Disarm"): state for state in STATES},
    ("OPERATION_ENABLED", "Disarm"): "SWITCHED_ON",
    **{(state, "Stop"): "QUICK_STOP_ACTIVE" for state in STATES if state not in _KEPT_BY_STOP},
    **{(state, "Stop"): state for state in _KEPT_BY_STOP},
    **{(state, "Clear"): state for state in STATES},
    ("QUICK_STOP_ACTIVE", "Clear"): "SWITCH_ON_DISABLED",
    ("FAULT", "Clear"): "SWITCH_ON_DISABLED",
    **{(state, "SetAddress"): state for state in _OFF},
}
"""The state after a request, by state and name of the request."""


class _Event(Enum):
    """An event that happens without a request; simultaneous ones happen in this order."""

    SET_STARTS = auto()
    LAYER_IS_DUE = auto()
    SILENT = auto()
    WATCHDOG_EXPIRES = auto()
    TOO_HOT = auto()


@dataclass(frozen=True)
class _WaitingSet:
    """A committed set that plays at a moment [s]; commit: values of its Commit."""

    moment: float
    commit: Values
    layers: Layers


class SimulatedAmplifier:
    """An amplifier with a name and a number of channels; times [s] of any one clock.

    listeners: called with the values of every Event, and its time [s]. capabilities: changes take
    effect at the next restart. clock: reference of phases, by default without errors.
    """

    is_answering = True
    playback: Playback
    """The voices of all channels."""
    session: int
    """The current session while armed, or the last one; 0 before the first."""
    is_derated: bool
    """Whether levels are lowered because it is hot."""
    silent_from: float
    """When the last ramp to silence ends [s]."""
    _channels: range
    _intake: SetIntake
    _waiting: _WaitingSet | None
    _watchdog: float
    """Time without feeding after which the watchdog expires [s]."""
    _last_fed: float
    """When the watchdog was fed [s]."""
    _discharged_from: float
    """When the last ramp to silence with high voltage ended [s]."""
    _marked: int | None
    """Clock at a Mark that no status has shown."""
    _is_limited: bool
    """Whether a sum of layers was limited since the last status."""
    _shown_mark: int | None
    """The mark that the last status has shown."""
    _has_shown_limited: bool
    """Whether the last status has shown a limited sum."""

    def __init__(
        self,
        name: str,
        *,
        channels: int,
        is_output: bool = False,
        clock: AmplifierClock | None = None,
    ) -> None:
        self.identity: Values = {
            "versions": 1 << VERSION,
            "vendor": "era-haptics",
            "product": "simulated amplifier",
            "serial_number": f"SIM-{name}",
            "firmware": "1",
        }
        self.capabilities = capabilities(channels, is_output=is_output)
        self.state = "SWITCH_ON_DISABLED"
        self.fault = "NONE"
        self.latch = 0
        self.listeners: list[Callable[[Values, float], None]] = []
        self._faults: deque[FaultRecord] = deque(maxlen=_FAULTS_KEPT)
        self._heat = ThermalState(since=-math.inf)
        self._is_interlock_open = False
        self.clock = AmplifierClock() if clock is None else clock
        self._start()

    def _start(self) -> None:
        """Begin without sets, session and watchdog, by the present capabilities.

        State, fault, latch, fault history, temperature and interlock are not changed.
        """
        self.playback = playback_of(self.capabilities)
        self.session = 0
        self.is_derated = False
        self.silent_from = -math.inf
        self._channels = range(self.playback.channels)
        self._intake = SetIntake(self.capabilities)
        self._waiting = None
        self._watchdog = 0.0
        self._last_fed = 0.0
        self._discharged_from = -math.inf
        self._marked = None
        self._is_limited = False
        self._shown_mark = None
        self._has_shown_limited = False

    @property
    def outputs(self) -> Sequence[tuple[Voice, ...]]:
        """The voices of each channel from now on, without further events."""
        return self.playback.all_voices

    @property
    def next_event(self) -> float:
        """Time of the next event [s]; playback is known until then."""
        moment, _ = self._next()
        return moment

    def _next(self) -> tuple[float, _Event]:
        """Return the next event and its time [s], infinite if none is due."""
        moment = self.playback.next_due
        event = _Event.LAYER_IS_DUE
        if self._waiting is not None and self._waiting.moment <= moment:
            moment = self._waiting.moment
            event = _Event.SET_STARTS
        if self.state in _ONCE_SILENT and self.silent_from < moment:
            return self.silent_from, _Event.SILENT
        if self.state != _ENABLED:
            return moment, event
        expires_at = self._last_fed + self._watchdog
        if expires_at < moment:
            moment = expires_at
            event = _Event.WATCHDOG_EXPIRES
        hot_at = self._heat.when(FAULT_ABOVE if self.is_derated else DERATE_ABOVE)
        if hot_at < moment:
            return hot_at, _Event.TOO_HOT
        return moment, event

    def tick(self, now: float) -> None:
        """Process the events due at now, in order."""
        moment, event = self._next()
        while moment <= now:
            self._process(event, moment)
            moment, event = self._next()
        self.playback.advance(now)
        if self.is_derated and self._heat.at(now) < GOOD_BELOW:
            self.is_derated = False

    def _process(self, event: _Event, moment: float) -> None:
        """Carry out an event at its time [s]."""
        match event:
            case _Event.SET_STARTS:
                self._start_waiting(moment)
            case _Event.LAYER_IS_DUE:
                self.playback.advance(moment)
                self._changed(moment)
            case _Event.SILENT:
                self._enter(_ONCE_SILENT[self.state], moment)
            case _Event.WATCHDOG_EXPIRES:
                self.trip("WATCHDOG", moment)
            case _Event.TOO_HOT:
                self._handle_overtemperature(moment)

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Carry out a request at a time [s], and return the values of its reply.

        They are empty for a part of a set other than the last. Raises Refusal; the request is then
        not applied.
        """
        self.tick(now)
        if name == "Set" and not is_last(values):
            is_held = self.state == _ENABLED and values["session"] == self.session
            if is_held and self._intake.keep(values, now):
                self.feed(now)
            return {}
        message = MESSAGES[name]
        following = AMPLIFIER_TRANSITIONS.get((self.state, name))
        if following is None or (name == "Arm" and self._is_interlock_open):
            raise Refusal(f"{name} must not come in state {self.state}", "WRONG_STATE")
        if message.feeds and self._is_foreign(values["session"], name):
            raise Refusal(f"{name} must have the session that is held", "WRONG_SESSION")
        reply = self._carry_out(name, values, following, now)
        if message.feeds and self.state == _ENABLED:
            self.feed(now)
        if reply is not None:
            return reply
        # After feeding the watchdog, so that the status shows it full.
        status = self.status(now)
        self._acknowledge_status(now)
        return status

    def feed(self, now: float) -> None:
        """Restart the watchdog at a time [s]."""
        self._last_fed = now

    def status(self, now: float) -> Values:
        """Return the values of the status at a time [s] up to which it has been ticked."""
        levels = self._levels(now)
        is_on = self._is_high_voltage(levels)
        flags = {
            "high_voltage": is_on,
            "interlock_open": self._is_interlock_open,
            "limited": self._is_shown_limited(now),
        }
        clock = self.clock.reading(now) if self._marked is None else self._marked
        watchdog_left = 0.0
        if self.state == _ENABLED:
            watchdog_left = max(self._last_fed + self._watchdog - now, 0.0)
        layers = self.capabilities["layers"]
        tokens = self.playback.tokens
        status = {
            "state": STATES[self.state],
            "fault": FAULTS[self.fault],
            "flags": sum(1 << STATUS_FLAGS[flag] for flag, is_set in flags.items() if is_set),
            "latch": self.latch,
            "watchdog_left": _Q["watchdog_left"].to_wire(watchdog_left),
            "clock": clock,
            "token": self._intake.committed,
            "channels": len(levels),
            "layers": layers,
            "levels": [_Q["level"].to_wire(level) for level in levels],
            "tokens": [tokens.get(layer, 0) for layer in range(layers)],
        }
        supply = 1.0 if is_on else self._discharging_supply(now)
        return with_readings(status, temperature=self._heat.at(now), supply=supply)

    def _is_shown_limited(self, now: float) -> bool:
        """Whether a status at a time [s] shows that the sum of layers exceeds full level.

        It does if the sum exceeds full level on a channel then, or has since the last status.
        """
        if self._is_limited:
            return True
        return any(self.playback.level(channel, now) > LIMITED for channel in self._channels)

    def _discharging_supply(self, now: float) -> float:
        """Supply voltage relative to its nominal value at a time [s] while it is off."""
        elapsed = max(0.0, now - self._discharged_from)
        return math.exp(-elapsed / _DISCHARGE)

    def _acknowledge_status(self, now: float) -> None:
        """Note that a status at a time [s] has shown the mark and the limited sum."""
        self._shown_mark = self._marked
        self._has_shown_limited = self._is_shown_limited(now)
        self._marked = None
        self._is_limited = False

    def withdraw_status(self) -> None:
        """Withdraw the last status, as after a broadcast: the next one shows the same."""
        self._marked = self._shown_mark
        self._is_limited = self._has_shown_limited

    def summary(self, now: float) -> AmplifierSummary:
        """Return its state at the time [s] of the last tick, without the effects of a status."""
        levels = self._levels(now)
        return AmplifierSummary(
            state=self.state,
            fault=self.fault,
            token=self._intake.committed,
            is_high_voltage=self._is_high_voltage(levels),
            levels=levels,
        )

    def _levels(self, now: float) -> tuple[float, ...]:
        """Return the level of each channel, rounded to its step."""
        quantise = _Q["level"].quantise
        levels = []
        for channel in self._channels:
            levels.append(quantise(min(self.playback.level(channel, now), 1.0)))
        return tuple(levels)

    def _is_high_voltage(self, levels: Sequence[float]) -> bool:
        """Whether high voltage is on at these levels of all channels."""
        return self.state in ("SWITCHED_ON", _ENABLED) or any(levels)

    def trip(self, fault: str, moment: float, *, channel: int | None = None) -> None:
        """Enter a fault: silent within the shortest ramp, then high voltage off, latched.

        While disarmed the fault is only added to the fault history.
        """
        self._faults.appendleft(FaultRecord(fault, channel, moment))
        if self.state in (_ENABLED, "SWITCHED_ON", "QUICK_STOP_ACTIVE"):
            self._silence(moment, ramp=SILENCING_RAMP)
            self.fault = fault
            self.latch = token_after(self.latch)
            self._enter("FAULT_REACTION_ACTIVE", moment, channel=channel)

    def set_interlock(self, moment: float, *, is_open: bool) -> None:
        """Open or close the interlock.

        Opening it is a fault, except of a disarmed amplifier, which only rejects Arm meanwhile.
        """
        if is_open and self.state != "SWITCH_ON_DISABLED":
            self.trip("INTERLOCK", moment)
        self._is_interlock_open = is_open

    def set_temperature(self, temperature: float, moment: float) -> None:
        """Set the temperature [°C], with its consequences."""
        self._heat = ThermalState(moment, temperature, self._heat.final)
        self._obey_temperature(moment)

    def _obey_temperature(self, moment: float) -> None:
        """Derate or trip if the temperature is above a threshold already."""
        temperature = self._heat.at(moment)
        if temperature > DERATE_ABOVE and not self.is_derated:
            self._handle_overtemperature(moment)
        if temperature > FAULT_ABOVE:
            self._handle_overtemperature(moment)

    def restart(self, moment: float) -> None:
        """Power-cycle: immediately silent and disarmed, without sets, fault and latch.

        The fault history is kept.
        """
        self._heat = ThermalState(moment, self._heat.at(moment))
        self.fault = "NONE"
        self.latch = 0
        self._start()
        self.clock.restart(moment)
        self._enter("SWITCH_ON_DISABLED", moment)

    def _carry_out(self, name: str, values: Values, following: str, now: float) -> Values | None:
        """Execute an allowed request; None if the reply is the status."""
        match name:
            case "GetCaps":
                return self.capabilities
            case "GetFaults":
                return fault_list(self._faults, now)
            case "Arm":
                self._arm(values, now)
            case "Disarm" | "Stop":
                self._disarm_or_stop(name, values, following, now)
            case "Silence":
                self._silence_channels(values, now)
            case "Ping" if self.state == _ENABLED:
                self._steer_clock(values["rate"], now)
            case "Clear":
                self._clear(values["latch"], following, now)
            case "Set":
                return self._take_part(values, now)
            case "Commit":
                self._commit(values, now)
            case "Mark":
                self._marked = self.clock.reading(now)
            case "GetAchieved":
                return self._achieved(values["layer"])
            case "GetMeasured":
                channels = list(measured(self.playback, now))
                return {"count": len(channels), "channels": channels}
            case "SetAddress":
                if values["serial_number"] != self.identity["serial_number"]:
                    raise Refusal("serial number must be this amplifier's")
        return None

    def _disarm_or_stop(self, name: str, values: Values, following: str, now: float) -> None:
        """Silence all channels, and enter the state that follows; a stop is latched."""
        if name == "Stop":
            self.latch = token_after(self.latch)
        ramp = min(values["ramp"], self.capabilities["ramp_max"])
        self._silence(now, ramp=_Q["ramp"].from_wire(ramp))
        self._enter(following, now)
        self.tick(now)

    def _silence_channels(self, values: Values, now: float) -> None:
        """Silence all channels; unlike Disarm and Stop, reject a ramp that is too long."""
        limit = self.capabilities["ramp_max"]
        if values["ramp"] > limit:
            raise Refusal(f"ramp must be at most {limit}, got {values['ramp']}")
        self._silence(now, ramp=_Q["ramp"].from_wire(values["ramp"]))

    def _steer_clock(self, rate: int, now: float) -> None:
        """Set the rate of the clock, which can change the moment of a waiting set."""
        self.clock.steer(rate, now)
        if self._waiting is not None:
            self._play_when(self._waiting.layers, self._waiting.commit, now)

    def _commit(self, commit: Values, now: float) -> None:
        """Play the staged set at the moment that its Commit names."""
        layers = self._intake.commit(commit["token"], now)
        if layers is not None:
            self._start_waiting(now)
            self._play_when(layers, commit, now)

    def _achieved(self, layer: int) -> Values:
        """Return the values of GetAchieved for a layer; raises Refusal for an unknown layer."""
        count = self.capabilities["layers"]
        if layer >= count:
            raise Refusal(f"layer must be 0 to {count - 1}, got {layer}")
        return achieved(self.playback, layer)

    def _is_foreign(self, session: int, name: str) -> bool:
        """Whether a session is not the current one or, for arming, has ended."""
        if self.state == _ENABLED:
            return session != self.session
        return name == "Arm" and session == self.session

    def _arm(self, values: Values, now: float) -> None:
        """Arm for a session, with a watchdog; raises Refusal."""
        watchdog = values["watchdog"]
        low, high = self.capabilities["watchdog_min"], self.capabilities["watchdog_max"]
        if not low <= watchdog <= high:
            raise Refusal(f"watchdog must be {low} to {high}, got {watchdog}")
        self._watchdog = _Q["watchdog"].from_wire(watchdog)
        if self.state == _ENABLED:  # repeated, because its reply was lost
            return
        # Arming starts at level zero, even if the last session left a fade.
        self._silence(now, ramp=SILENCING_RAMP)
        self._intake.forget()
        self.session = values["session"]
        self.clock.shift(values["shift"])
        self.feed(now)
        self._enter(_ENABLED, now)
        self._obey_temperature(now)

    def _clear(self, latch: int, following: str, now: float) -> None:
        """Clear a stop or a fault with this latch, if its cause is gone; raises Refusal."""
        if self.state in _LATCHED and latch != self.latch:
            raise Refusal(f"latch must be {self.latch}, got {latch}", "WRONG_LATCH")
        if self.silent_from <= now and self.is_cause_gone(now):
            self.fault = "NONE"
            self._enter(following, now)

    def _take_part(self, part: Values, now: float) -> Values:
        """Take the last part of a set, and play the set if it is complete and to play now.

        Returns the values of the reply; raises Refusal.
        """
        token = part["token"]
        if token == self._intake.committed:  # a repetition
            return self._set_reply(token, is_played=True)
        taken = self._intake.take(part, now)
        if taken.missing is not None:
            return self._set_reply(token, missing=taken.missing)
        if not part["now"]:
            return self._set_reply(token, is_staged=True)
        self._intake.commit(token, now)
        self._start_waiting(now)
        self._play(taken.layers, token, now)
        return self._set_reply(token, is_played=True)

    def _set_reply(
        self, token: int, *, is_staged: bool = False, is_played: bool = False, missing: int = 0
    ) -> Values:
        """Return the values of the reply to a set; missing: the first part that is missing."""
        is_complete = is_staged or is_played
        return {
            "token": token,
            "exact": is_complete and not self.is_derated,
            "staged": is_staged,
            "played": is_played,
            "missing": missing,
        }

    def _play_when(self, layers: Layers, commit: Values, now: float) -> None:
        """Play a committed set at the moment that its Commit names, if that is shortly ahead."""
        at = commit["at"]
        self._waiting = None
        if 1 <= (at - high_word(self.clock.reading(now))) % HIGH_WORDS <= AHEAD_MAX:
            self._waiting = _WaitingSet(self.clock.reaches(at, now), commit, layers)
        else:
            self._play(layers, commit["token"], now)

    def _start_waiting(self, moment: float) -> None:
        """Play the set that waits for a moment, if there is one."""
        waiting = self._waiting
        if waiting is not None:
            self._waiting = None
            self._play(waiting.layers, waiting.commit["token"], moment)

    def _play(self, layers: Layers, token: int, now: float) -> None:
        """Start the layers of a set at a time [s]."""
        allowed_layers = layers
        if self.is_derated:
            allowed_layers = tuple([layer.scaled(DERATED) for layer in layers])
        self.playback.commit(allowed_layers, token, now)
        if all(layer.renew for layer in layers):
            return
        self._is_limited |= any(
            exceeds_full(self.playback, channel, now) for channel in self._channels
        )
        self._changed(now)

    def _silence(self, moment: float, *, ramp: float) -> None:
        """Silence every channel within the ramp [s], and discard staged and waiting sets."""
        self.playback.silence(moment, ramp)
        self.silent_from = max(self.playback.silent_from, moment)
        if self.state in ("SWITCHED_ON", _ENABLED):
            self._discharged_from = self.silent_from
        self._intake.drop()
        self._waiting = None
        self._changed(moment)

    def _enter(self, state: str, moment: float, *, channel: int | None = None) -> None:
        """Enter a state, and notify the listeners of a change."""
        if state == self.state:
            return
        if self.state == _ENABLED:
            self.clock.steer(0, moment)
        self.state = state
        event = {
            "state": STATES[state],
            "fault": FAULTS[self.fault],
            "latch": self.latch,
            "channel": NO_CHANNEL if channel is None else channel,
        }
        for listener in self.listeners:
            listener(event, moment)

    def _changed(self, moment: float) -> None:
        """Record a change of playback."""
        levels = self.playback.settled_levels
        mean_square = sum([level**2 for level in levels]) / len(levels)
        self._heat = self._heat.driven(moment, load=mean_square)

    def _handle_overtemperature(self, moment: float) -> None:
        """Derate at the lower threshold, trip at the higher."""
        if self.is_derated:
            self.trip("OVER_TEMPERATURE", moment)
            return
        self.is_derated = True
        self.playback.scale(moment, DERATED, _DERATING_RAMP)
        self._changed(moment)

    def is_cause_gone(self, now: float) -> bool:
        """Whether the cause of the fault no longer persists."""
        if self.fault == "INTERLOCK":
            return not self._is_interlock_open
        return self.fault != "OVER_TEMPERATURE" or self._heat.at(now) < GOOD_BELOW
