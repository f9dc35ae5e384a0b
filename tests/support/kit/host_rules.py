"""Rules for what a host sends, judged at the wires of its control loop in virtual time.

`HostRules` sees each request when the host hands it to a wire, and each reply when it arrives, so
it knows exactly what the host knows of an amplifier. A test also tells it about fingers, operator's
commands, stalls of the control loop and injected faults. Times are in s.

During a fault and for `RECOVERY` afterwards deadlines are not judged, since a request or its reply
may be lost; limits, stops, sessions and tokens are judged at all times.

The rules by name:

- `limits`: frequency, level and slew of each channel, over all its layers, stay within its limits.
- `enabled`: no vibrating set goes to an amplifier that the host knows to be disarmed.
- `session`: sets belong to the session that armed; nothing feeds an amplifier of another host.
- `token`: a token names one set, and tokens ascend.
- `commit`: if one amplifier plays a set, all amplifiers that have it play it, or are silenced.
- `stop`: a stop is the next request, is repeated until confirmed, and holds until it is cleared.
- `heartbeat`: enabled amplifiers are fed in time, but not while the control loop stalls.
- `armed`: an amplifier is armed only after an operator's request.
- `identified`: an amplifier is identified after its wire was opened, and before it is armed.
- `credit`: a request waits for the reply to the previous one on its wire, unless it silences.
- `justified`: no vibration is commanded without a contact.
- `pattern`: a set is the expected one, if one is given.
- `lift`: after the last lift, a silencing request and silence follow in time.
- `touch`: a new contact leads to a pattern in time.
"""

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Hashable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal, TypeAlias, get_args

from controller.operation.plate_controller import Controller
from drivers.host.line import Line
from drivers.opening import Lines
from drivers.playing import Playback
from drivers.protocol.definition import ENABLED, LATCHED, MESSAGES, QUANTITIES, STATES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import (
    Command,
    LayerSet,
    is_last,
    is_newer_token,
    is_vibrating,
    unpack_layers,
)
from drivers.voices import Voice
from drivers.wires.wire import (
    Arrival,
    BrokenReply,
    Event,
    Nak,
    OtherHost,
    Reply,
    WireAddress,
    address_of,
)
from era_haptics.lab.expectations.expected_outputs import silent
from registry import threads
from sim.faults import FaultWindow

OperatorCommand = Literal["arm", "disarm", "stop", "clear"]
Tone: TypeAlias = tuple[float, float, float]
"""Frequency [Hz], level, phase [degrees]."""
ExpectedSets = Mapping[str, Mapping[int, Sequence[Tone]]]
"""Expected tones by amplifier and channel, over all layers."""

RECOVERY = 0.5
"""Time after a fault during which deadlines are not judged."""

_FEEDING = frozenset(name for name, message in MESSAGES.items() if message.feeds)
_SILENCING = frozenset(["Stop", "Disarm", "Silence"])
_READING = frozenset(["GetStatus"])
_IDENTIFYING = frozenset(["Hello", "GetCaps"])
_IN_FLIGHT = 0.003  # a request that was queued before a reply came may still be sent
_READING_TIMEOUT = 0.010 - _IN_FLIGHT  # after which a reading gives way to another request
_OTHER_HOST_PAUSE = 2.0  # nothing is fed for so long after another host was heard
_ATTEMPTS = 3  # of a request without a reply
_STOP_INTERVAL = 0.1  # of an unconfirmed stop, for each amplifier of its wire
_STOP_DURATION = 0.3  # after which the host reports a stop as unconfirmed
_REORDER_WINDOW = 0.020  # of two operator's commands, the first may be sent last
_TOKENS_KEPT = 16
_STEP = 0.6  # of a step of the wire: tolerance of rounding
_SUM_TOLERANCE = 1.01
_TRANSITION_POINTS = 16  # at which sums are computed along a transition
_LEVEL_TOLERANCE = 0.002
_FREQUENCY, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("frequency", "level", "phase"))
_RAMP = QUANTITIES["ramp"]
_FAULTED = frozenset([STATES["FAULT"], STATES["FAULT_REACTION_ACTIVE"]])


@dataclass(frozen=True)
class RuleViolation:
    """A broken rule, when, and what happened."""

    rule: str
    time: float
    problem: str

    def __str__(self) -> str:
        return f"{self.time:.6f} {self.rule}: {self.problem}"


@dataclass(frozen=True)
class ChannelLimits:
    """Limits of every channel: count, frequencies [Hz], level, slew [1/s]."""

    channels: int = 4
    frequency: tuple[float, float] = (40.0, 500.0)
    level: float = 1.0
    slew: float = math.inf


@dataclass(frozen=True)
class HostTimes:
    """Longest times.

    heartbeat: between requests that feed the watchdog; reply: until a reply; together: until all
    amplifiers play a set; lift, release: from the last lift to a silencing request, to silence;
    touch: from a touch to its pattern; stop: from an operator's stop to its request; slack: added
    to all of them.
    """

    heartbeat: float = 0.075
    reply: float = 0.030
    together: float = 0.020
    lift: float = 0.020
    release: float = 0.060
    touch: float = 0.100
    stop: float = 0.020
    slack: float = 0.001


@dataclass(eq=False)
class HostedAmplifier:
    """One amplifier: what the host has sent to it, and what it knows of it by replies."""

    name: str
    wire: str
    address: int
    is_open: bool = True
    is_identified: bool | None = None
    """None until its wire was opened once."""
    layer_count: float = math.inf
    state: int | None = None
    """As the last reply or Event showed it; None while unknown."""
    state_since: float = -math.inf
    is_replied: bool = False
    """Whether a reply has shown the state; an Event of a fault may cross a set."""
    session: int | None = None
    """The session that armed it."""
    armed_at: float = -math.inf
    parts: dict[int, dict[int, Sequence[int]]] = field(default_factory=dict)
    """Words of the parts of the set that is sent, by token and index."""
    last_set: tuple[int, tuple[LayerSet, ...]] = (0, ())
    """Token and layers of the last set since Arm."""
    staged: tuple[int, tuple[LayerSet, ...]] | None = None
    """The last set, unless it was silenced or refused since."""
    committed: "deque[int]" = field(default_factory=lambda: deque(maxlen=_TOKENS_KEPT))
    """Tokens of the sets that it was to play."""
    committed_token: int | None = None
    """Token of the last of them since Arm; None if it was refused."""
    committed_at: float = -math.inf
    played: Playback = field(default_factory=silent)
    silenced_at: float = -math.inf
    is_stopped: bool = False
    """Whether a stop was sent that was not cleared yet."""
    unconfirmed_stop: float | None = None
    """When the first stop was sent that no status has confirmed."""
    stop_continued_at: float = -math.inf
    """When a stop or a request for the status was sent last."""
    is_disarming: bool = False
    """Whether a Disarm was sent, and no status has shown silence since."""
    fed_at: float | None = None
    """When its watchdog was fed last; None while nothing is to be fed."""
    other_host_at: float = -math.inf
    unanswered_at: float = -math.inf
    """When a request to it had been without a reply for too long."""

    @property
    def is_enabled(self) -> bool:
        """Whether the host knows that it is armed, and has not silenced it."""
        return self.state == ENABLED and not (self.is_stopped or self.is_disarming)

    @property
    def is_faulted(self) -> bool:
        """Whether the host knows of a fault."""
        return self.state in _FAULTED

    def vibrates(self, time: float) -> bool:
        """Whether it vibrates at a time, according to what was sent."""
        self.played.advance(time)
        return any(self.played.end_of(layer) > time for layer in self.played.tokens)

    def silence(self, time: float) -> None:
        """Note a request that silences all layers and drops the staged set."""
        self.played = silent()
        self.staged = None
        self.silenced_at = time

    def opened(self) -> None:
        """Forget what was known before its wire was opened."""
        self.is_open, self.is_identified = True, False
        self.state = self.session = None
        self.is_disarming = False
        self.played = silent()


@dataclass(eq=False)
class _Pending:
    """A request that has no reply yet."""

    name: str
    amplifier: HostedAmplifier
    sent_at: float
    values: Values
    is_overdue: bool = False


@dataclass(frozen=True)
class _Deadline:
    """Something that must have happened by a time."""

    due: float
    rule: str
    problem: str
    is_kept: Callable[[], bool]


class _JudgedLines(Lines):
    """The lines of a host, each of which shows its requests and arrivals to the rules."""

    def __init__(self, former_lines: Lines | None, rules: "HostRules") -> None:
        super().__init__(former_lines)
        self._rules = rules

    async def open_line(self, address: WireAddress) -> Any:
        opened = await super().open_line(address)
        self._rules.listen(opened.line, address.line)
        return opened


class HostRules:
    """Judges the host of a control loop; urls: of its amplifiers by name."""

    def __init__(
        self,
        urls: Mapping[str, str],
        *,
        limits: ChannelLimits = ChannelLimits(),
        times: HostTimes = HostTimes(),
    ) -> None:
        self.limits = limits
        self.times = times
        self.violations: list[RuleViolation] = []
        self.requests = 0
        self.expected: ExpectedSets | None = None
        """What every pattern must be; None for any."""
        self.amplifiers: dict[str, HostedAmplifier] = {}
        for name, url in urls.items():
            address = address_of(url)
            self.amplifiers[name] = HostedAmplifier(name, address.line, address.number)
        self._deadlines: list[_Deadline] = []
        self._pending: dict[str, _Pending] = {}  # by wire
        self._faults = 0  # that are active
        self._disturbed_until = -math.inf
        self._stalled_since: float | None = None
        self._contacts: frozenset[Hashable] | None = None  # None while no source was heard
        self._last_lift = self._last_touch = self._last_vibration = -math.inf
        self._is_arm_requested: bool | None = None  # None while no operator was heard
        self._last_command = self._last_disarm = self._last_silencing = -math.inf
        self._requested_stops: dict[str, float] = {}  # by amplifier, until they are sent

    # What a test tells

    def follow(self, controller: Controller) -> None:
        """Judge a control loop from now on: its wires, and the commands of its operator."""
        controller.make_lines = partial(_JudgedLines, rules=self)
        for command in get_args(OperatorCommand):
            tell_first(controller, command, partial(self.commanded, command))
        tell_first(controller, "open", self.opened)
        controller.release = partial(self._release, controller.release)  # type: ignore[method-assign]

    def listen(self, line: Line, wire_name: str) -> None:
        """Judge the requests and arrivals on a line that has been opened."""
        wire = line.wire
        make_request, read_arrivals = wire.request, wire.received

        def request(address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
            self.sent(wire_name, address, name, values)
            return make_request(address, name, values, has_reply=has_reply)

        def received(data: bytes) -> list[Arrival]:
            arrivals = read_arrivals(data)
            for arrival in arrivals:
                self.arrived(wire_name, arrival)
            return arrivals

        wire.request = request  # type: ignore[method-assign]
        wire.received = received  # type: ignore[method-assign]

    def opened(self) -> None:
        """Note that a host is about to open all wires."""
        self._pending.clear()
        for amplifier in self.amplifiers.values():
            amplifier.opened()

    def closed(self) -> None:
        """Note that the host has closed all wires, or died."""
        self.advance()
        self._pending.clear()
        self._requested_stops.clear()
        for amplifier in self.amplifiers.values():
            amplifier.is_open = False
            amplifier.fed_at = amplifier.unconfirmed_stop = None

    async def _release(self, release: Callable[[], Awaitable[None]]) -> None:
        try:
            await release()
        finally:
            self.closed()

    def disturb(self, change: int = 1) -> None:
        """Note that one more fault is active, or one less by -1."""
        self.advance()
        self._faults += change
        self._disturbed_until = math.inf if self._faults else threads.now() + RECOVERY

    def inject_fault(self, window: FaultWindow) -> None:
        """Note that a fault begins, which ends by itself."""
        self.disturb()
        lasts = window.lasts + (window.delay if window.fault == "delay" else 0.0)
        if lasts < math.inf:
            asyncio.get_running_loop().call_later(lasts, self.disturb, -1)

    def set_stalled(self, is_stalled: bool = True) -> None:
        """Note that the control loop stalls, or runs again."""
        self.advance()
        self._stalled_since = threads.now() if is_stalled else None
        if not is_stalled:
            for amplifier in self.amplifiers.values():
                amplifier.fed_at = None  # the next heartbeat is due after the loop has run

    def set_contacts(self, contacts: Collection[Hashable], *, must_be_felt: bool = True) -> None:
        """Replace the contacts; must_be_felt: whether new ones must lead to a pattern."""
        self.advance()
        time = threads.now()
        former_contacts = self._contacts or frozenset()
        self._contacts = frozenset(contacts)
        new_contacts = self._contacts - former_contacts
        if new_contacts:
            self._last_touch = time
        if former_contacts and not self._contacts:
            self._last_lift = time
            for amplifier in self.amplifiers.values():
                self._expect_silence(amplifier, time)
        if must_be_felt and self._can_play():
            for contact in new_contacts:
                self._expect_pattern(contact, time)

    def _can_play(self) -> bool:
        return self._stalled_since is None and all(
            amplifier.is_open and amplifier.is_enabled for amplifier in self.amplifiers.values()
        )

    def commanded(self, command: OperatorCommand) -> None:
        """Note an operator's command that is about to be carried out."""
        self.advance()
        time = self._last_command = threads.now()
        if command == "arm":
            self._is_arm_requested = True
        elif command != "clear" or self._is_arm_requested is None:
            self._is_arm_requested = False
        if command == "disarm":
            self._last_disarm = time
        if command in ("stop", "disarm"):
            self._last_silencing = time
        if command == "stop" and not self._is_disturbed(time):
            for amplifier in self.amplifiers.values():
                if amplifier.is_open:
                    self._expect_stop(amplifier, time)

    def check_level(self, name: str, levels: Sequence[float]) -> None:
        """Compare the levels that an amplifier really plays with the limits."""
        self.advance()
        for channel, level in enumerate(levels):
            limit = self.limits.level if channel < self.limits.channels else 0.0
            if level > limit + _LEVEL_TOLERANCE:
                self._report("limits", f"channel {channel} of {name} plays at {level:.4f}")

    def finish(self) -> list[RuleViolation]:
        """Return all violations until now, in order."""
        self.advance()
        return list(self.violations)

    # What passes on the wires

    def sent(self, wire: str, address: int, name: str, values: Values) -> None:
        """Judge a request on a wire; address 0: a broadcast to all amplifiers of the wire."""
        self.advance()
        self.requests += 1
        time = threads.now()
        self._note_unanswered(wire)
        amplifiers = [
            amplifier
            for amplifier in self.amplifiers.values()
            if amplifier.wire == wire and address in (0, amplifier.address)
        ]
        for amplifier in amplifiers:
            layers = self._layers_of(amplifier, values) if name == "Set" else None
            self._check_order(amplifier, name, layers, time)
            self._check_request(amplifier, name, values, time)
            if layers is not None:
                self._check_set(amplifier, values["token"], layers, time)
            self._note_request(amplifier, name, values, time)
        if address and amplifiers and (name != "Set" or is_last(values)):
            self._pending[wire] = _Pending(name, amplifiers[0], time, values)

    def arrived(self, wire: str, arrival: Arrival) -> None:
        """Note what has arrived on a wire."""
        self.advance()
        time = threads.now()
        if isinstance(arrival, Event | OtherHost):
            for amplifier in self.amplifiers.values():
                if (amplifier.wire, amplifier.address) == (wire, arrival.address):
                    self._note_unasked(amplifier, arrival, time)
        elif isinstance(arrival, Reply | Nak | BrokenReply):
            pending = self._pending.pop(wire, None)
            if pending is not None and isinstance(arrival, Reply):
                self._note_reply(pending, arrival.values, time)
            elif pending is not None and pending.name in ("Set", "Commit"):
                pending.amplifier.staged = pending.amplifier.committed_token = None

    def _note_unanswered(self, wire: str) -> None:
        """Without a reply to a set or a commit, the amplifier may not have received it."""
        pending = self._pending.get(wire)
        if pending is not None and pending.name in ("Set", "Commit"):
            pending.amplifier.committed_token = None

    def _note_unasked(
        self, amplifier: HostedAmplifier, arrival: Event | OtherHost, time: float
    ) -> None:
        if isinstance(arrival, OtherHost):
            amplifier.other_host_at = time
        else:
            self._note_state(amplifier, arrival.values["state"], time)

    def _note_reply(self, pending: _Pending, reply: Values, time: float) -> None:
        amplifier = pending.amplifier
        match pending.name:
            case "Hello":
                amplifier.is_identified = True
            case "GetCaps":
                amplifier.layer_count = reply["layers"]
            case "Arm":
                if amplifier.is_stopped and reply["state"] == ENABLED and reply["latch"]:
                    self._report("stop", f"{amplifier.name} armed before its stop was cleared")
                amplifier.is_stopped = False
                amplifier.armed_at = amplifier.fed_at = time
            case "Clear":
                amplifier.is_stopped = False
        if "levels" not in reply:
            return
        self._note_state(amplifier, reply["state"], time)
        amplifier.is_replied = True
        self._check_committed(pending, reply, time)
        if reply["latch"] == 0 and amplifier.unconfirmed_stop is None:
            amplifier.is_stopped = False  # it has restarted since the stop
        if not any(reply["levels"]):
            amplifier.is_disarming = False
            if reply["state"] in LATCHED:
                amplifier.unconfirmed_stop = None

    def _check_committed(self, pending: _Pending, reply: Values, time: float) -> None:
        """A status that was requested after a commit shows its token, also of a broadcast."""
        amplifier, token = pending.amplifier, pending.amplifier.committed_token
        is_later = pending.sent_at > amplifier.committed_at and not self._is_disturbed(time)
        if token is None or not (is_later and amplifier.is_enabled):
            return
        if reply.get("token", token) != token:
            self._report(
                "commit", f"{amplifier.name} shows set {reply['token']}, but was to play {token}"
            )
            amplifier.committed_token = None

    def _note_state(self, amplifier: HostedAmplifier, state: int, time: float) -> None:
        if state != amplifier.state:
            amplifier.state, amplifier.state_since = state, time
            amplifier.is_replied = False
        if amplifier.is_faulted and self._last_command < time and self._is_arm_requested:
            self._is_arm_requested = False  # a fault cancels earlier commands

    # Rules for a request

    def _layers_of(self, amplifier: HostedAmplifier, part: Values) -> tuple[LayerSet, ...] | None:
        """Return the layers of a set whose last part is sent; None for an earlier part."""
        token = part["token"]
        parts = amplifier.parts.get(token, {})
        parts[part["index"]] = part["stream"]
        amplifier.parts = {token: parts}
        if not is_last(part) or len(parts) < part["parts"]:
            return None
        words = [word for index in sorted(parts) for word in parts[index]]
        try:
            return unpack_layers(words)
        except Refusal as refusal:
            self._report("limits", f"set {token} to {amplifier.name} is malformed: {refusal}")
            return None

    def _check_order(
        self,
        amplifier: HostedAmplifier,
        name: str,
        layers: tuple[LayerSet, ...] | None,
        time: float,
    ) -> None:
        """A request waits for the reply to the last one on its wire, unless it silences."""
        pending = self._pending.get(amplifier.wire)
        if pending is None:
            return
        is_confirming = name == "GetStatus" and (
            amplifier.is_disarming
            or amplifier.unconfirmed_stop is not None
            or time < self._last_silencing + _STOP_DURATION
        )
        is_silent_set = layers is not None and not is_vibrating(*layers)
        if name in _SILENCING or is_confirming or is_silent_set:
            del self._pending[amplifier.wire]
            return
        timeout = _READING_TIMEOUT if pending.name in _READING else self.times.reply / 2
        is_preempted = pending.sent_at <= self._last_lift
        waits = time - pending.sent_at
        if waits < timeout and not (is_preempted or self._is_disturbed(time)):
            self._report(
                "credit",
                f"{name} sent to {amplifier.name} {waits * 1e3:.1f} ms after {pending.name} to "
                f"{pending.amplifier.name}, whose reply is pending",
            )

    def _check_request(
        self, amplifier: HostedAmplifier, name: str, values: Values, time: float
    ) -> None:
        self._check_stop_is_next(amplifier, name, time)
        if name in _FEEDING:
            self._check_feeding(amplifier, name, values, time)
        if name == "Arm":
            self._check_arm(amplifier, time)
        if name in _SILENCING and amplifier.vibrates(time) and not amplifier.is_stopped:
            self._check_release(amplifier, values["ramp"], time)

    def _check_stop_is_next(self, amplifier: HostedAmplifier, name: str, time: float) -> None:
        """After an operator's stop, the next request to an amplifier is that stop."""
        requested_at = self._requested_stops.get(amplifier.name)
        if requested_at is None or name == "Stop" or name in _IDENTIFYING:
            return
        if time <= requested_at + _IN_FLIGHT * (2 if name == "GetStatus" else 1):
            return  # it was queued before
        if name == "Disarm" and requested_at < self._last_disarm + _REORDER_WINDOW:
            return  # it silences, too
        self._report(
            "stop",
            f"stop requested at {requested_at:.4f} s, but the next request to {amplifier.name} is "
            f"{name}",
        )
        del self._requested_stops[amplifier.name]

    def _check_feeding(
        self, amplifier: HostedAmplifier, name: str, values: Values, time: float
    ) -> None:
        """Nothing feeds a stopped amplifier, one of another host, or while the loop stalls."""
        where = amplifier.name
        if name != "Silence" and self._is_stalled(time) and not self._is_disturbed(time):
            self._report("heartbeat", f"{name} feeds {where}, but the control loop stalls")
        if amplifier.is_stopped and name not in ("Arm", "Silence"):
            self._report("stop", f"{name} sent to {where} after a stop")
        session = values["session"]
        if name in ("Set", "Commit") and amplifier.session not in (None, session):
            self._report(
                "session", f"{name} of session {session} sent to {where}, armed by another one"
            )
        if time < amplifier.other_host_at + _OTHER_HOST_PAUSE:
            self._report("session", f"{name} sent to {where}, which another host drives")
        amplifier.fed_at = time

    def _is_stalled(self, time: float) -> bool:
        since = self._stalled_since
        return since is not None and time > since + self.times.slack

    def _check_arm(self, amplifier: HostedAmplifier, time: float) -> None:
        """Amplifiers are armed only by an operator, and identified before."""
        if amplifier.is_identified is False:
            self._report("identified", f"{amplifier.name} armed before it was identified")
        # An Arm on its way may still be sent; what withdraws it follows.
        is_withdrawn = time > self._last_silencing + self.times.stop
        if self._is_arm_requested is False and is_withdrawn:
            self._report("armed", f"{amplifier.name} armed without an operator's request")

    def _check_set(
        self, amplifier: HostedAmplifier, token: int, layers: tuple[LayerSet, ...], time: float
    ) -> None:
        """Judge a set whose last part is sent."""
        self._check_token(amplifier, token, layers)
        for layer in layers:
            self._check_layer(amplifier, token, layer)
        amplifier.staged = amplifier.last_set = (token, layers)
        if is_vibrating(*layers):
            self._check_vibrating(amplifier, layers, time)

    def _check_token(
        self, amplifier: HostedAmplifier, token: int, layers: tuple[LayerSet, ...]
    ) -> None:
        last_token, last_layers = amplifier.last_set
        is_same = (token, layers) == (last_token, last_layers)
        if last_token and not is_same and not is_newer_token(token, last_token):
            self._report("token", f"set {token} sent to {amplifier.name} after set {last_token}")

    def _check_layer(self, amplifier: HostedAmplifier, token: int, layer: LayerSet) -> None:
        where = f"set {token} to {amplifier.name}"
        if layer.layer >= amplifier.layer_count:
            self._report("limits", f"{where}: it has no layer {layer.layer}")
        for command in layer.commands:
            problem = self._problem_of(command) if command.is_driven else ""
            if problem:
                self._report("limits", f"{where}, channel {command.channel}: {problem}")

    def _problem_of(self, command: Command) -> str:
        """Describe which limit of its channel a command breaks; "" for none."""
        if command.channel >= self.limits.channels:
            return "no such channel"
        frequency = _FREQUENCY.from_wire(command.frequency)
        low, high = self.limits.frequency
        tolerance = _FREQUENCY.step * _STEP
        if not low - tolerance <= frequency <= high + tolerance:
            return f"frequency must be {low:g} to {high:g} Hz, got {frequency:g}"
        levels = [command.level]
        for shape in (command.onset, command.ending):
            if shape is not None:
                levels += [level for level, _ in shape.knots]
        level = _LEVEL.from_wire(max(*levels, 0))
        if level > self.limits.level + _LEVEL.step * _STEP:
            return f"level must be at most {self.limits.level:g}, got {level:g}"
        return ""

    def _check_vibrating(
        self, amplifier: HostedAmplifier, layers: tuple[LayerSet, ...], time: float
    ) -> None:
        """Vibration needs an enabled amplifier and a contact."""
        is_disabled = amplifier.state not in (None, ENABLED) and not amplifier.is_stopped
        is_known = time > amplifier.state_since + _IN_FLIGHT
        is_known &= amplifier.is_replied or not amplifier.is_faulted
        if is_disabled and is_known and not self._is_disturbed(time):
            self._report("enabled", f"vibration sent to {amplifier.name}, which is disarmed")
        is_touched = self._contacts is None or bool(self._contacts)
        if not is_touched and time > self._last_lift + self.times.lift + self.times.slack:
            self._report(
                "justified",
                f"vibration sent to {amplifier.name} without a contact since "
                f"{self._last_lift:.4f} s",
            )
        if self.expected is not None:
            self._check_pattern(amplifier, layers, time, self.expected)

    def _check_pattern(
        self,
        amplifier: HostedAmplifier,
        layers: tuple[LayerSet, ...],
        time: float,
        expected: ExpectedSets,
    ) -> None:
        """Compare what all layers play after a set with the expected pattern."""
        playback = deepcopy(amplifier.played)
        playback.commit([replace(layer, after=False) for layer in layers], 1, time)
        tones: dict[int, list[Tone]] = {}
        for layer in playback.tokens:
            for command in playback.playing(layer).commands:
                tones.setdefault(command.channel, []).append(_tone_of(command))
        wanted = {
            channel: list(channel_tones)
            for channel, channel_tones in expected.get(amplifier.name, {}).items()
            if channel_tones
        }
        if not _are_same(tones, wanted):
            self._report(
                "pattern", f"{amplifier.name} was sent {tones}, expected {wanted}: Hz, level, deg"
            )

    def _check_release(self, amplifier: HostedAmplifier, ramp: int, time: float) -> None:
        """The ramp to zero after the last lift must end in time."""
        if self._contacts or not 0 <= time - self._last_lift <= self.times.lift:
            return
        duration = _RAMP.from_wire(ramp)
        if time + duration > self._last_lift + self.times.release + self.times.slack:
            self._report(
                "lift",
                f"last finger lifted at {self._last_lift:.4f} s, {amplifier.name} has a ramp of "
                f"{duration:g} s",
            )

    # What a request changes

    def _note_request(
        self, amplifier: HostedAmplifier, name: str, values: Values, time: float
    ) -> None:
        if name in ("Stop", "GetStatus"):
            amplifier.stop_continued_at = time
        if name in _SILENCING:
            amplifier.silence(time)
        match name:
            case "Arm":
                amplifier.session = values["session"]
                amplifier.last_set = (0, ())
                amplifier.committed_token = None
                amplifier.silence(time)
            case "Disarm":
                amplifier.is_disarming = True
            case "Stop":
                self._note_stop(amplifier, time)
            case "Commit":
                if amplifier.staged is not None and amplifier.staged[0] == values["token"]:
                    self._note_playing(amplifier, *amplifier.staged, time)
            case "Set":
                is_whole = is_last(values) and amplifier.last_set[0] == values["token"]
                if is_whole and values["now"]:
                    self._note_playing(amplifier, *amplifier.last_set, time)

    def _note_stop(self, amplifier: HostedAmplifier, time: float) -> None:
        self._requested_stops.pop(amplifier.name, None)
        if self._is_arm_requested:
            self._is_arm_requested, self._last_silencing = False, time
        is_confirmed = amplifier.is_stopped and amplifier.unconfirmed_stop is None
        amplifier.is_stopped, amplifier.session = True, None
        if is_confirmed and amplifier.state in LATCHED:
            return
        if amplifier.unconfirmed_stop is None:
            amplifier.unconfirmed_stop = time
        self._expect_confirmation(amplifier, time, amplifier.unconfirmed_stop)

    def _note_playing(
        self, amplifier: HostedAmplifier, token: int, layers: tuple[LayerSet, ...], time: float
    ) -> None:
        has_ending = any(voice.ending for voices in amplifier.played.all_voices for voice in voices)
        is_new = token not in amplifier.committed
        amplifier.committed.append(token)
        amplifier.committed_token, amplifier.committed_at = token, time
        amplifier.played.commit(layers, token, time)
        self._check_sums(amplifier, time)
        if is_new:
            self._expect_commits(amplifier, token, time)
        if is_vibrating(*layers):
            self._last_vibration = time
        if not amplifier.vibrates(time):
            amplifier.silenced_at = time
            if not has_ending:
                ramp = max((layer.ramp for layer in layers), default=0)
                self._check_release(amplifier, ramp, time)

    def _check_sums(self, amplifier: HostedAmplifier, time: float) -> None:
        """The sum of all layers at a channel stays within its limits."""
        for channel, voices in enumerate(amplifier.played.all_voices):
            if channel >= self.limits.channels or not voices:
                continue
            level, slew = _sum_of(voices, time)
            for quantity, value, limit in (
                ("level", level, self.limits.level),
                ("rise", slew, self.limits.slew),
            ):
                if value > limit * _SUM_TOLERANCE + _LEVEL.step:
                    self._report(
                        "limits",
                        f"{amplifier.name}: {quantity} of channel {channel}, sum of all layers, "
                        f"must be at most {limit:g}, got {value:.4g}",
                    )

    # Deadlines

    def _expect(
        self, since: float, limit: float, rule: str, problem: str, is_kept: Callable[[], bool]
    ) -> None:
        """Expect something within a limit of a time; problem: report otherwise."""
        problem = f"{problem} within {limit * 1e3:g} ms of {since:.4f} s"
        self._deadlines.append(_Deadline(since + limit, rule, problem, is_kept))

    def _expect_stop(self, amplifier: HostedAmplifier, time: float) -> None:
        """An operator's stop must be sent, unless the reply to one is awaited."""
        is_under_way = amplifier.is_stopped and amplifier.unconfirmed_stop is not None
        if is_under_way and time < amplifier.stop_continued_at + self.times.reply:
            return
        self._requested_stops[amplifier.name] = time

        def is_sent() -> bool:
            return self._requested_stops.get(amplifier.name) != time or not amplifier.is_open

        problem = f"operator's stop not sent to {amplifier.name}"
        self._expect(time, self.times.stop, "stop", problem, is_sent)

    def _expect_confirmation(self, amplifier: HostedAmplifier, time: float, first: float) -> None:
        """A stop must be confirmed, or go on: it is repeated, or the status is read."""

        def goes_on() -> bool:
            is_over = amplifier.unconfirmed_stop != first or not amplifier.is_open
            return is_over or amplifier.stop_continued_at > time

        names_on_wire = [
            neighbor.name
            for neighbor in self.amplifiers.values()
            if neighbor.wire == amplifier.wire
        ]
        if time <= first + _STOP_DURATION - _STOP_INTERVAL:
            problem = f"stop of {amplifier.name} neither confirmed nor repeated"
            interval = _STOP_INTERVAL * len(names_on_wire)
            self._expect(time, interval, "stop", problem, goes_on)

    def _expect_commits(self, first: HostedAmplifier, token: int, time: float) -> None:
        """A set that one amplifier plays is played by all that have it staged."""
        for amplifier in self.amplifiers.values():
            has_set = amplifier.staged is not None and amplifier.staged[0] == token
            if amplifier is first or not has_set or not amplifier.is_enabled:
                continue

            def is_joined(amplifier: HostedAmplifier = amplifier) -> bool:
                is_over = self._stalled_since is not None or not first.is_open
                is_silenced = not first.vibrates(time) or first.silenced_at >= time
                return token in amplifier.committed or is_over or is_silenced

            problem = f"set {token}, which {first.name} plays, not committed on {amplifier.name}"
            self._expect(time, self.times.together, "commit", problem, is_joined)

    def _expect_silence(self, amplifier: HostedAmplifier, last_lift: float) -> None:
        """After the last lift every amplifier is silenced."""
        limit = self.times.lift

        def is_silenced() -> bool:
            is_silent = not amplifier.vibrates(last_lift + limit) or amplifier.is_faulted
            is_given_up = amplifier.fed_at is None or not amplifier.is_open
            is_touched = self._last_touch >= last_lift
            return is_silent or is_given_up or is_touched or self._stalled_since is not None

        problem = f"last finger lifted, {amplifier.name} not silenced"
        self._expect(last_lift, limit, "lift", problem, is_silenced)

    def _expect_pattern(self, contact: Hashable, since: float) -> None:
        """A new contact leads to a pattern."""

        def has_pattern() -> bool:
            is_lifted = contact not in (self._contacts or ())
            is_excused = self._last_silencing >= since or self._stalled_since is not None
            is_played = self._last_vibration >= since
            cannot_play = any(
                amplifier.is_faulted or not amplifier.is_open
                for amplifier in self.amplifiers.values()
            )
            return is_lifted or is_excused or is_played or cannot_play

        problem = "new contact, but no amplifier plays a pattern"
        self._expect(since, self.times.touch, "touch", problem, has_pattern)

    def advance(self) -> None:
        """Judge what is due by now."""
        time = threads.now()
        deadlines, self._deadlines = self._deadlines, []
        for deadline in deadlines:
            if deadline.due >= time:
                self._deadlines.append(deadline)
            elif not (self._is_disturbed(deadline.due) or deadline.is_kept()):
                self._report(deadline.rule, deadline.problem)
        for pending in self._pending.values():
            if time > pending.sent_at + self.times.reply and not pending.is_overdue:
                pending.is_overdue = True
                pending.amplifier.unanswered_at = time
        for amplifier in self.amplifiers.values():
            self._check_heartbeat(amplifier, time)

    def _check_heartbeat(self, amplifier: HostedAmplifier, time: float) -> None:
        """An enabled amplifier is fed in time; later while the host waits for a missing reply."""
        is_ending = self._last_silencing >= amplifier.armed_at or self._stalled_since is not None
        if self._is_disturbed(time):
            amplifier.fed_at = None  # the host may have given it up
        fed_at = amplifier.fed_at
        if fed_at is None or is_ending or not (amplifier.is_open and amplifier.is_enabled):
            return
        is_waiting = any(neighbor.unanswered_at >= fed_at for neighbor in self.amplifiers.values())
        limit = self.times.heartbeat + self.times.slack
        if is_waiting:
            limit += _ATTEMPTS * self.times.reply
        if time > fed_at + limit:
            amplifier.fed_at = time
            self._report("heartbeat", f"{amplifier.name}: no heartbeat since {fed_at:.4f} s")

    def _is_disturbed(self, time: float) -> bool:
        return time <= self._disturbed_until

    def _report(self, rule: str, problem: str) -> None:
        self.violations.append(RuleViolation(rule, threads.now(), problem))


def tell_first(owner: Any, method: str, tell: Callable[..., object]) -> None:
    """Report each call of a method, before it is carried out."""
    carry_out = getattr(owner, method)

    def call(*arguments: Any) -> Any:
        tell(*arguments)
        return carry_out(*arguments)

    setattr(owner, method, call)


def _sum_of(voices: Sequence[Voice], time: float) -> tuple[float, float]:
    """Return the highest sum of levels from a time on, and its steepest rise [1/s]."""
    times = {time}
    for voice in voices:
        transition = voice.transition
        count = max(_TRANSITION_POINTS, len(transition.knots) + 1)
        step = (transition.end - transition.start) / count
        times.update(transition.start + step * number for number in range(count + 1))
    moments = sorted({round(moment, 6) for moment in times if moment >= time})
    levels = [sum(abs(voice.transition.at(moment)) for voice in voices) for moment in moments]
    slews = [0.0]
    for (start, end), (low, high) in zip(pairwise(moments), pairwise(levels), strict=True):
        slews.append((high - low) / (end - start))
    return max(levels), max(slews)


def _tone_of(command: Command) -> Tone:
    return (
        _FREQUENCY.from_wire(command.frequency),
        _LEVEL.from_wire(command.level),
        _PHASE.from_wire(command.phase),
    )


def _are_same(tones: Mapping[int, Sequence[Tone]], wanted: Mapping[int, Sequence[Tone]]) -> bool:
    """Whether the same tones are at the same channels, within a step of the wire."""
    if tones.keys() != wanted.keys():
        return False
    for channel, expected in wanted.items():
        played_tones = tones[channel]
        if len(played_tones) != len(expected):
            return False
        for tone in expected:
            if not any(_is_same_tone(tone, played_tone) for played_tone in played_tones):
                return False
    return True


def _is_same_tone(first: Tone, second: Tone) -> bool:
    return (
        abs(first[0] - second[0]) < _FREQUENCY.step * _STEP
        and abs(first[1] - second[1]) < _LEVEL.step * _STEP
        and abs(math.remainder(first[2] - second[2], 360.0)) < _PHASE.step * _STEP
    )
