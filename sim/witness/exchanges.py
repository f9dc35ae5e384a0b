"""Match replies with requests, and pass both to the rules of host and amplifier."""

import math

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.capture import Direction
from sim.witness.config import TimeLimits
from sim.witness.decoded import (
    FEEDING,
    HELLO,
    BootUp,
    Damaged,
    Event,
    Message,
    OtherHost,
    Progress,
    Reply,
    Request,
)
from sim.witness.delays import Delays
from sim.witness.host_rules import HostRules
from sim.witness.set_rules import check_sums
from sim.witness.unanswered import Sent
from sim.witness.violation import Report
from sim.witness.watched_wire import Pending, WatchedWire

_PENDING_TIMEOUT = 1.0  # s; then a reply matches nothing any more
_PRESENT = ("GetStatus", "GetFaults")
"""Requests that are carried out when their reply is read, on Modbus."""
_CONSTANT = (HELLO, "GetCaps")


class Exchanges:
    """The frames of all wires in order; host: the rules for requests."""

    def __init__(
        self, host: HostRules, *, times: TimeLimits, delays: Delays, report: Report
    ) -> None:
        self._host = host
        self._delays = delays
        self._times = times
        self._report = report
        self._number = 0  # of the last request

    def check_overdue(self, wire: WatchedWire, now: float) -> None:
        """Report replies that are overdue."""
        for key, pending in list(wire.pending.items()):
            session, sent = pending.session, pending.sent
            since = max(pending.since, wire.begun("host"))
            due = since + self._times.reply + self._times.slack + self._delays.since(since)
            if now > due and not pending.is_overdue:
                pending.is_overdue = True
                if not session.is_disturbed(due):
                    what = f"{session.name}: no reply to {sent.request.name} of {sent.begun:.4f} s"
                    session.report("answer", now, what)
            if now > sent.begun + _PENDING_TIMEOUT:
                del wire.pending[key]

    def damaged(
        self, wire: WatchedWire, time: float, direction: Direction, damaged: Damaged, begun: float
    ) -> None:
        """Process a damaged frame; begun [s]: when its first byte passed."""
        if direction == "amplifier":
            wire.damaged_at = time
        if not wire.is_disturbed(begun):
            sender = "host" if direction == "amplifier" else "amplifier"
            self._report.add("garbage", wire.name, time, f"{sender} sent {damaged.reason}")

    def sent(
        self, wire: WatchedWire, time: float, raw: bytes, message: Message, begun: float
    ) -> None:
        """Process a frame from the host; begun [s]: when its first byte passed."""
        is_copy = wire.is_disturbed(time) and raw in wire.recent
        wire.recent.append(raw)
        if isinstance(message, BootUp):  # it is reset, as is any node by number 0
            for address, session in wire.sessions.items():
                if message.address in (0, address):
                    session.amplifier.forget_state()
        elif isinstance(message, Progress) and message.key in wire.pending:
            pending = wire.pending[message.key]
            pending.since = time
            if pending.sent.request.name in _PRESENT:
                pending.begin, pending.executed_by = time, None
        if not isinstance(message, Request):
            return
        begun = begun if message.begun is None else min(begun, message.begun)
        self._number += 1
        sent = Sent(self._number, begun, message, message.key)
        for session in _addressed(wire, message.address):
            if not is_copy:
                self._host.check_request(wire, session, time, sent)
            if message.key is not None and (not is_copy or message.name == HELLO):
                wire.pending[message.key] = Pending(session, sent, time, begun)
            if not message.problem:
                session.amplifier.sent(sent)

    def received(self, wire: WatchedWire, time: float, message: Message) -> None:
        """Process a frame from an amplifier."""
        if isinstance(message, Progress):
            if (pending := wire.pending.get(message.key)) is not None:
                pending.since, pending.executed_by = math.inf, time
            return
        if isinstance(message, Request | Damaged):
            return
        session = wire.sessions.get(message.address)
        if session is None:
            return
        if isinstance(message, BootUp):
            if session.amplifier.is_enabled and not session.is_disturbed(time):
                session.report("state", time, f"{session.name} restarted while enabled")
            session.amplifier.restarted(time)
            session.constants.clear()
            session.layers.clear()
        elif isinstance(message, Event):
            session.amplifier.event_reported(message.values, time)
        elif isinstance(message, OtherHost):
            if message.name in FEEDING:
                session.heard_other_host = time
                session.amplifier.forget_state()
        else:
            self._process_reply(wire, session, time, message)

    def _process_reply(
        self, wire: WatchedWire, session: AmplifierSession, time: float, reply: Reply
    ) -> None:
        pending = wire.pending.pop(reply.key, None)
        if pending is None or pending.session is not session:
            self._check_unexpected(wire, session, time, reply)
            return
        wire.answered.append(reply.key)
        sent, amplifier = pending.sent, session.amplifier
        request = sent.request
        if reply.problem and not session.is_disturbed(time):
            what = f"{session.name} replied to {request.name}: {reply.problem}"
            session.report("garbage", time, what)
        amplifier.answered(sent)
        if reply.refusal:
            amplifier.refused(request, time)
            return
        if request.problem:
            what = f"{session.name} accepted {request.name}: {request.problem}"
            session.report("garbage", time, what)
        if request.problem or reply.problem:
            amplifier.forget_state()
            return
        if reply.values is None:  # not all of it was read
            return
        if request.name in _CONSTANT:
            session.check_constant(request.name, reply.values, time)
        if request.name == "GetCaps":
            amplifier.identified(reply.values)
        self._host.request_granted(session, time, request)
        if session.is_disturbed(time) and request.name == "Arm":
            amplifier.forget_state()
        self._host.status_heard(session, time, reply.values)
        end = time if pending.executed_by is None else pending.executed_by
        token = amplifier.token
        amplifier.granted(sent, reply.values, pending.begin, end)
        if amplifier.token != token and not session.is_disturbed(time):
            check_sums(session, pending.begin)

    def _check_unexpected(
        self, wire: WatchedWire, session: AmplifierSession, time: float, reply: Reply
    ) -> None:
        is_abandoned = reply.key in wire.abandoned
        wire.abandoned.discard(reply.key)
        is_new = (
            reply.key not in wire.answered
            if reply.key is not None
            else not session.is_disturbed(time)
        )
        if time < wire.damaged_at + self._times.reply and is_new and not is_abandoned:
            session.report("damage", time, f"{session.name} executed a damaged frame")
        elif not (is_abandoned or session.is_disturbed(time)):
            why = f": {reply.problem}" if reply.problem else ""
            session.report("credit", time, f"{session.name}: reply without a pending request{why}")


def _addressed(wire: WatchedWire, address: int) -> list[AmplifierSession]:
    if address == 0:
        return list(wire.sessions.values())
    session = wire.sessions.get(address)
    return [] if session is None else [session]
