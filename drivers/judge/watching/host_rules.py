"""Rules for what a host sends: allowed requests, silence after lifts, heartbeats and stops.

Each frame is checked as it passes, and what must follow by its deadline.
"""

import math
from collections.abc import Collection, Hashable, Mapping, Sequence

from drivers.judge.watching.amplifier_session import (
    AmplifierSession,
    Deadlines,
    Delays,
    ExpectedSets,
    check_expected,
    check_set,
)
from drivers.judge.watching.config import TimeLimits
from drivers.judge.watching.decoded import A_READ, FEEDING, HELLO, Request, Sent
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_vibrating
from drivers.protocol.table import LATCHED, QUANTITIES

_IN_FLIGHT = 0.003  # s; from the host's write until a frame is seen, of Modbus RTU at its end
_IN_TRANSPORT = 0.010  # s; bytes may wait before they pass, while their host counts from its write
_REORDER_WINDOW = 0.020  # s; of two commands given within it the earlier may still be sent first
_OTHER_HOST = 2.0  # s; for which a host that hears another one sends nothing that plays or feeds
_ATTEMPTS = 3  # of a request that has no reply
_REPEATED = 0.1  # s; within which a stop that is not confirmed goes on, for each amplifier
_CONFIRMED = 0.3  # s; then the host says that it is not
_UNORDERED = (A_READ, HELLO, "GetCaps")
_READINGS = ("GetSensors", "Measure", "GetReading", "GetMeasured")
_SILENCING = ("Stop", "Disarm", "Silence")
_RAMP = QUANTITIES["ramp"]


class HostRules:
    """The rules for hosts, over all amplifiers by name; expected: what every pattern must be.

    Inputs beside the wires: contacts, operator commands, stalls; None for those not given.
    """

    def __init__(
        self, sessions: Mapping[str, AmplifierSession], *, times: TimeLimits, delays: Delays
    ) -> None:
        self.expected: ExpectedSets | None = None
        self._sessions = sessions
        self._delays = delays
        self._times = times
        self._deadlines = Deadlines(delays, times.touch)
        self._contacts: frozenset[Hashable] | None = None
        self._stalled_since: float | None = None
        self._is_arm_requested: bool | None = None
        self._last_lift = self._last_touch = -math.inf
        self._last_command = self._last_disarm = self._last_silencing = -math.inf

    # inputs beside the wires

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
        can_play = self._stalled_since is None and all(
            session.is_open and session.amplifier.is_enabled and not session.is_stopped
            for session in self._sessions.values()
        )
        for contact in new if is_answerable and can_play else ():
            self._expect_pattern(contact, time)

    def operator_command(self, time: float, command: str) -> None:
        """Note an operator's arm, disarm, stop or clear."""
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
        """Note that the control loop stalls since a time [s]; None: it runs again."""
        self._stalled_since = since
        for session in self._sessions.values() if since is None else ():
            session.last_feed = None  # the next heartbeat is due after the loop has run

    def advance(self, time: float) -> None:
        """Check the deadlines and heartbeats that are due by now."""
        self._deadlines.advance(time)
        for session in self._sessions.values():
            self._check_heartbeat(session, time)
            if session.amplifier.last_fault > self._last_command and self._is_arm_requested:
                self._is_arm_requested = False  # a fault cancels earlier commands

    # frames

    def is_preempting(self, session: AmplifierSession, time: float, request: Request) -> bool:
        """Whether a request may come before a reply that is pending on its wire.

        It silences, or reads whether a stop has, also one that a disarm's reading has confirmed.
        """
        if request.name == "Set":
            layers = session.amplifier.sets.whole(request.values["token"])
            return layers is not None and not is_vibrating(*layers)
        is_unconfirmed = session.is_disarming or session.first_stop is not None
        is_silencing = is_unconfirmed or time < self._last_silencing + _CONFIRMED
        return request.name in _SILENCING or (request.name == "GetStatus" and is_silencing)

    def check_order(
        self, session: AmplifierSession, sent: Sent, pending: Collection[Sent], preempted_by: int
    ) -> None:
        """Check that no reply is pending that a request must wait for.

        preempted_by: number of the last request before which others may lose their replies. A
        reading gives way, and the status of an amplifier that has left a request without a reply.
        """
        mute = {each.request.address for each in pending if each.is_overdue}
        for each in pending:
            name = each.request.name
            is_reading = name in _READINGS or (name == "GetStatus" and each.request.address in mute)
            waits = sent.begun - each.begun
            # A last lift preempts too, even if a finger has come since.
            is_preempted = each.number < preempted_by or each.begun <= self._last_lift
            # The host counts from its write: the bytes may have waited in a transport since.
            is_given_up = waits >= self._times.reply - max(self._times.slack, _IN_TRANSPORT)
            if not (is_preempted or is_given_up or is_reading):
                session.report_always(
                    "credit",
                    sent.begun,
                    f"host sent {sent.request.name} to {session.name} {waits * 1e3:.1f} ms after "
                    f"{name}, whose reply is pending",
                )

    def check_request(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Check a request to one amplifier; a broadcast is checked for each."""
        layers: Sequence[LayerSet] | None = None
        if request.name == "Set":
            layers = session.amplifier.sets.whole(request.values["token"])
        elif request.name == "Commit" and session.staged is not None:
            token, staged = session.staged
            layers = staged if token == request.values["token"] else None
        self._check_stop(session, time, request)
        if request.name in FEEDING:
            self._check_feeding(session, time, request)
        if request.name == "Arm":
            self._check_arm(session, time)
        if request.name == "Set" and layers is not None:
            check_set(session, time, request.values["token"], layers)
            if is_vibrating(*layers):
                self._check_justified(session, time)
                if self.expected is not None:
                    check_expected(session, time, layers, self.expected)
        self._remember(session, time, request, layers)

    def request_granted(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Note that a request was not refused."""
        if request.name == HELLO:
            session.is_identified = True
        elif request.name == "Arm":
            was_stopped, session.is_stopped = session.is_stopped, False
            if was_stopped:
                session.report("stop", time, f"{session.name} armed before its stop was cleared")
            session.armed_at = session.last_feed = time
        elif request.name == "Clear":
            session.is_stopped = False

    def status_heard(self, session: AmplifierSession, values: Values) -> None:
        """Note a status: whether it confirms a stop, or the end of a disarm.

        One that has latched nothing since it was switched on shows that it has restarted after a
        stop that was confirmed, of which there is nothing left to clear. A host that has opened the
        wire since knows a stop by what it shows alone: it may not have heard it.
        """
        may_be_over = session.is_asked or values.get("latch") == 0
        if session.first_stop is None and "state" in values and may_be_over:
            session.is_stopped = session.is_stopped and values["state"] in LATCHED
        if "levels" in values and not any(values["levels"]):
            session.is_disarming = False
            if values["state"] in LATCHED:
                session.first_stop = None

    # rules

    def _check_stop(self, session: AmplifierSession, time: float, request: Request) -> None:
        requested_at = session.stop_requested_at
        is_other = request.name != "Stop" and request.name not in _UNORDERED
        if requested_at is None or not is_other:
            return
        # Requests written at the same moment as the stop may precede it, and with a broadcast the
        # status that is read behind it.
        if time <= requested_at + _IN_FLIGHT * (2 if request.name == "GetStatus" else 1):
            return
        if request.name == "Disarm" and requested_at < self._last_disarm + _REORDER_WINDOW:
            return  # silences as well
        session.report_always(
            "stop",
            time,
            f"stop requested at {requested_at:.4f} s, but the next request to {session.name} is "
            f"{request.name}",
        )
        session.stop_requested_at = None

    def _check_feeding(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Nothing feeds while the loop stalls, after a stop, beside another host's session."""
        name, since = request.name, self._stalled_since
        if since is not None and time > since + self._times.slack and name != "Silence":
            session.report(
                "heartbeat",
                time,
                f"control loop stalled since {since:.4f} s, but {name} feeds the watchdog of "
                f"{session.name}",
            )
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
        is_ending = self._last_silencing >= session.armed_at
        is_running = self._stalled_since is None and not is_ending
        if last is None or not (session.is_open and session.amplifier.is_enabled and is_running):
            return
        # The control loop waits for all attempts of a request to any of its amplifiers.
        is_waiting = any(each.overdue_at >= last for each in self._sessions.values())
        longer = self._delays.since(last) + (_ATTEMPTS * self._times.reply if is_waiting else 0.0)
        if time > last + self._times.heartbeat + self._times.slack + longer:
            session.last_feed = time
            session.report_always(
                "heartbeat", time, f"{session.name}: no heartbeat since {last:.4f} s"
            )

    def _check_arm(self, session: AmplifierSession, time: float) -> None:
        # An Arm on its way may still be sent, followed by what withdraws it.
        is_withdrawn = time > self._last_silencing + self._times.stop
        if self._is_arm_requested is False and is_withdrawn:
            session.report_always(
                "armed", time, f"{session.name} armed without an operator's request"
            )
        if session.is_identified is False:
            session.report_always(
                "identified", time, f"{session.name} armed without identification"
            )

    def _check_justified(self, session: AmplifierSession, time: float) -> None:
        """Vibration needs an enabled amplifier, as far as the host can know, and a contact."""
        amplifier = session.amplifier
        is_disabled = amplifier.state is not None and not amplifier.is_enabled
        # An Event of a fault may cross a set on the wire, which the amplifier then refuses; a set
        # that waits in a queue may still go out with the reply that says so.
        is_known = amplifier.is_answered or not amplifier.is_in_fault
        is_late = time > amplifier.reported_at + _IN_FLIGHT
        if is_disabled and is_known and is_late and not session.is_stopped:
            session.report("enabled", time, f"vibration commanded while disabled: {session.name}")
        is_touched = self._contacts is None or self._contacts
        if not is_touched and time > self._last_lift + self._times.lift + self._times.slack:
            session.report_always(
                "justified",
                time,
                f"vibration commanded on {session.name} without a contact since "
                f"{self._last_lift:.4f} s",
            )

    def _check_release(self, session: AmplifierSession, time: float, ramp: int) -> None:
        """The ramp to zero must end within the release time after the last lift."""
        last_lift, lasts = self._last_lift, _RAMP.from_wire(ramp)
        if self._contacts or not 0 <= time - last_lift <= self._times.lift:
            return
        if time + lasts > last_lift + self._times.release + self._times.slack:
            session.report_always(
                "lift",
                time,
                f"last finger lifted at {last_lift:.4f} s, {session.name} is silent only after a "
                f"ramp of {lasts:g} s",
            )

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
        if name in _SILENCING:
            if session.vibrates(time) and not session.is_stopped:
                self._check_release(session, time, values["ramp"])
            session.silence_sent(time)
        if name == "Disarm":
            session.is_disarming = True
        elif name == "Stop":
            is_confirmed = session.is_stopped and session.first_stop is None
            session.is_stopped, session.stop_requested_at, session.session = True, None, None
            session.is_asked = False
            if not (is_confirmed and session.amplifier.state in LATCHED):  # else by one before
                session.first_stop = time if session.first_stop is None else session.first_stop
                self._expect_confirmation(session, time, session.first_stop)
            if self._is_arm_requested:
                self._is_arm_requested, self._last_silencing = False, time
        elif name == "Arm":
            session.session, session.last_set = values["session"], None
            session.silence_sent(time)
        elif layers is not None and (name == "Commit" or values["now"]):
            self._note_playing(session, time, values["token"], layers)

    def _note_playing(
        self, session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
    ) -> None:
        played = session.played
        endings = [each.ending for voices in played.all_voices for each in voices]
        is_new = token not in session.committed_tokens
        session.committed_tokens.append(token)
        played.commit(layers, token, time)
        if is_vibrating(*layers):
            session.last_vibration = time
        if is_new:
            self._expect_commits(session, time, token)
        if not session.vibrates(time):
            session.last_silenced = time
            if not any(endings):
                self._check_release(session, time, max((one.ramp for one in layers), default=0))

    # deadlines

    def _expect_silence(self, session: AmplifierSession, last_lift: float) -> None:
        """After the last lift every amplifier must be silenced."""
        limit = self._times.lift

        def is_silenced() -> bool:
            is_silent = not session.vibrates(last_lift + limit) or session.amplifier.is_in_fault
            is_given_up = session.last_feed is None  # since a disturbance
            is_excused = self._last_touch >= last_lift or self._stalled_since is not None
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
            is_excused = self._last_silencing >= since or self._stalled_since is not None
            return (
                is_lifted
                or is_excused
                or any(each.last_vibration >= since for each in sessions)
                or any(each.amplifier.is_in_fault or not each.is_open for each in sessions)
            )

        self._deadlines.expect(
            since,
            self._times.touch,
            ("touch", next(iter(sessions)), has_pattern),
            f"touch at {since:.4f} s, no amplifier plays a pattern",
        )

    def _expect_stop(self, session: AmplifierSession, time: float) -> None:
        """A stop command must be sent to this amplifier, unless the reply to one is awaited."""
        is_under_way = session.is_stopped and session.first_stop is not None
        if is_under_way and time < session.last_stop + self._times.reply:
            return  # which must go on until it is confirmed
        session.stop_requested_at = time

        def is_sent() -> bool:
            return session.stop_requested_at != time or not session.is_open

        self._deadlines.expect(
            time,
            self._times.stop,
            ("stop", session, is_sent),
            f"stop requested at {time:.4f} s, not sent to {session.name}",
        )

    def _expect_confirmation(self, session: AmplifierSession, time: float, first: float) -> None:
        """A stop must be confirmed, or go on: it is repeated, or the status is read."""
        wires = [each.config.wire for each in self._sessions.values()]

        def goes_on() -> bool:
            is_over = session.first_stop != first or not session.is_open
            return is_over or session.last_stop > time

        if time <= first + _CONFIRMED - _REPEATED:
            self._deadlines.expect(
                time,
                _REPEATED * wires.count(session.config.wire),
                ("stop", session, goes_on),
                f"stop sent to {session.name} at {time:.4f} s, neither confirmed nor repeated",
            )

    def _expect_commits(self, first: AmplifierSession, time: float, token: int) -> None:
        """A set that one amplifier plays must be played by all that it was sent to, or silenced."""
        for session in self._sessions.values():
            is_part = session.staged is not None and session.staged[0] == token
            if session is first or not is_part or not session.amplifier.is_enabled:
                continue

            def is_joined(session: AmplifierSession = session) -> bool:
                is_silenced = first.last_silenced >= time  # since then it may play another set
                is_ended = not first.vibrates(time) or not first.is_open  # by its watchdog
                is_excused = is_silenced or is_ended or self._stalled_since is not None
                return token in session.committed_tokens or is_excused

            self._deadlines.expect(
                time,
                self._times.together,
                ("commit", session, is_joined),
                f"set {token} was committed on {first.name} at {time:.4f} s, {session.name} not",
            )
