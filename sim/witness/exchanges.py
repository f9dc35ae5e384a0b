"""Which answer belongs to which request, and what the two of them mean together."""

import math

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.config import TimeLimits
from sim.witness.decoded import (
    REPLY_TO_DAMAGED_FRAME,
    STATE_CHANGING,
    BootUp,
    Damaged,
    Data,
    Direction,
    Message,
    Reply,
    Request,
    RequestKind,
    StateEvent,
)
from sim.witness.host_rules import HostRules
from sim.witness.violation import Report
from sim.witness.watched_wire import WatchedWire

_FORGOTTEN = 1.0  # s; an answer that comes later was meant for nobody


class Exchanges:
    """The frames of all wires, as they are seen one by one.

    host is told what it has asked and was granted, the follower of each amplifier what that did.
    """

    def __init__(self, host: HostRules, *, times: TimeLimits, report: Report) -> None:
        self._host = host
        self._times = times
        self._report = report

    def check_overdue(self, session: AmplifierSession, now: float) -> None:
        """Complain of answers that ought to be there by now."""
        for key, (at, request) in list(session.pending.items()):
            due = at + self._times.reply + self._times.slack
            if now > due and key not in session.overdue:
                session.overdue.add(key)
                if request.kind in STATE_CHANGING:
                    session.amplifier.forget_state()
                if not session.is_disturbed(due):
                    what = f"{session.name} has not answered {request.kind.value} of {at:.4f} s"
                    session.report("answer", now, what)
            if now > at + _FORGOTTEN:
                session.overdue.discard(key)
                session.superseded.discard(key)
                del session.pending[key]

    def sent(self, wire: WatchedWire, time: float, raw: Data, message: Message) -> None:
        """A frame toward the amplifiers."""
        is_torn = isinstance(message, Request) and message.problem.startswith("torn")
        is_copy = wire.is_disturbed(time) and (raw in wire.recent or is_torn)
        wire.recent.append(raw)
        if not isinstance(message, Request):
            return
        sessions = wire.sessions.values() if message.address == 0 else ()
        alone = wire.sessions.get(message.address)
        if alone is None and message.address == 255 and wire.kind == "modbus-tcp":
            alone = next(iter(wire.sessions.values()), None)
        for session in (*sessions, *((alone,) if alone is not None else ())):
            if not is_copy:
                self._host.check_request(session, time, message)
            if message.key is None:
                self._unanswered(session, time, message)
            else:
                session.pending[message.key] = (time, message)
                session.overdue.discard(message.key)
                session.superseded.discard(message.key)
                if not message.problem and message.kind is not RequestKind.READ:
                    self._may_feed(session, time, message)

    def damaged(
        self,
        wire: WatchedWire,
        time: float,
        direction: Direction,
        damaged: Damaged,
        *,
        begun: float,
    ) -> None:
        """A frame that is none; begun [s]: when the first of it has passed, maybe amid trouble."""
        if not wire.is_disturbed(begun):
            who = "the host" if direction == "amplifier" else "an amplifier"
            self._report.add("garbage", wire.name, time, f"{who} sent {damaged.why}")

    def _unanswered(self, session: AmplifierSession, time: float, request: Request) -> None:
        """What nobody answers: a broadcast, a heartbeat of a host on CAN, a transfer of objects."""
        if request.kind is RequestKind.PING and session.amplifier.state is not None:
            if session.is_disturbed(time):
                session.amplifier.watchdog.may_feed(time)
            else:
                session.amplifier.fed(time)
        elif request.kind is RequestKind.HELLO:
            self._host.request_granted(session, time, request)
        elif request.kind in (RequestKind.STOP, RequestKind.COMMIT):
            session.amplifier.broadcast_sent(request, time)
            self._host.request_granted(session, time, request)

    def _may_feed(self, session: AmplifierSession, time: float, request: Request) -> None:
        if request.kind in STATE_CHANGING or request.kind is RequestKind.PING:
            session.amplifier.watchdog.may_feed(time)

    def status_reported(self, wire: WatchedWire, time: float, message: Message) -> None:
        """A frame toward the host."""
        if isinstance(message, Request | Damaged):
            return
        session = wire.sessions.get(message.address)
        if session is None and message.address == 255:
            session = next(iter(wire.sessions.values()), None)
        if session is None:
            return
        if isinstance(message, BootUp):
            self._restarted(session, time)
        elif isinstance(message, StateEvent):
            if not any(request.kind in STATE_CHANGING for _, request in session.pending.values()):
                session.amplifier.told(message.state, message.fault, time)
        else:
            self._handle_reply(session, time, message)

    def _restarted(self, session: AmplifierSession, time: float) -> None:
        if session.amplifier.is_enabled and not session.is_disturbed(time):
            session.report("state", time, f"{session.name} has started anew while it was enabled")
        session.amplifier.restarted(time)
        session.vibrates = False

    def _handle_reply(self, session: AmplifierSession, time: float, reply: Reply) -> None:
        if reply.key == "objects":
            session.amplifier.watchdog.may_feed(time)
            return
        if reply.problem == REPLY_TO_DAMAGED_FRAME:
            session.report(
                "damage", time, f"{session.name} carries out and answers a damaged frame"
            )
            return
        at, request = session.pending.pop(reply.key, (math.inf, None))
        if request is None:
            was_abandoned = reply.key in session.abandoned
            session.abandoned.discard(reply.key)
            if not (was_abandoned or session.is_disturbed(time)):
                why = f": {reply.problem}" if reply.problem else ""
                what = f"{session.name} answers what nobody has asked it, or asks no more{why}"
                session.report("credit", time, what)
            return
        if reply.problem and not session.is_disturbed(time):
            session.report(
                "answer", time, f"an answer of {session.name} is not whole: {reply.problem}"
            )
        was_lost = reply.key in session.overdue or reply.key in session.superseded
        session.overdue.discard(reply.key)
        session.superseded.discard(reply.key)
        if reply.refusal:
            session.amplifier.watchdog.undo_feed()
        elif request.problem:
            rule = "commit" if request.problem.startswith("torn") else "garbage"
            session.report(
                rule, time, f"{session.name} took {request.kind.value}: {request.problem}"
            )
        if request.kind is RequestKind.HELLO:
            self._host.request_granted(session, time, request)
        if was_lost or request.problem:
            return
        if reply.refusal:
            if reply.status is not None:
                session.amplifier.status_reported(reply.status, at, time)
            return
        if request.kind in STATE_CHANGING:
            # It may have been carried out when it was asked first, and that answer was lost.
            same = {
                key: before
                for key, (before, one) in session.pending.items()
                if _is_repeated(one, request)
            }
            at = min([at, *same.values()])
            session.superseded.update(same)
        self._host.request_granted(session, time, request)
        if session.is_disturbed(time) and request.kind is RequestKind.ARM:
            session.amplifier.forget_state()
        session.amplifier.request_granted(request, reply, at, time)


def _is_repeated(request: Request, again: Request) -> bool:
    """Whether a request is another one once more, as a host repeats it."""
    return request.kind is again.kind and request.token == again.token
