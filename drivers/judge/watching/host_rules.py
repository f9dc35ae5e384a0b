"""Rules for what a host sends: allowed requests, limits, heartbeats and stops.

Each frame is checked as it passes, and what must follow by its deadline.
"""

from collections.abc import Collection, Mapping, Sequence

from drivers.judge.watching.amplifier_session import AmplifierSession, Deadlines, check_set
from drivers.judge.watching.config import TimeLimits
from drivers.judge.watching.decoded import FEEDING, Request
from drivers.protocol.definition import LATCHED, REACTION
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_vibrating

IN_FLIGHT = 0.003  # s; from the host's write until a frame is seen, of Modbus RTU at its end
_IN_TRANSPORT = 0.010  # s; bytes may wait before they pass, while their host counts from its write
_OTHER_HOST = 2.0  # s; for which a host that hears another one sends nothing that plays or feeds
_ATTEMPTS = 3  # of a request that has no reply
_REPEATED = 0.1  # s; within which a stop that is not confirmed goes on, for each amplifier
CONFIRMED = 0.3  # s; then the host says that it is not
_READINGS = ("GetStatus", "GetSensors", "Measure", "GetReading", "GetMeasured")
SILENCING = ("Stop", "Disarm", "Silence")


class HostRules:
    """The rules for hosts by what passes on the wires, over all amplifiers by name."""

    def __init__(
        self, sessions: Mapping[str, AmplifierSession], *, times: TimeLimits, deadlines: Deadlines
    ) -> None:
        self._sessions = sessions
        self._deadlines = deadlines
        self._times = times

    def advance(self, time: float) -> None:
        """Check the deadlines and heartbeats that are due by now."""
        self._deadlines.advance(time)
        for session in self._sessions.values():
            self._check_heartbeat(session, time)

    # frames

    def is_preempting(self, session: AmplifierSession, time: float, request: Request) -> bool:
        """Whether a request may come before a reply that is pending on its wire.

        It silences, or reads whether a stop has, also one that a disarm's reading has confirmed.
        """
        if request.name == "Set" and request.has_reply:
            layers = session.amplifier.sets.whole(request.values["token"])
            return layers is not None and not is_vibrating(*layers)
        is_unconfirmed = session.is_disarming or session.first_stop is not None
        return request.name in SILENCING or (request.name == "GetStatus" and is_unconfirmed)

    def check_order(
        self,
        session: AmplifierSession,
        request: Request,
        pending: Collection[Request],
        preempted_by: int,
    ) -> None:
        """Check that no reply is pending that a request must wait for.

        preempted_by: number of the last request before which others may lose their replies. A
        reading is given up once its reply, which begins within 10 ms, is due no more.
        """
        for each in pending:
            waits = request.started_at - each.started_at
            is_preempted = each.number < preempted_by
            # The host counts from its write: the bytes may have waited in a transport since.
            is_given_up = waits >= self._times.reply - max(self._times.slack, _IN_TRANSPORT)
            if each.name in _READINGS:
                each.is_given_up |= request.started_at >= each.since + REACTION - IN_FLIGHT
                is_given_up = each.is_given_up
            if not (is_preempted or is_given_up):
                session.report_always(
                    "credit",
                    request.started_at,
                    f"host sent {request.name} to {session.name} {waits * 1e3:.1f} ms after "
                    f"{each.name}, whose reply is pending",
                )

    def check_request(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Check a request to one amplifier; a broadcast is checked for each."""
        layers: Sequence[LayerSet] | None = None
        match request.name:
            case "Set" if request.has_reply:
                layers = session.amplifier.sets.whole(request.values["token"])
            case "Commit" if session.staged is not None:
                token, staged = session.staged
                layers = staged if token == request.values["token"] else None
        if request.name in FEEDING:
            self._check_feeding(session, time, request)
        if request.name == "Arm":
            self._check_arm(session, time)
        if request.name == "Set" and layers is not None:
            check_set(session, time, request.values["token"], layers)
            if is_vibrating(*layers):
                self._check_vibrating(session, time, layers)
        self._remember(session, time, request, layers)

    def request_granted(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Note that a request was not refused."""
        match request.name:
            case "Hello":
                session.is_identified = True
            case "Arm":
                was_stopped, session.is_stopped = session.is_stopped, False
                if was_stopped:
                    what = f"{session.name} armed before its stop was cleared"
                    session.report("stop", time, what)
                session.armed_at = session.last_feed = time
            case "Clear":
                session.is_stopped = False

    def status_heard(self, session: AmplifierSession, values: Values) -> None:
        """Note a status: whether it confirms a stop, or the end of a disarm.

        One that has latched nothing since it was switched on shows that it has restarted after a
        stop that was confirmed, of which there is nothing left to clear. A host that has opened the
        wire since knows a stop by what it shows alone: it may not have heard it.
        """
        may_be_over = session.is_requested or values.get("latch") == 0
        if session.first_stop is None and "state" in values and may_be_over:
            session.is_stopped = session.is_stopped and values["state"] in LATCHED
        if "levels" in values and not any(values["levels"]):
            session.is_disarming = False
            if values["state"] in LATCHED:
                session.first_stop = None

    # rules

    def _check_feeding(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Nothing feeds after a stop, or beside another host's session."""
        name = request.name
        if name == "Arm" and session.is_disturbed(time):
            session.is_stopped = False  # the replies to it and to Clear may be lost
        if session.is_stopped and name not in ("Arm", "Silence"):
            session.report_always("stop", time, f"{name} sent after a stop: {session.name}")
        number, at = request.values["session"], session.heard_other_host
        if name in ("Set", "Commit") and session.session not in (None, number):
            session.report_always(
                "session",
                time,
                f"host sent {name} of session {number} to {session.name}, armed with "
                f"{session.session}",
            )
        if time < at + _OTHER_HOST:
            session.report_always(
                "session",
                time,
                f"host sent {name} to {session.name}, driven by another host at {at:.4f} s",
            )
        session.last_feed = time

    def _check_heartbeat(self, session: AmplifierSession, time: float) -> None:
        if session.is_disturbed(time):
            session.last_feed = None  # the host may have given the amplifier up
        last = session.last_feed
        if last is None or not (session.is_open and session.amplifier.is_enabled):
            return
        # The control loop waits for all attempts of a request to any of its amplifiers.
        is_waiting = any(each.overdue_at >= last for each in self._sessions.values())
        longer = self._deadlines.delay_since(last) + is_waiting * _ATTEMPTS * self._times.reply
        if time > last + self._times.heartbeat + self._times.slack + longer:
            session.last_feed = time
            session.report_always(
                "heartbeat", time, f"{session.name}: no heartbeat since {last:.4f} s"
            )

    def _check_arm(self, session: AmplifierSession, time: float) -> None:
        if session.is_identified is False:
            session.report_always(
                "identified", time, f"{session.name} armed without identification"
            )

    def _check_vibrating(
        self, session: AmplifierSession, time: float, layers: Sequence[LayerSet]
    ) -> None:
        """Vibration needs an enabled amplifier, as far as the host can know."""
        amplifier = session.amplifier
        is_disabled = amplifier.state is not None and not amplifier.is_enabled
        # An Event of a fault may cross a set on the wire, which the amplifier then refuses; a set
        # that waits in a queue may still go out with the reply that says so.
        is_known = amplifier.is_answered or not amplifier.is_in_fault
        is_late = time > amplifier.reported_at + IN_FLIGHT
        if is_disabled and is_known and is_late and not session.is_stopped:
            session.report("enabled", time, f"vibration commanded while disabled: {session.name}")

    # state of the session

    def _remember(
        self,
        session: AmplifierSession,
        time: float,
        request: Request,
        layers: Sequence[LayerSet] | None,
    ) -> None:
        name, values = request.name, request.values
        if name in ("Stop", "GetStatus"):
            session.last_stop = time
        if name in SILENCING:
            session.silence_sent(time)
        match name:
            case "Disarm":
                session.is_disarming = True
            case "Stop":
                is_confirmed = session.is_stopped and session.first_stop is None
                session.is_stopped, session.session, session.is_requested = True, None, False
                if not (is_confirmed and session.amplifier.state in LATCHED):  # else by one before
                    session.first_stop = time if session.first_stop is None else session.first_stop
                    self._expect_confirmation(session, time, session.first_stop)
            case "Arm":
                session.session, session.last_set = values["session"], None
                session.silence_sent(time)
            case "Commit" | "Set" if layers is not None and (name == "Commit" or values["now"]):
                self._note_playing(session, time, values["token"], layers)

    def _note_playing(
        self, session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
    ) -> None:
        is_new = token not in session.committed_tokens
        session.committed_tokens.append(token)
        session.played.commit(layers, token, time)
        if is_new:
            self._expect_commits(session, time, token)
        if not session.vibrates(time):
            session.last_silenced = time

    # deadlines

    def _expect_confirmation(self, session: AmplifierSession, time: float, first: float) -> None:
        """A stop must be confirmed, or go on: it is repeated, or the status is read."""
        wires = [each.config.wire for each in self._sessions.values()]

        def goes_on() -> bool:
            is_over = session.first_stop != first or not session.is_open
            return is_over or session.last_stop > time

        if time <= first + CONFIRMED - _REPEATED:
            self._deadlines.expect(
                time,
                _REPEATED * wires.count(session.config.wire),
                ("stop", session, goes_on),
                f"stop sent to {session.name} at {time:.4f} s, neither confirmed nor repeated",
            )

    def _is_over(self, first: AmplifierSession, time: float) -> bool:
        """Whether no other has to follow a commit of a time [s] any more."""
        is_ended = not first.vibrates(time) or not first.is_open  # by its watchdog
        return is_ended or first.last_silenced >= time  # since then it may play another set

    def _expect_commits(self, first: AmplifierSession, time: float, token: int) -> None:
        """A set that one amplifier plays must be played by all that it was sent to, or silenced."""
        for session in self._sessions.values():
            is_part = session.staged is not None and session.staged[0] == token
            if session is first or not is_part or not session.amplifier.is_enabled:
                continue

            def is_joined(session: AmplifierSession = session) -> bool:
                return token in session.committed_tokens or self._is_over(first, time)

            self._deadlines.expect(
                time,
                self._times.together,
                ("commit", session, is_joined),
                f"set {token} was committed on {first.name} at {time:.4f} s, {session.name} not",
            )
