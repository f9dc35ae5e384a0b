"""Match replies with requests, and pass both to the rules of host and amplifier."""

import math

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.capture import Direction
from sim.witness.config import TimeLimits
from sim.witness.decoded import (
    REPLY_TO_DAMAGED_FRAME,
    SETS,
    STATE_CHANGING,
    BootUp,
    Damaged,
    Data,
    Message,
    Reply,
    Request,
    RequestKind,
    StateEvent,
)
from sim.witness.delays import Delays
from sim.witness.host_rules import HostRules
from sim.witness.violation import Report
from sim.witness.watched_wire import WatchedWire

_PENDING_TIMEOUT = 1.0  # s; then a reply matches nothing any more
_FADING = 12
_ANY_UNIT = 255  # of Modbus TCP: the only one


class Exchanges:
    """The frames of all wires in order; host: the rules for requests."""

    def __init__(
        self, host: HostRules, *, times: TimeLimits, delays: Delays, report: Report
    ) -> None:
        self._host = host
        self._delays = delays
        self._times = times
        self._report = report

    def check_overdue(self, session: AmplifierSession, now: float) -> None:
        """Report replies that are overdue."""
        for key, (at, request) in list(session.pending.items()):
            due = at + self._times.reply + self._times.slack + self._delays.since(at)
            if now > due and key not in session.overdue:
                session.overdue.add(key)
                if request.kind in STATE_CHANGING:
                    session.amplifier.forget_state()
                if not session.is_disturbed(due):
                    what = f"{session.name}: no reply to {request.kind.value} of {at:.4f} s"
                    session.report("answer", now, what)
            if now > at + _PENDING_TIMEOUT:
                session.overdue.discard(key)
                session.superseded.discard(key)
                session.overtaken.discard(key)
                del session.pending[key]

    def sent(self, wire: WatchedWire, time: float, raw: Data, message: Message) -> None:
        """Process a frame from the host."""
        is_incomplete = isinstance(message, Request) and message.is_incomplete_set
        is_copy = wire.is_disturbed(time) and (raw in wire.recent or is_incomplete)
        wire.recent.append(raw)
        if not isinstance(message, Request):
            return
        for session in self._addressed(wire, message.address):
            if message.kind is RequestKind.PING:
                session.last_ping = time
            if not is_copy:
                self._host.check_request(session, time, message)
            if message.kind in SETS:
                session.voices.sent(message)
            if message.key is None:
                self._process_unconfirmed(session, time, message)
            else:
                session.pending[message.key] = (time, message)
                session.overdue.discard(message.key)
                session.superseded.discard(message.key)
                session.overtaken.discard(message.key)
                if not message.problem and (
                    message.kind in STATE_CHANGING or message.kind is RequestKind.PING
                ):
                    session.amplifier.may_feed(time)

    def damaged(
        self,
        wire: WatchedWire,
        time: float,
        direction: Direction,
        damaged: Damaged,
        *,
        begun: float,
    ) -> None:
        """Process a damaged frame; begun [s]: when its first byte passed."""
        if not wire.is_disturbed(begun):
            sender = "host" if direction == "amplifier" else "amplifier"
            self._report.add("garbage", wire.name, time, f"{sender} sent {damaged.reason}")

    def received(self, wire: WatchedWire, time: float, message: Message) -> None:
        """Process a frame from an amplifier."""
        if isinstance(message, Request | Damaged):
            return
        session = wire.sessions.get(message.address)
        if session is None and message.address == _ANY_UNIT:
            session = next(iter(wire.sessions.values()), None)
        if session is None:
            return
        if isinstance(message, BootUp):
            if session.amplifier.is_enabled and not session.is_disturbed(time):
                session.report("state", time, f"{session.name} restarted while enabled")
            session.amplifier.restarted(time)
            session.constants.clear()
            session.vibrates = False
        elif isinstance(message, StateEvent):
            if not any(request.kind in STATE_CHANGING for _, request in session.pending.values()):
                session.amplifier.event_received(message.state, message.fault, time)
        else:
            self._process_reply(session, time, message)

    def _addressed(self, wire: WatchedWire, address: int) -> list[AmplifierSession]:
        if address == 0:
            return list(wire.sessions.values())
        session = wire.sessions.get(address)
        if session is None and address == _ANY_UNIT and wire.kind == "modbus-tcp":
            session = next(iter(wire.sessions.values()), None)
        return [] if session is None else [session]

    def _process_unconfirmed(
        self, session: AmplifierSession, time: float, request: Request
    ) -> None:
        """Process a broadcast, a host's heartbeat on CAN, or an SDO transfer."""
        if request.kind is RequestKind.PING and session.amplifier.state is not None:
            if session.is_disturbed(time):
                session.amplifier.may_feed(time)
            else:
                session.amplifier.feed(time)
        elif request.kind is RequestKind.HELLO:
            self._host.request_granted(session, time, request)
        elif request.kind in (RequestKind.STOP, RequestKind.COMMIT):
            if request.kind is RequestKind.STOP:
                session.overtaken.update(session.pending)
            session.amplifier.broadcast_sent(request, time)
            self._host.request_granted(session, time, request)

    def _process_reply(self, session: AmplifierSession, time: float, reply: Reply) -> None:
        session.voices.stated = reply.voices or session.voices.stated
        if reply.key == "objects":
            session.amplifier.may_feed(time)
            self._process_object(session, time, reply)
            return
        if reply.problem == REPLY_TO_DAMAGED_FRAME:
            session.report("damage", time, f"{session.name} executed a damaged frame")
            return
        at, request = session.pending.pop(reply.key, (math.inf, None))
        if request is None:
            self._check_unexpected(session, time, reply)
            return
        if reply.problem and not session.is_disturbed(time):
            what = f"incomplete reply of {session.name}: {reply.problem}"
            session.report("answer", time, what)
        was_lost = reply.key in session.overdue or reply.key in session.superseded
        is_overtaken = reply.key in session.overtaken
        session.overtaken.discard(reply.key)
        session.overdue.discard(reply.key)
        session.superseded.discard(reply.key)
        if reply.refusal:
            session.amplifier.watchdog.undo_feed()
        elif request.problem:
            rule = "commit" if request.is_incomplete_set else "garbage"
            what = f"{session.name} accepted {request.kind.value}: {request.problem}"
            session.report(rule, time, what)
        if request.kind is RequestKind.HELLO:
            self._host.request_granted(session, time, request)
        if reply.constant is not None:
            what = f"reply to {request.kind.value} of {len(reply.constant)} bytes"
            session.check_constant(what, reply.constant, time)
        if reply.faults is not None and not was_lost:
            session.amplifier.faults_reported(reply.faults, at, time)
        if was_lost or request.problem:
            return
        if reply.refusal:
            session.voices.refused(request.token)
            if reply.refusal == _FADING and not session.is_disturbed(time):
                self._report_fading(session, time, request.token)
            if reply.status is not None and not is_overtaken:
                session.amplifier.refusal_received(reply.status, at, time)
            return
        if request.kind in SETS:
            session.voices.granted(request, time)
        if request.kind in STATE_CHANGING:
            # The first attempt may have been executed and its reply lost.
            same = {
                key: before
                for key, (before, other) in session.pending.items()
                if other.kind is request.kind and other.token == request.token
            }
            at = min([at, *same.values()])
            session.superseded.update(same)
        if is_overtaken:  # carried out before the Stop, answered after it
            session.amplifier.granted_before_stop(request, reply, at, time)
            return
        self._host.request_granted(session, time, request)
        if session.is_disturbed(time) and request.kind is RequestKind.ARM:
            session.amplifier.forget_state()
        session.amplifier.request_granted(request, reply, at, time)

    def _process_object(self, session: AmplifierSession, time: float, reply: Reply) -> None:
        """Process an object that was read over CAN."""
        if reply.item is None or session.is_disturbed(time) or session.is_disturbed(reply.begun):
            return
        name = f"object {reply.item[0]:04X}sub{reply.item[1]}"
        if reply.problem:
            session.report("answer", time, f"{session.name}: {name}: {reply.problem}")
        if reply.constant is not None:
            session.check_constant(name, reply.constant, time)
        if reply.faults is not None:
            session.amplifier.faults_reported(reply.faults, reply.begun, time)

    def _report_fading(self, session: AmplifierSession, time: float, token: int) -> None:
        """Report a set that had no room, or was refused although it had."""
        stated, possible = session.voices.stated, session.voices.at(time)
        if possible < stated:
            what = f"{session.name} refused set {token} as voice {possible + 1} of {stated}"
        else:
            what = f"host sent set {token} to {session.name}, whose voices all sound"
        session.report("voices", time, what)

    def _check_unexpected(self, session: AmplifierSession, time: float, reply: Reply) -> None:
        was_abandoned = reply.key in session.abandoned
        session.abandoned.discard(reply.key)
        if not (was_abandoned or session.is_disturbed(time)):
            why = f": {reply.problem}" if reply.problem else ""
            session.report("credit", time, f"{session.name}: reply without a pending request{why}")
