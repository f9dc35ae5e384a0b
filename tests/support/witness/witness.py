"""The witness: bytes of every wire in, violations out, without a clock and I/O.

A watched wire relates replies to requests, and passes both to the rules for hosts and the model of
the amplifier.
"""

import math
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import partial

from witness.capture import (
    BROADCAST_REQUESTS,
    CHANGING,
    FEEDING,
    HELLO_REQUEST,
    Decoder,
    Notice,
    RuleViolation,
    SerialDecoder,
    TimeLimits,
    TransferDirection,
    WitnessConfig,
    WitnessedMessage,
    WitnessedReply,
    WitnessedRequest,
    WitnessReport,
)
from witness.decoders import CanDecoder, ModbusDecoder
from witness.host_rules import (
    AmplifierSession,
    HostRules,
    RuleDeadlines,
    WatchedAmplifier,
    check_sums,
)

RECOVERY = 0.5  # s; after a disturbance a wire counts as disturbed for so long
_COPIES = 64  # frames kept to recognise repeated ones
_PENDING_TIMEOUT = 1.0  # s; then a reply matches nothing any more
_PRESENT = ("GetStatus", "GetFaults")
"""Requests that are carried out when their reply is read, on Modbus."""
_CONSTANT = (HELLO_REQUEST, "GetCaps")

DECODERS: Mapping[str, Callable[[], Decoder]] = {
    "serial": SerialDecoder,
    "modbus-tcp": partial(ModbusDecoder, over_tcp=True),
    "modbus-rtu": partial(ModbusDecoder, over_tcp=False),
    "socketcand": partial(CanDecoder, "socketcand"),
    "slcan": partial(CanDecoder, "slcan"),
}
"""Decoders by the kind of wire."""


class WatchedWire:
    """A wire; sessions: by the addresses of the amplifiers."""

    def __init__(
        self,
        name: str,
        kind: str,
        sessions: Mapping[int, AmplifierSession],
        *,
        host: HostRules,
        times: TimeLimits,
        deadlines: RuleDeadlines,
        report: WitnessReport,
    ) -> None:
        self.name = name
        self.sessions = dict(sessions)
        self._kind = kind
        self._decoder = DECODERS[kind]()
        self._host, self._times, self._deadlines, self._report = host, times, deadlines, report
        self.started_at: dict[TransferDirection, float] = {}
        """When [s] partial frames began."""
        self._pending: dict[Hashable, WitnessedRequest] = {}  # by key of the reply
        self._recent: deque[tuple[float, bytes]] = deque(maxlen=_COPIES)  # of the host, and when
        self._replied: deque[Hashable] = deque(maxlen=_COPIES)
        self._number = self._preempted_by = 0  # of the last request, and of one that preempts
        self._damaged_at = -math.inf  # when a frame of the host was damaged last [s]
        self.disturbed_until = -math.inf
        """Before this time [s] only rules are checked that nothing excuses."""

    # host

    def opened(self, time: float) -> None:
        """Note that a host has opened it: its amplifiers are not identified yet."""
        self._decoder, self.started_at = DECODERS[self._kind](), {}
        self._forget_pending(time)
        for session in self.sessions.values():
            session.is_open, session.is_identified, session.session = True, False, None
            session.is_requested = True
            session.forget_amplifier()

    def closed(self, time: float) -> None:
        """Note that the host has closed or lost it."""
        for sent in self._pending.values():
            if sent.name in CHANGING:  # it may be executed unheard
                self.sessions[sent.address].amplifier.forget()
        self._forget_pending(time)
        for session in self.sessions.values():
            session.is_open = False
            session.last_feed = session.first_stop = None

    def _forget_pending(self, time: float) -> None:
        """Abandon the pending requests; their replies may still arrive, and at another host."""
        if self._pending:
            self.disturb(time)
        self._replied.extend(self._pending)
        self._pending.clear()

    def _drop_pending(self, session: AmplifierSession) -> None:
        """Expect no reply to what was sent to an amplifier."""
        self._pending = {
            key: sent
            for key, sent in self._pending.items()
            if self.sessions[sent.address] is not session
        }

    def is_disturbed(self, time: float) -> bool:
        """Whether replies may have been lost shortly before a time [s]."""
        return time <= self.disturbed_until

    def disturb(self, time: float) -> None:
        """Count as disturbed for a while from a time [s] on."""
        self.disturbed_until = max(self.disturbed_until, time + RECOVERY)

    # frames

    def feed(self, direction: TransferDirection, time: float, data: bytes) -> int:
        """Process bytes; returns how many frames they complete."""
        started_at = self.started_at.pop(direction, time)
        found = self._decoder.feed(direction, time, data)
        if self._decoder.rest[direction]:
            self.started_at[direction] = time if found else started_at
        for raw, message in found:
            self._report.frame(self.name, time, direction, raw)
            if isinstance(message, Notice) and message.what == "damaged":
                since = min(started_at, message.started_at)
                if direction == "amplifier":
                    self._damaged_at = time
                if not self.is_disturbed(since):
                    sender = "host" if direction == "amplifier" else "amplifier"
                    self._report.add(self.name, "garbage", time, f"{sender} sent {message.text}")
            elif direction == "amplifier" and message is not None:
                self._sent(time, raw, message, started_at)
            elif message is not None:
                self._received(time, message)
            started_at = time  # of those behind the first
        return len(found)

    def advance(self, now: float) -> None:
        """Report replies that are overdue."""
        for key, sent in list(self._pending.items()):
            since = max(sent.since, self.started_at.get("host", -math.inf))
            due = since + self._times.reply + self._times.slack
            due += self._deadlines.delay_since(since)
            if now > due and not sent.is_overdue:
                sent.is_overdue = True
                session = self.sessions[sent.address]
                session.overdue_at = now
                if not (session.is_mute or self.is_disturbed(due)):
                    what = f"no reply to {sent.name} of {sent.started_at:.4f} s"
                    session.report_always("answer", now, f"{session.name}: {what}")
            if now > sent.started_at + _PENDING_TIMEOUT:
                del self._pending[key]

    def _sent(self, time: float, raw: bytes, message: WitnessedMessage, started_at: float) -> None:
        """Process a frame of the host."""
        # Numbers of requests begin anew: what was sent long ago is no copy.
        recent = [each for then, each in self._recent if time <= then + RECOVERY]
        is_copy = self.is_disturbed(time) and raw in recent
        self._recent.append((time, raw))
        if isinstance(message, Notice):
            self._noticed(time, message)
        if not isinstance(message, WitnessedRequest):
            return
        self._number += 1
        started_at = min(started_at, message.started_at)
        sent = replace(
            message, number=self._number, started_at=started_at, since=time, earliest=started_at
        )
        addressed = self.sessions.get(message.address)
        sessions = self.sessions.values() if message.address == 0 else (addressed,)
        for session in [each for each in sessions if each is not None]:
            if not is_copy:
                self._check_request(session, time, sent)
            if session.is_mute and message.name == HELLO_REQUEST:
                self._drop_pending(session)  # never to be replied to
            has_response = message.has_reply or self._kind.startswith("modbus")
            is_awaited = message.key is not None and has_response
            if (
                message.key is not None
                and is_awaited
                and (not is_copy or message.name == HELLO_REQUEST)
            ):
                self._pending[message.key] = sent
            session.is_mute &= message.name != HELLO_REQUEST
            if message.problem:
                continue
            if not session.is_mute:
                session.amplifier.sent(sent)
            if message.key is None:
                self._move(session, message)

    def _check_request(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> None:
        problem = request.problem
        if request.name == "Set" and not problem:
            problem = session.amplifier.set_sent(request)
        if problem:
            session.report_always("garbage", time, f"host sent {request.name}: {problem}")
        if request.problem:
            return
        if self._host.is_preempting(session, time, request):
            self._preempted_by = request.number
        elif not self.is_disturbed(request.started_at):
            is_tcp = self._kind == "modbus-tcp"
            is_to_each = is_tcp and len(self.sessions) > 1
            pending = [
                one
                for one in self._pending.values()
                if not (
                    (is_to_each and one.name in BROADCAST_REQUESTS)
                    or (is_tcp and not one.has_reply)
                )
            ]
            self._host.check_order(session, request, pending, self._preempted_by)
        self._host.check_request(session, time, request)

    def _noticed(self, time: float, notice: Notice) -> None:
        """Process what is no request, and no reply."""
        sent = self._pending.get(notice.key)
        session = self.sessions.get(notice.address)
        match notice.what:
            case "carried out" if sent is not None and not sent.has_reply:
                del self._pending[notice.key]
            case "carried out" if sent is not None:
                sent.since, sent.end = math.inf, time
            case "read on" if sent is not None:
                sent.since = time
                if sent.name in _PRESENT:
                    sent.earliest, sent.end = time, None
            case "event" if session is not None:
                session.amplifier.event_reported(notice.values, time)
            case "other host" if session is not None and notice.text in FEEDING:
                session.heard_other_host = time
                session.amplifier.forget()

    def _received(self, time: float, message: WitnessedMessage) -> None:
        """Process a frame of an amplifier."""
        session = self.sessions.get(message.address)
        match message:
            case WitnessedReply() if session is not None:
                self._process_reply(session, time, message)
            case Notice(what="boot") if session is not None:
                if session.amplifier.is_enabled:
                    session.report("state", time, f"{session.name} restarted while enabled")
                session.forget_amplifier()
                session.amplifier.restarted(time)
                session.is_mute = True
            case Notice():
                self._noticed(time, message)

    def _process_reply(self, session: AmplifierSession, time: float, reply: WitnessedReply) -> None:
        request = self._pending.pop(reply.key, None)
        if request is None:
            self._check_unexpected(session, time, reply)
            return
        self._replied.append(reply.key)
        amplifier = session.amplifier
        if reply.problem:
            session.report(
                "garbage", time, f"{session.name} replied to {request.name}: {reply.problem}"
            )
        amplifier.unanswered = [one for one in amplifier.unanswered if one is not request]
        if reply.refusal:
            amplifier.refused(request, reply.refusal, time)
        elif reply.problem or (request.problem and request.name != HELLO_REQUEST):
            if request.problem:
                session.report_always(
                    "garbage", time, f"{session.name} accepted {request.name}: {request.problem}"
                )
            amplifier.forget()
        elif reply.values is not None:  # else not all of it was read
            self._granted(session, time, request, reply)

    def _granted(
        self,
        session: AmplifierSession,
        time: float,
        request: WitnessedRequest,
        reply: WitnessedReply,
    ) -> None:
        amplifier, values = session.amplifier, reply.values or {}
        if request.name in _CONSTANT:
            session.check_constant(request.name, values, time)
        if request.name == "GetCaps":
            amplifier.identified(values)
        self._host.request_granted(session, time, request)
        if self.is_disturbed(time):
            if request.name == "Arm":
                amplifier.forget()
            amplifier.clock.unheard()
        self._host.status_heard(session, values)
        token = amplifier.token
        amplifier.replied(request, values, time if request.end is None else request.end)
        if amplifier.token != token and not self.is_disturbed(time):
            check_sums(session, request.earliest)
        self._move(session, request)

    def _move(self, session: AmplifierSession, request: WitnessedRequest) -> None:
        """Follow an amplifier to the address that it is set to, by its serial number."""
        known = session.constants.get(HELLO_REQUEST, {}).get("serial_number")
        if request.name == "SetAddress" and request.values["serial_number"] == known:
            others = {at: one for at, one in self.sessions.items() if one is not session}
            self.sessions = {**others, request.values["address"]: session}

    def _check_unexpected(
        self, session: AmplifierSession, time: float, reply: WitnessedReply
    ) -> None:
        is_new = reply.key not in self._replied
        if reply.key is None:
            is_new = not self.is_disturbed(time)
        if time < self._damaged_at + self._times.reply and is_new:
            session.report_always("damage", time, f"{session.name} executed a damaged frame")
        else:
            why = f": {reply.problem}" if reply.problem else ""
            session.report("credit", time, f"{session.name}: reply without a pending request{why}")


class Witness:
    """Checks the wires of a configuration (`witness.capture`); times in s.

    rules: for hosts.
    """

    def __init__(
        self,
        config: WitnessConfig,
        *,
        rules: type[HostRules] = HostRules,
    ) -> None:
        self._config = config
        self._report = WitnessReport()
        self._now = -math.inf
        self.frames = 0
        self._sessions = {name: self._session(name) for name in self._config.amplifiers}
        times = self._config.times
        self._deadlines = RuleDeadlines()
        self._host = rules(self._sessions, times=times, deadlines=self._deadlines)
        self._wires = {
            wire: WatchedWire(
                wire,
                kind,
                {
                    one.config.address: one
                    for one in self._sessions.values()
                    if one.config.wire == wire
                },
                host=self._host,
                times=times,
                deadlines=self._deadlines,
                report=self._report,
            )
            for wire, kind in self._config.wires.items()
        }
        self.wires = tuple(self._wires)
        """The names of the wires."""

    def _session(self, name: str) -> AmplifierSession:
        config = self._config.amplifiers[name]
        report_always = partial(self._report.add, config.wire)

        def is_disturbed(time: float) -> bool:
            return self._wires[config.wire].is_disturbed(time)

        def report(invariant: str, time: float, sentence: str) -> None:
            if not is_disturbed(time):
                report_always(invariant, time, sentence)

        slack = self._config.times.slack
        amplifier = WatchedAmplifier(name, slack=slack, report=report, report_always=report_always)
        return AmplifierSession(name, config, amplifier, report_always, report, is_disturbed)

    def record_bytes(
        self, link: str, direction: TransferDirection, time: float, data: bytes
    ) -> None:
        """Process bytes on a wire, toward the amplifier or the host."""
        self._advance(time)
        self.frames += self._wires[link].feed(direction, time, data)

    def delayed(self, until: float, duration: float) -> None:
        """Note that this program did not run for a duration [s] until a time [s].

        Deadlines of hosts and amplifiers are extended by it: what came in time was seen late.
        """
        self._deadlines.delayed(until, duration)

    def opened(self, link: str, time: float) -> None:
        """Note that a host has opened a wire: its amplifiers are not identified yet."""
        self._advance(time)
        self._wires[link].opened(time)

    def closed(self, link: str, time: float) -> None:
        """Note that the host has closed or lost a wire."""
        self._advance(time)
        self._wires[link].closed(time)

    def finish(self, time: float | None = None) -> list[RuleViolation]:
        """The violations in order; time [s]: end of the observation."""
        if time is not None:
            self._advance(time)
        return list(self._report.found)

    def _advance(self, time: float) -> None:
        self._now = max(self._now, time)
        self._host.advance(self._now)
        for session in self._sessions.values():
            session.amplifier.advance(self._now)
        for wire in self._wires.values():
            wire.advance(self._now)
