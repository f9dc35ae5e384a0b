"""One simulated amplifier: requests in, replies out; time is passed in.

Requests and replies are the values of their records (`drivers.protocol.definition`), integers of
the wire. Events happen at their own time: a watchdog that expired between two calls expired when it
was due, and playback is a description in time (`drivers.playing`), not samples.

`AMPLIFIER_TRANSITIONS` has the requests that are allowed in each state, and the state that follows;
any other request is refused (WRONG_STATE). Transitions without a request: OPERATION_ENABLED to
FAULT_REACTION_ACTIVE when the watchdog expires, from there to FAULT once silent; SWITCHED_ON,
entered by Disarm, to SWITCH_ON_DISABLED once silent. Clear needs silence. Arm passes through
READY_TO_SWITCH_ON and SWITCHED_ON at once.

Not modelled: the rise time of high voltage, the voltage waveform of a tone, and the distortion
where the sum of layers is limited.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

from drivers.playing import Voice, playback_of
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
from drivers.protocol.sets import (
    Assembly,
    Command,
    LayerSet,
    is_last,
    is_newer_token,
    token_after,
    unpack_layers,
)
from sim.amplifier.readings import (
    DERATE_ABOVE,
    DERATED,
    FAULT_ABOVE,
    GOOD_BELOW,
    LIMITED,
    AmplifierClock,
    AmplifierSummary,
    FaultRecord,
    ThermalState,
    achieved,
    capabilities,
    exceeds_full,
    fault_list,
    measured,
    with_readings,
)

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

Layers: TypeAlias = tuple[LayerSet, ...]


class SetIntake:
    """Takes the parts of sets, and stores a complete set until it is committed.

    capabilities: values of its record. committed: token of the set committed last, 0 for none.
    One set is under way at most: collected, or staged.
    """

    def __init__(self, capabilities: Values) -> None:
        self.capabilities = capabilities
        self.committed = 0
        self._parts = Assembly()  # of the set under way
        self._staged: Layers | None = None  # of the same, once it is whole

    def keep(self, part: Values, now: float) -> bool:
        """Take a part but the last at a time [s]; returns whether it is kept."""
        token, under_way = part["token"], self._under_way(now)
        is_newer = token != under_way and is_newer_token(token, under_way)
        is_under_way = token == under_way and self._staged is None
        if not (is_newer_token(token, self.committed) and (is_newer or is_under_way)):
            return False
        if is_newer:
            self._staged = None
        return self._parts.keep(part, now)

    def take(self, part: Values, now: float) -> Layers | int:
        """Take the last part of a set that was not committed, at a time [s].

        Returns the layers that are staged now, or the number of the first part that is missing.
        Raises Refusal; this drops only the parts of this set, and only if it is complete.
        """
        token, under_way = part["token"], self._under_way(now)
        is_under_way = token == under_way
        if is_under_way and self._staged is not None:  # it came again
            return self._staged
        for other in (self.committed, 0 if is_under_way else under_way):
            if not is_newer_token(token, other):
                raise Refusal(f"token must be newer than {other}, got {token}", "BAD_TOKEN")
        if part["index"] >= part["parts"]:
            raise Refusal(f"index must be below {part['parts']}, got {part['index']}")
        if is_under_way and part["parts"] != self._parts.count:
            raise Refusal(f"parts must be {self._parts.count} as before, got {part['parts']}")
        stream = self._parts.whole(part)
        if isinstance(stream, int):
            return stream
        try:
            layers = self._checked(stream)
        except Refusal:
            if is_under_way:
                self.drop()
            raise
        if not is_under_way:
            self._parts = Assembly(token, part["parts"], now)
        self._staged = layers
        return layers

    def commit(self, token: int, now: float) -> Layers | None:
        """Return the layers of the staged set; None if it was already committed.

        Raises Refusal if none is staged under this token.
        """
        if token == self.committed:
            return None
        if token != self._under_way(now):
            raise Refusal(f"no set is staged under token {token}", "BAD_TOKEN")
        if self._staged is None:
            raise Refusal(f"all parts of set {token} must come first", "INCOMPLETE")
        layers, self.committed = self._staged, token
        self.drop()
        return layers

    def drop(self) -> None:
        """Discard everything not committed."""
        self._parts, self._staged = Assembly(), None

    def forget(self) -> None:
        """Discard all, with the token committed last."""
        self.drop()
        self.committed = 0

    def _under_way(self, now: float) -> int:
        """Return the token of the set that is collected or staged, 0 for none."""
        if self._parts.is_expired(now):
            self.drop()
        return self._parts.token

    def _checked(self, stream: Sequence[int]) -> Layers:
        if len(stream) > self.capabilities["set_words"]:
            room = self.capabilities["set_words"]
            raise Refusal(f"a set must have at most {room} words", "BAD_LENGTH")
        return unpack_layers(stream, self.capabilities)


def derated(layers: Sequence[LayerSet], factor: float) -> tuple[LayerSet, ...]:
    """Return the layers with all levels, also of knots, times a factor."""

    def command_of(command: Command) -> Command:
        return replace(
            command,
            level=round(command.level * factor),
            onset=command.onset and command.onset.scaled(factor),
            ending=command.ending and command.ending.scaled(factor),
        )

    return tuple(
        replace(layer, commands=tuple(map(command_of, layer.commands))) for layer in layers
    )


SILENCING_RAMP = 0.005  # s; a fault must be silent 5 ms after the watchdog expires
_FAULTS_KEPT = 16
_DISCHARGE = 0.02  # s; time constant of the supply once it is off
_DERATING_RAMP = 0.02  # s; no click
_ENABLED = "OPERATION_ENABLED"
_ENDING = ("SWITCHED_ON", "FAULT_REACTION_ACTIVE")
_LATCHED = ("QUICK_STOP_ACTIVE", "FAULT")
_Q = QUANTITIES


class SimulatedAmplifier:
    """An amplifier with a name and a number of channels; times [s] of any one clock.

    listeners: called with the values of every Event, and its time [s]. capabilities: others hold
    from the next restart. session: held while armed, or the last one. clock: reference of
    phases, by default without errors.
    """

    is_answering = True

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
        """Reset all but the temperature and the fault history."""
        can = self.capabilities
        self.playback = playback_of(can)
        self._channels = range(self.playback.channels)
        self._intake = SetIntake(can)
        self.session = 0
        self._waiting: tuple[float, Values, Layers] | None = None  # moment [s], Commit
        self._marked: int | None = None  # clock of a Mark that no status has shown
        # By the last status: this, and whether a sum was limited.
        self._shown_once: tuple[int | None, bool] = None, False
        self._watchdog = 0.0
        self._last_fed = 0.0
        self.token = 0
        """Token of the last set since arming that changed the playback; 0: none."""
        self.silent_from = -math.inf  # end of the last silencing ramp
        self._discharged_from = -math.inf  # of the last one while high voltage was on
        self._is_limited = False
        self.is_derated = False

    @property
    def outputs(self) -> Sequence[tuple[Voice, ...]]:
        """The voices of each channel from now on, without further events."""
        return self.playback.all_voices

    @property
    def next_event(self) -> float:
        """Time of the next event [s]; playback is known until then."""
        due = self.playback.next_due
        if self._waiting is not None:
            due = min(due, self._waiting[0])
        if self.state != _ENABLED:
            return min(due, self.silent_from if self.state in _ENDING else math.inf)
        hot = self._heat.when(FAULT_ABOVE if self.is_derated else DERATE_ABOVE)
        return min(due, self._last_fed + self._watchdog, hot)

    def tick(self, now: float) -> None:
        """Process the events due at now, in order."""
        while (moment := self.next_event) <= now:
            if self._waiting is not None and moment == self._waiting[0]:
                self._start_waiting(moment)
            elif moment == self.playback.next_due:
                self.playback.advance(moment)
                self._changed(moment)
            elif self.state == _ENABLED and moment == self._last_fed + self._watchdog:
                self.trip("WATCHDOG", moment)
            elif self.state != _ENABLED:
                fell_silent = self.state == "FAULT_REACTION_ACTIVE"
                self._enter("FAULT" if fell_silent else "SWITCH_ON_DISABLED", moment)
            else:
                self._handle_overtemperature(moment)
        self.playback.advance(now)
        if self.is_derated and self._heat.at(now) < GOOD_BELOW:
            self.is_derated = False

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Return the values of the reply to a request at a time [s]; none to a part but the last.

        Raises Refusal, which means that nothing was applied.
        """
        self.tick(now)
        if name == "Set" and not is_last(values):
            is_held = self.state == _ENABLED and values["session"] == self.session
            if is_held and self._intake.keep(values, now):
                self.feed(now)
            return {}
        message, following = MESSAGES[name], AMPLIFIER_TRANSITIONS.get((self.state, name))
        if following is None or (name == "Arm" and self._is_interlock_open):
            raise Refusal(f"{name} must not come in state {self.state}", "WRONG_STATE")
        if message.feeds and self._is_foreign(values["session"], name):
            raise Refusal(f"{name} must have the session that is held", "WRONG_SESSION")
        reply = self._carry_out(name, values, following, now)
        if message.feeds and self.state == _ENABLED:
            self.feed(now)
        # After feeding the watchdog, so that the status shows it full.
        return self.status(now) if reply is None else reply

    def feed(self, now: float) -> None:
        """Restart the watchdog at a time [s]."""
        self._last_fed = now

    def status(self, now: float) -> Values:
        """Return the values of the status at a time [s] up to which it has been ticked."""
        levels, is_on = self._levels(now)
        left = self._last_fed + self._watchdog - now if self.state == _ENABLED else 0.0
        # A sum that lasts is limited again and again.
        self._is_limited |= any(self.playback.level(each, now) > LIMITED for each in self._channels)
        flags = {
            "high_voltage": is_on,
            "interlock_open": self._is_interlock_open,
            "limited": self._is_limited,
        }
        self._shown_once = self._marked, self._is_limited
        self._is_limited = False
        clock = self.clock.reading(now) if self._marked is None else self._marked
        self._marked = None
        tokens = self.playback.tokens
        layers = self.capabilities["layers"]
        return with_readings(
            {
                "state": STATES[self.state],
                "fault": FAULTS[self.fault],
                "flags": sum(1 << STATUS_FLAGS[each] for each, is_set in flags.items() if is_set),
                "latch": self.latch,
                "watchdog_left": _Q["watchdog_left"].to_wire(max(left, 0.0)),
                "clock": clock,
                "token": self._intake.committed,
                "channels": len(levels),
                "layers": layers,
                "levels": [_Q["level"].to_wire(level) for level in levels],
                "tokens": [tokens.get(layer, 0) for layer in range(layers)],
            },
            temperature=self._heat.at(now),
            supply=1.0 if is_on else math.exp(min(0.0, (self._discharged_from - now) / _DISCHARGE)),
        )

    def withdraw_status(self) -> None:
        """Withdraw the last status, as after a broadcast: the next one shows the same."""
        self._marked, self._is_limited = self._shown_once

    def summary(self, now: float) -> AmplifierSummary:
        """Return its state at the time [s] of the last tick, without the effects of a status."""
        levels, is_on = self._levels(now)
        return AmplifierSummary(self.state, self.fault, self._intake.committed, is_on, levels)

    def _levels(self, now: float) -> tuple[tuple[float, ...], bool]:
        """Return the level of each channel, to its step, and whether high voltage is on."""
        level = _Q["level"].quantise
        levels = tuple([level(min(self.playback.level(each, now), 1.0)) for each in self._channels])
        return levels, self.state in ("SWITCHED_ON", _ENABLED) or any(levels)

    def trip(self, fault: str, moment: float, *, channel: int | None = None) -> None:
        """Enter a fault: silent within the shortest ramp, then high voltage off, latched.

        While disarmed it is only added to the fault history.
        """
        self._faults.appendleft((fault, channel, moment))
        if self.state in (_ENABLED, "SWITCHED_ON", "QUICK_STOP_ACTIVE"):
            self.silence(moment, ramp=SILENCING_RAMP)
            self.fault = fault
            self.latch = token_after(self.latch)
            self._enter("FAULT_REACTION_ACTIVE", moment, channel=channel)

    def set_interlock(self, moment: float, *, is_open: bool) -> None:
        """Open or close the interlock, with its consequences."""
        if is_open and self.state != "SWITCH_ON_DISABLED":
            self.trip("INTERLOCK", moment)
        self._is_interlock_open = is_open

    def set_temperature(self, temperature: float, moment: float) -> None:
        """Set the temperature [°C], with its consequences."""
        self._heat = ThermalState(moment, temperature, self._heat.final)
        if temperature > DERATE_ABOVE and not self.is_derated:
            self._handle_overtemperature(moment)
        if temperature > FAULT_ABOVE:
            self._handle_overtemperature(moment)

    def restart(self, moment: float) -> None:
        """Power-cycle: immediately silent, disarmed, without sets."""
        self._heat = ThermalState(moment, self._heat.at(moment))
        self.fault = "NONE"
        self._start()
        self.clock.restart(moment)
        self._enter("SWITCH_ON_DISABLED", moment)

    def _carry_out(self, name: str, values: Values, following: str, now: float) -> Values | None:
        """Execute an allowed request; None where the reply is the status."""
        match name:
            case "GetCaps":
                return self.capabilities
            case "GetFaults":
                return fault_list(self._faults, now)
            case "Arm":
                self._arm(values, now)
            case "Disarm" | "Stop":
                if name == "Stop":
                    self.latch = token_after(self.latch)
                ramp = min(values["ramp"], self.capabilities["ramp_max"])
                self.silence(now, ramp=_Q["ramp"].from_wire(ramp))
                self._enter(following, now)
                self.tick(now)
            case "Silence":
                if values["ramp"] > self.capabilities["ramp_max"]:
                    limit = self.capabilities["ramp_max"]
                    raise Refusal(f"ramp must be at most {limit}, got {values['ramp']}")
                self.silence(now, ramp=_Q["ramp"].from_wire(values["ramp"]))
            case "Ping" if self.state == _ENABLED:
                self.clock.steer(values["rate"], now)
                if self._waiting is not None:
                    _, commit, waiting = self._waiting
                    self._play_when(waiting, commit, now)
            case "Clear":
                self._clear(values["latch"], following, now)
            case "Set":
                return self.take_part(values, now)
            case "Commit":
                layers = self._intake.commit(values["token"], now)
                if layers is not None:
                    self._start_waiting(now)
                    self._play_when(layers, values, now)
            case "Mark":
                self._marked = self.clock.reading(now)
            case "GetAchieved":
                layer, count = values["layer"], self.capabilities["layers"]
                if layer >= count:
                    raise Refusal(f"layer must be 0 to {count - 1}, got {layer}")
                return achieved(self.playback, layer)
            case "GetMeasured":
                channels = list(measured(self.playback, now))
                return {"count": len(channels), "channels": channels}
            case "SetAddress":
                if values["serial_number"] != self.identity["serial_number"]:
                    raise Refusal("serial number must be this amplifier's")
        return None

    def _is_foreign(self, session: int, name: str) -> bool:
        """Whether a session is not the current one or, for arming, has ended."""
        if self.state == _ENABLED:
            return session != self.session
        return name == "Arm" and session == self.session

    def _arm(self, values: Values, now: float) -> None:
        watchdog = values["watchdog"]
        low, high = self.capabilities["watchdog_min"], self.capabilities["watchdog_max"]
        if not low <= watchdog <= high:
            raise Refusal(f"watchdog must be {low} to {high}, got {watchdog}")
        self._watchdog = _Q["watchdog"].from_wire(watchdog)
        if self.state == _ENABLED:  # the same again: its reply was lost
            return
        # Arming starts at level zero, even if the last session left a fade.
        self.silence(now, ramp=SILENCING_RAMP)
        self._intake.forget()
        self.token = 0
        self.session = values["session"]
        self.clock.shift(values["shift"])
        self.feed(now)
        self._enter(_ENABLED, now)

    def _clear(self, latch: int, following: str, now: float) -> None:
        if self.state in _LATCHED and latch != self.latch:
            raise Refusal(f"latch must be {self.latch}, got {latch}", "WRONG_LATCH")
        if self.silent_from <= now and self.is_cause_gone(now):
            self.fault = "NONE"
            self._enter(following, now)

    def take_part(self, part: Values, now: float) -> Values:
        """Take the last part of a set, and play the set if it is complete and so requests."""
        token = part["token"]
        taken = None if token == self._intake.committed else self._intake.take(part, now)
        is_missing = isinstance(taken, int)
        is_staged = not (taken is None or is_missing or part["now"])
        if isinstance(taken, tuple) and part["now"]:
            self._intake.commit(token, now)
            self._start_waiting(now)
            self.play(taken, token, now)
        return {
            "token": token,
            "exact": not (is_missing or self.is_derated),
            "staged": is_staged,
            "played": not (is_missing or is_staged),
            "missing": taken if is_missing else 0,
        }

    def _play_when(self, layers: Layers, commit: Values, now: float) -> None:
        """Play a committed set at the moment that its Commit names, if that is shortly ahead."""
        at, self._waiting = commit["at"], None
        if 1 <= (at - high_word(self.clock.reading(now))) % HIGH_WORDS <= AHEAD_MAX:
            self._waiting = self.clock.reaches(at, now), commit, layers
        else:
            self.play(layers, commit["token"], now)

    def _start_waiting(self, moment: float) -> None:
        """Play the set that waits for a moment, if there is one."""
        if self._waiting is not None:
            _, commit, layers = self._waiting
            self._waiting = None
            self.play(layers, commit["token"], moment)

    def play(self, layers: Layers, token: int, now: float) -> None:
        """Start the layers of a set at a time [s]."""
        wanted = derated(layers, DERATED) if self.is_derated else layers
        self.playback.commit(wanted, token, now)
        if all(layer.renew for layer in layers):
            return
        self.token = token
        self._is_limited |= any(
            exceeds_full(self.playback, channel, now) for channel in self._channels
        )
        self._changed(now)

    def silence(self, moment: float, *, ramp: float) -> None:
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
        squares = (self.playback.settled(channel) ** 2 for channel in self._channels)
        self._heat = self._heat.driven(moment, load=sum(squares) / len(self._channels))

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
