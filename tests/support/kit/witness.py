"""A witness that knows the plate: fingers, commands, stalls, faults, what really plays.

A chain of tests has these beside the bytes on its wires. With them the witness has further rules
for hosts: those of `RULES`; limits also of measured levels; armed only on an operator's request; a
stop as the next frame, within 20 ms of its request; no heartbeat while the control loop stalls.
Times in s. Beside it the fingers on the plate are judged, by the touch frames alone and
docs/reference/touch.md. The witness excuses wires with faults: what must hold whatever fails is
judged by what the simulated amplifiers really play, with bounds that the fault table and the
timeouts of a link add up to.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Collection, Hashable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

from controller.operation.plate_controller import Controller
from controller.sources.touch import TouchFrame
from drivers.protocol.definition import MESSAGES, QUANTITIES, STATES
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_vibrating
from drivers.wires.wire import address_of
from era_haptics.lab.expected_output import one_of
from kit.clock import VirtualLoop
from kit.wires import FarSide, after_each
from registry import threads
from registry.virtual_time import START
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.faults import FaultWindow
from witness.capture import (
    A_READ,
    HELLO_REQUEST,
    AmplifierConfig,
    ChannelLimits,
    TimeLimits,
    TransferDirection,
    WireKind,
    WitnessConfig,
    WitnessedRequest,
)
from witness.host_rules import (
    CONFIRMED,
    IN_FLIGHT,
    SILENCING_REQUESTS,
    AmplifierSession,
    HostRules,
)
from witness.witness import RECOVERY, Witness

RULES = {
    "justified": "no vibration is commanded without a contact",
    "pattern": "a set is the expected one, where one is given",
    "lift": "after the last lift: silencing command within 20 ms, silence within 60 ms",
    "touch": "a new contact leads to a pattern within 100 ms",
}
"""What no bytes alone can break."""
OperatorCommand = Literal["arm", "disarm", "stop", "clear"]
Tone: TypeAlias = tuple[float, float, float]
ExpectedSets = Mapping[str, Mapping[int, Sequence[Tone]]]
"""Expected tones by amplifier and channel, over all layers: frequency [Hz], level, phase [deg]."""

_REORDER_WINDOW = 0.020  # s; of two commands given within it the earlier may still be sent first
_UNORDERED = (A_READ, HELLO_REQUEST, "GetCaps")
_STEP = 0.6  # of a step of the wire; tolerance of rounding
_TOLERANCE = 0.002  # of full level; of a measured one
_FINE = 0.026  # Hz; half a step of the wire
_FREQUENCY, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("frequency", "level", "phase"))
_RAMP, _LAYERS = QUANTITIES["ramp"], QUANTITIES["layer_count"].maximum


@dataclass(frozen=True)
class PlateTimes:
    """Time limits.

    lift, release: from the last lift to the silencing command, and to silence; touch: from a touch
    to its pattern; stop: from its request to its frame.
    """

    lift: float = 0.020
    release: float = 0.060
    touch: float = 0.100
    stop: float = 0.020


class PlateRules(HostRules):
    """The rules for hosts with what is known beside the wires; None for what is not given."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.expected: ExpectedSets | None = None
        self.limits = PlateTimes()
        self.stops_requested: dict[str, float] = {}
        self.stalled_since: float | None = None
        self._contacts: frozenset[Hashable] | None = None
        self._is_arm_requested: bool | None = None
        self._last_lift = self._last_touch = self._last_vibration = -math.inf
        self._last_command = self._last_disarm = self._last_silencing = -math.inf

    def contacts(self, time: float, contacts: Collection[Hashable], *, is_answerable: bool) -> None:
        """Replace the contacts on the plate; is_answerable: new ones must lead to a pattern."""
        before, self._contacts = self._contacts or frozenset(), frozenset(contacts)
        new = self._contacts - before
        if new:
            self._last_touch = time
        if before and not self._contacts:
            self._last_lift = time
            for session in self._sessions.values():
                self._expect_silence(session, time)
        can_play = self.stalled_since is None and all(
            session.is_open and session.amplifier.is_enabled and not session.is_stopped
            for session in self._sessions.values()
        )
        for contact in new if is_answerable and can_play else ():
            self._expect_pattern(contact, time)

    def operator_command(self, time: float, command: OperatorCommand) -> None:
        """Note an operator's command."""
        self._last_command = time
        if command == "disarm":
            self._last_disarm = time
        is_kept = self._is_arm_requested is True and command == "clear"
        self._is_arm_requested = command == "arm" or is_kept
        if command in ("stop", "disarm"):
            self._last_silencing = time
        for session in self._sessions.values() if command == "stop" else ():
            if session.is_open and not session.is_disturbed(time):
                self._expect_stop(session, time)

    def set_stalled(self, since: float | None) -> None:
        """Note that the control loop stalls since a time; None: it runs again."""
        self.stalled_since = since
        for session in self._sessions.values() if since is None else ():
            session.last_feed = None  # the next heartbeat is due after the loop has run

    def advance(self, time: float) -> None:
        """Check what is due by now."""
        super().advance(time)
        for session in self._sessions.values():
            if session.amplifier.last_fault > self._last_command and self._is_arm_requested:
                self._is_arm_requested = False  # a fault cancels earlier commands

    def is_preempting(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> bool:
        """Also what reads a status soon after an operator's stop or disarm."""
        is_silencing = request.name == "GetStatus" and time < self._last_silencing + CONFIRMED
        return is_silencing or super().is_preempting(session, time, request)

    def check_order(
        self,
        session: AmplifierSession,
        request: WitnessedRequest,
        pending: Collection[WitnessedRequest],
        preempted_by: int,
    ) -> None:
        """A last lift preempts too, even if a finger has come since."""
        later = [each for each in pending if each.started_at > self._last_lift]
        super().check_order(session, request, later, preempted_by)

    def check_request(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> None:
        """Check a request to one amplifier."""
        self._check_stop(session, time, request)
        super().check_request(session, time, request)

    def _check_stop(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> None:
        requested_at = self.stops_requested.get(session.name)
        is_other = request.name != "Stop" and request.name not in _UNORDERED
        if requested_at is None or not is_other:
            return
        # Requests written at the same moment as the stop may precede it, and with a broadcast the
        # status that is read behind it.
        if time <= requested_at + IN_FLIGHT * (2 if request.name == "GetStatus" else 1):
            return
        if request.name == "Disarm" and requested_at < self._last_disarm + _REORDER_WINDOW:
            return  # silences as well
        session.report_always(
            "stop",
            time,
            f"stop requested at {requested_at:.4f} s, but the next request to {session.name} is "
            f"{request.name}",
        )
        del self.stops_requested[session.name]

    def _check_feeding(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> None:
        name, since = request.name, self.stalled_since
        if since is not None and time > since + self._times.slack and name != "Silence":
            session.report(
                "heartbeat",
                time,
                f"control loop stalled since {since:.4f} s, but {name} feeds the watchdog of "
                f"{session.name}",
            )
        super()._check_feeding(session, time, request)

    def _check_heartbeat(self, session: AmplifierSession, time: float) -> None:
        is_ending = self._last_silencing >= session.armed_at
        if session.is_disturbed(time) or not (is_ending or self.stalled_since is not None):
            super()._check_heartbeat(session, time)

    def _check_arm(self, session: AmplifierSession, time: float) -> None:
        # An Arm on its way may still be sent, followed by what withdraws it.
        is_withdrawn = time > self._last_silencing + self.limits.stop
        if self._is_arm_requested is False and is_withdrawn:
            session.report_always(
                "armed", time, f"{session.name} armed without an operator's request"
            )
        super()._check_arm(session, time)

    def _check_vibrating(
        self, session: AmplifierSession, time: float, layers: Sequence[LayerSet]
    ) -> None:
        super()._check_vibrating(session, time, layers)
        is_touched = self._contacts is None or self._contacts
        if not is_touched and time > self._last_lift + self.limits.lift + self._times.slack:
            session.report_always(
                "justified",
                time,
                f"vibration commanded on {session.name} without a contact since "
                f"{self._last_lift:.4f} s",
            )
        if self.expected is not None:
            _check_expected(session, time, layers, self.expected)

    def _remember(
        self,
        session: AmplifierSession,
        time: float,
        request: WitnessedRequest,
        layers: Sequence[LayerSet] | None,
    ) -> None:
        is_silencing = request.name in SILENCING_REQUESTS
        if is_silencing and session.vibrates(time) and not session.is_stopped:
            self._check_release(session, time, request.values["ramp"])
        super()._remember(session, time, request, layers)
        if request.name == "Stop":
            self.stops_requested.pop(session.name, None)
            if self._is_arm_requested:
                self._is_arm_requested, self._last_silencing = False, time

    def _note_playing(
        self, session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
    ) -> None:
        endings = [each.ending for voices in session.played.all_voices for each in voices]
        super()._note_playing(session, time, token, layers)
        if is_vibrating(*layers):
            self._last_vibration = time
        if not (session.vibrates(time) or any(endings)):
            self._check_release(session, time, max((one.ramp for one in layers), default=0))

    def _is_over(self, first: AmplifierSession, time: float) -> bool:
        return self.stalled_since is not None or super()._is_over(first, time)

    def _check_release(self, session: AmplifierSession, time: float, ramp: int) -> None:
        """The ramp to zero must end within the release time after the last lift."""
        last_lift, lasts = self._last_lift, _RAMP.from_wire(ramp)
        if self._contacts or not 0 <= time - last_lift <= self.limits.lift:
            return
        if time + lasts > last_lift + self.limits.release + self._times.slack:
            session.report_always(
                "lift",
                time,
                f"last finger lifted at {last_lift:.4f} s, {session.name} is silent only after a "
                f"ramp of {lasts:g} s",
            )

    def _expect_silence(self, session: AmplifierSession, last_lift: float) -> None:
        """After the last lift every amplifier must be silenced."""
        limit = self.limits.lift

        def is_silenced() -> bool:
            is_silent = not session.vibrates(last_lift + limit) or session.amplifier.is_in_fault
            is_given_up = session.last_feed is None  # since a disturbance
            is_excused = self._last_touch >= last_lift or self.stalled_since is not None
            return is_silent or is_given_up or is_excused or not session.is_open

        self._deadlines.expect(
            last_lift,
            limit,
            ("lift", session, is_silenced),
            f"last finger lifted at {last_lift:.4f} s, {session.name} not silenced",
        )

    def _expect_pattern(self, contact: Hashable, since: float) -> None:
        """A new contact must lead to a pattern."""
        sessions = self._sessions.values()

        def has_pattern() -> bool:
            is_lifted = contact not in (self._contacts or ())
            is_excused = self._last_silencing >= since or self.stalled_since is not None
            return (
                is_lifted
                or is_excused
                or self._last_vibration >= since
                or any(each.amplifier.is_in_fault or not each.is_open for each in sessions)
            )

        self._deadlines.expect(
            since,
            self.limits.touch,
            ("touch", next(iter(sessions)), has_pattern),
            f"touch at {since:.4f} s, no amplifier plays a pattern",
        )

    def _expect_stop(self, session: AmplifierSession, time: float) -> None:
        """A stop command must be sent to this amplifier, unless the reply to one is awaited."""
        is_under_way = session.is_stopped and session.first_stop is not None
        if is_under_way and time < session.last_stop + self._times.reply:
            return  # which must go on until it is confirmed
        self.stops_requested[session.name] = time

        def is_sent() -> bool:
            return self.stops_requested.get(session.name) != time or not session.is_open

        self._deadlines.expect(
            time,
            self.limits.stop,
            ("stop", session, is_sent),
            f"stop requested at {time:.4f} s, not sent to {session.name}",
        )


class PlateWitness(Witness):
    """A witness that is given what it cannot hear; limits: of times."""

    def __init__(
        self,
        config: WitnessConfig,
        limits: PlateTimes = PlateTimes(),
        **options: Any,
    ) -> None:
        super().__init__(config, rules=PlateRules, **options)
        self._faults_until = dict.fromkeys(self.wires, -math.inf)
        self._host.limits = limits

    def contacts(
        self, time: float, contacts: Collection[Hashable], *, is_answerable: bool = True
    ) -> None:
        """Replace the contacts on the plate, by any id; is_answerable: new ones are to be felt."""
        self._advance(time)
        self._host.contacts(time, contacts, is_answerable=is_answerable)

    def expect(self, expected: ExpectedSets | None) -> None:
        """Set what every pattern must be; None for any."""
        self._host.expected = expected

    def operator_command(self, time: float, command: OperatorCommand) -> None:
        """Note an operator's command to the controller."""
        self._advance(time)
        self._host.operator_command(time, command)

    def set_stalled(self, time: float, is_stalled: bool = True) -> None:
        """Note that the control loop stalls, or runs again."""
        self._advance(time)
        self._host.set_stalled(time if is_stalled else None)

    def closed(self, link: str, time: float) -> None:
        """Note that the host has closed or lost a wire, and stops nothing on it."""
        super().closed(link, time)
        for session in self._wires[link].sessions.values():
            self._host.stops_requested.pop(session.name, None)

    def faults(self, time: float, link: str, *, are_on: bool) -> None:
        """Note the start or the end of injected faults on a wire or its amplifiers.

        Until half a second after it only the rules are checked that no fault excuses.
        """
        self._advance(time)
        self._faults_until[link] = math.inf if are_on else time
        wire = self._wires[link]
        wire.disturbed_until = self._faults_until[link] + RECOVERY
        for session in () if are_on else wire.sessions.values():
            session.amplifier.forget()  # what it did meanwhile may be unseen

    def record_bytes(
        self, link: str, direction: TransferDirection, time: float, data: bytes
    ) -> None:
        """Process bytes; those behind a frame that a fault has cut are read as its rest."""
        wire = self._wires[link]
        if wire.started_at.get(direction, time) <= self._faults_until[link] < time:
            self._advance(time)
            wire.disturb(time)
        super().record_bytes(link, direction, time, data)

    def levels(
        self,
        time: float,
        amplifier: str,
        levels: Sequence[float],
        *,
        frequencies: Mapping[int, float] | None = None,
    ) -> None:
        """Compare measured levels (1 is full stroke) and frequencies [Hz] of an amplifier."""
        self._advance(time)
        session = self._sessions[amplifier]
        for channel, level in enumerate(levels):
            limits = session.config.channels.get(channel)
            if level > (limits.level if limits is not None else 0.0) + _TOLERANCE:
                session.report_always(
                    "limits", time, f"channel {channel} of {amplifier} has level {level:.4f}"
                )
        # A reply that is on its way is of an earlier time, which must not be passed before.
        wire = self._wires[session.config.wire]
        is_pending = any(wire.sessions[one.address] is session for one in wire._pending.values())
        if not (is_pending or session.is_disturbed(time)):
            _check_measured(session, levels, frequencies or {}, time)


def _check_measured(
    session: AmplifierSession,
    levels: Sequence[float],
    frequencies: Mapping[int, float],
    time: float,
) -> None:
    """Compare levels, which may be low where a fault is possible that is not shown yet."""
    amplifier, when = session.amplifier, (time, time)
    amplifier.advance(time)
    if amplifier.unanswered or amplifier.may_start(when):
        return
    outputs = amplifier.outputs
    is_fault_possible = amplifier.is_enabled or not amplifier.is_shown
    report_low = amplifier.report_silence if is_fault_possible else amplifier.report
    may_be_off = amplifier.is_enabled and time > amplifier.expiry[0] - amplifier.slack
    sure = outputs.sure(when)
    if sure:
        outputs.check_levels(levels, when, None if may_be_off else report_low)
    lag = outputs._plays.lag + amplifier.slack
    for channel, frequency in frequencies.items() if len(sure) == _LAYERS else ():
        voices = outputs.playback.all_voices[channel]
        lasting = sorted({each.frequency for each in voices if not each.has_ended})
        is_settled = all(each.transition.end < time - lag for each in voices)
        if lasting and is_settled and all(abs(each - frequency) > _FINE for each in lasting):
            what = f"frequency of channel {channel}"
            amplifier.report("plays", time, what, must=one_of(lasting), seen=frequency)


def _check_expected(
    session: AmplifierSession, time: float, layers: Sequence[LayerSet], expected: ExpectedSets
) -> None:
    """Compare what all layers play once a set is committed with the expected pattern."""
    after = deepcopy(session.played)
    after.commit([replace(one, after=False) for one in layers], 1, time)
    sent: dict[int, list[Tone]] = {}
    for layer in after.tokens:
        for command in after.playing(layer).commands:
            sent.setdefault(command.channel, []).append(
                (
                    _FREQUENCY.from_wire(command.frequency),
                    _LEVEL.from_wire(command.level),
                    _PHASE.from_wire(command.phase),
                )
            )
    must = {channel: tones for channel, tones in expected.get(session.name, {}).items() if tones}
    same = sent.keys() == must.keys() and all(
        len(sent[channel]) == len(tones)
        and all(any(_is_same(tone, other) for other in sent[channel]) for tone in tones)
        for channel, tones in must.items()
    )
    if not same:
        session.report_always(
            "pattern",
            time,
            f"{session.name} commanded {sent}, expected {must}: Hz, levels, degrees by channel",
        )


def _is_same(one: Tone, other: Tone) -> bool:
    return (
        abs(one[0] - other[0]) < _FREQUENCY.step * _STEP
        and abs(one[1] - other[1]) < _LEVEL.step * _STEP
        and abs(math.remainder(one[2] - other[2], 360.0)) < _PHASE.step * _STEP
    )


_KINDS: Mapping[str, WireKind] = {
    "serial": "serial",
    "serial+tcp": "serial",
    "modbus+tcp": "modbus-tcp",
    "modbus+rtu": "modbus-rtu",
    "can+socketcand": "socketcand",
    "can+slcan": "slcan",
}
"""Kinds of wire by scheme."""


def wire_name(url: str) -> str:
    """Return the name of a URL's wire: its device, or HOST:PORT."""
    return address_of(url).place.name


def witness_config(
    urls: Mapping[str, str],
    *,
    channels: int = 4,
    times: TimeLimits = TimeLimits(),  # noqa: B008  frozen
    **limits: Any,
) -> WitnessConfig:
    """A configuration with wires named by their location; limits: of all channels."""
    of_all = ChannelLimits(**{"frequency": (40, 500), "level": 1.0, **limits})
    return WitnessConfig(
        {wire_name(url): _KINDS[url.partition("://")[0]] for url in urls.values()},
        {
            name: AmplifierConfig(
                wire_name(url), address_of(url).number, dict.fromkeys(range(channels), of_all)
            )
            for name, url in urls.items()
        },
        times,
    )


def sense(witness: PlateWitness, now: float, name: str, amplifier: SimulatedAmplifier) -> None:
    """Show the levels and frequencies of an amplifier's channels at a time [s]."""
    channels = range(amplifier.playback.channels)
    levels = [min(amplifier.playback.level(channel, now), 1.0) for channel in channels]
    frequencies = {
        channel: tone.frequency
        for channel, output in enumerate(amplifier.outputs)
        for tone in output
        if tone.transition.last
    }
    witness.levels(now, name, levels, frequencies=frequencies)


class LoopWitness(PlateWitness):
    """A witness of all wires of a control loop, in virtual time, by the URLs of its amplifiers.

    It hears only what a host hears that has the wires open. limits: see `PlateWitness`; judged: by
    what it judges, as for `witness_config`.
    """

    def __init__(
        self,
        urls: Mapping[str, str],
        limits: PlateTimes = PlateTimes(),
        **judged: Any,
    ) -> None:
        super().__init__(witness_config(urls, **judged), limits)
        self._is_open = False
        self._active_faults = 0
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        loop.seen = self.seen

    def seen(self, link: str, toward: str, data: bytes) -> None:
        """Hear bytes, unless no host has the link open."""
        if self._is_open:
            self.record_bytes(link, toward, threads.now(), data)  # type: ignore[arg-type]

    def follow(self, controller: Controller) -> None:
        """Hear of each command, opening and closing of a control loop."""
        for command in get_args(OperatorCommand):
            tell_first(controller, command, partial(self.commanded, command))
        tell_first(controller, "open", self.opens)
        controller.release = partial(self._released, controller.release)  # type: ignore[method-assign]

    def commanded(self, command: OperatorCommand) -> None:
        """An operator's command is about to be carried out."""
        self.operator_command(threads.now(), command)

    def opens(self) -> None:
        """A host is about to open all wires."""
        self._is_open = True
        for link in self.wires:
            self.opened(link, threads.now())

    def closes(self) -> None:
        """The host has closed all, or died."""
        self._is_open = False
        for link in self.wires:
            self.closed(link, threads.now())

    async def _released(self, release: Callable[[], Awaitable[None]]) -> None:
        try:
            await release()
        finally:
            self.closes()

    def inject_fault(self, window: FaultWindow) -> None:
        """A fault begins. What it does to one wire, a controller of all may show on each."""
        self.disturb()
        lasts = window.lasts + (window.delay if window.fault == "delay" else 0.0)
        if lasts < math.inf:
            self.loop.call_later(lasts, self.disturb, -1)

    def disturb(self, change: int = 1) -> None:
        """One more fault is active on all wires, or by -1 one less."""
        self._active_faults += change
        for link in self.wires:
            self.faults(threads.now(), link, are_on=self._active_faults > 0)


def tell_first(owner: Any, method: str, tell: Callable[..., object]) -> None:
    """Report each call of a method, before it is carried out."""
    carry_out = getattr(owner, method)

    def told(*arguments: Any) -> Any:
        tell(*arguments)
        return carry_out(*arguments)

    setattr(owner, method, told)


CONTACT_TIMEOUT = 0.150  # s; a source without news for so long has lost its fingers
_GLIMPSE = 0.005  # s; a finger that is gone sooner may have come and gone between two cycles,
_TAP = 0.060  # s; and then counts for so long, so that a tap is felt


class SourceContacts:
    """The contacts of every source, by source and id; times [s]."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[float, frozenset[tuple[str, int]]]] = {}
        self._until: dict[str, float] = {}  # by source: end of its contacts
        self._since: dict[tuple[str, int], float] = {}
        self._taps: dict[tuple[str, int], float] = {}  # when those end that are lifted already

    def take(self, frame: TouchFrame, now: float) -> None:
        """Take a frame that has been delivered, and replaces what its source has said before."""
        source, stamp = frame.source, frame.time
        last = {touch.id: (touch.x, touch.y) for touch in frame.touches}
        numbers = frozenset(
            (source, number)
            for number, (x, y) in last.items()
            if 0 <= x <= 1 and 0 <= y <= 1  # NaN is not
        )
        ended, were = self._now.get(source, (-math.inf, frozenset[tuple[str, int]]()))
        were = were if now < ended else frozenset()
        for key in were - numbers:
            if stamp - self._since[key] < _GLIMPSE:
                self._taps[key] = self._since[key] + _TAP
        self._since |= dict.fromkeys(numbers - were, stamp)
        lasts = frame.timeout or CONTACT_TIMEOUT
        end = min(stamp, now) + lasts if math.isfinite(stamp) else -math.inf
        self._now[source] = end, numbers
        before = min(self._until.get(source, -math.inf), now)
        self._until[source] = max(end if numbers else -math.inf, before)

    @property
    def last(self) -> float:
        """When the plate is or was touched last, as far as is known."""
        return max([*self._until.values(), *self._taps.values()], default=-math.inf)

    def at(self, now: float) -> frozenset[tuple[str, int]]:
        """All that are on the plate."""
        taps = {key for key, end in self._taps.items() if now < end}
        return frozenset(taps).union(*(keys for end, keys in self._now.values() if now < end))

    def next_end(self, now: float) -> float:
        """When the first source is overdue if nothing more is heard; infinity if none can be."""
        ends = [end for end, keys in self._now.values() if keys]
        return min((end for end in (*ends, *self._taps.values()) if end > now), default=math.inf)


_ENDED = 1e-6  # s; after contacts have ended
AUDIBLE = 1e-3  # of full stroke; below it a ramp counts as ended
WATCHDOG = 0.25  # s; of armed amplifiers
_SILENCING = 0.005  # s; then every channel is silent
# s; three unanswered requests, then the watchdog, and a heartbeat that was on its way.
RELEASE_WITH_FAULTS = 3 * 0.15 + WATCHDOG + _SILENCING + 0.1
TOGETHER = 0.6  # s; until all are silent after one of them has a fault
STEP = 0.020  # s; check interval while a channel vibrates
IDLE_STEP = 1.0
# Those with a ramp to silence of their own end what the watchdog would.
_SILENCING_REQUESTS = ("Disarm", "Stop")
_FAULTED = (STATES["FAULT"], STATES["FAULT_REACTION_ACTIVE"])


class PlateJudge:
    """Judges what plays at the far ends, and lets the witness sense it and know of the contacts.

    step [s]: between two looks while a channel vibrates; watchdog [s]: of armed amplifiers; what
    plays without fingers is judged once there has been one. violations: those found, each with its
    time; contacts: all that are on the plate.
    """

    def __init__(
        self,
        far: FarSide,
        witness: LoopWitness,
        *,
        step: float = STEP,
        watchdog: float = WATCHDOG,
    ) -> None:
        self.violations: list[str] = []
        self.contacts = SourceContacts()
        self._bench = far.bench
        self._witness = witness
        self._step = step
        self._watchdog = watchdog
        self._fed = dict.fromkeys(far.devices, -math.inf)
        self._faulted: dict[str, float] = {}
        self._loop = asyncio.get_running_loop()
        self._next = self._loop.call_later(IDLE_STEP, self._watch)
        self._expiry: asyncio.TimerHandle | None = None
        for name, device in far.devices.items():
            after_each(device, partial(self._exchanged, name))
            device.listeners.append(partial(self._received, name))

    def violate(self, what: str) -> None:
        """Record a violation."""
        if len(self.violations) < 20:
            self.violations.append(f"{self._loop.time() - START:.6f} {what}")

    def touched(self, frame: TouchFrame, *, must_be_felt: bool) -> None:
        """Note a frame of a source; must_be_felt: whether new contacts must lead to a pattern."""
        self.contacts.take(frame, self._loop.time())
        self._show_contacts(must_be_felt=must_be_felt)

    def _show_contacts(self, *, must_be_felt: bool = False) -> None:
        now = self._loop.time()
        self._witness.contacts(now, self.contacts.at(now), is_answerable=must_be_felt)
        end = self.contacts.next_end(now) + _ENDED
        if self._expiry is not None:
            self._expiry.cancel()
            self._expiry = None
        if end < math.inf:
            self._expiry = self._loop.call_at(end, self._show_contacts)

    def check(self) -> None:
        """Advance the bench to now, and check it."""
        now = self._loop.time()
        self._bench.advance(now)
        for name, amplifier in self._bench.amplifiers.items():
            playback = amplifier.playback
            level = max(min(playback.level(each, now), 1.0) for each in range(playback.channels))
            if not level <= AUDIBLE:
                self._check_loud(name, level, now)
            sense(self._witness, now, name, amplifier)

    def loudest(self, name: str, within: float, looks: int) -> float:
        """Highest level that an amplifier plays within a time [s] without a request, in looks."""
        now, playback = self._loop.time(), self._bench.amplifiers[name].playback
        self._bench.advance(now)
        return max(
            playback.level(channel, now + within * number / looks)
            for number in range(looks)
            for channel in range(playback.channels)
        )

    def close(self) -> None:
        """Stop checking."""
        self._next.cancel()
        if self._expiry is not None:
            self._expiry.cancel()

    def _exchanged(self, name: str, request: str, *_: object) -> None:
        """Note that an amplifier has carried out a request."""
        now = self._loop.time()
        if request == "Arm":
            self._faulted.pop(name, None)
        if MESSAGES[request].feeds or request in _SILENCING_REQUESTS:
            self._fed[name] = now
        if self._due() < self._next.when():
            self._watch()

    def _watch(self) -> None:
        """Check periodically, more often while a channel vibrates."""
        self._next.cancel()
        self.check()
        self._next = self._loop.call_at(self._due(), self._watch)

    def _due(self) -> float:
        """When to check next: the amplifiers have nothing to wake them but this."""
        now, amplifiers = self._loop.time(), self._bench.amplifiers.values()
        plays = any(
            tone.silent_from > now
            for each in amplifiers
            for output in each.outputs
            for tone in output
        )
        step = self._step if plays else IDLE_STEP
        return min(now + step, *(each.next_event for each in amplifiers))

    def _received(self, name: str, event: Values, at: float) -> None:
        if event["state"] in _FAULTED:
            self._faulted.setdefault(name, at)
        else:
            self._faulted.pop(name, None)

    def _check_loud(self, name: str, level: float, now: float) -> None:
        bounds = {"it was fed": (self._fed[name], self._watchdog + _SILENCING)}
        if self.contacts.last > -math.inf:
            bounds["the last finger"] = (self.contacts.last, RELEASE_WITH_FAULTS)
        for other in self._faulted.keys() - {name}:
            bounds[f"the fault of {other}"] = (self._faulted[other], TOGETHER)
        for what, (since, bound) in bounds.items():
            if now - since > bound:
                self.violate(f"{name} plays at {level:.4f} {now - since:.4f} s after {what}")
