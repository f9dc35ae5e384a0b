"""Rules for what a host sends: allowed requests, silence after lifts, heartbeats and stops.

Checked as each frame passes; time limits are in `deadlines`.
"""

from collections.abc import Collection, Hashable, Mapping, Sequence

from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import LATCHED, QUANTITIES
from sim.witness.amplifier_session import AmplifierSession, is_vibrating
from sim.witness.config import TimeLimits
from sim.witness.deadlines import Deadlines, KnownInputs
from sim.witness.decoded import A_READ, BROADCAST, FEEDING, HELLO, Request
from sim.witness.delays import Delays
from sim.witness.set_rules import ExpectedSets, check_expected, check_set
from sim.witness.unanswered import Sent
from sim.witness.watched_wire import WatchedWire

_IN_FLIGHT = 0.001  # s; from the host's write until a frame is seen
_IN_TRANSPORT = 0.010  # s; bytes may wait before they pass, while their host counts from its write
_REORDER_WINDOW = 0.020  # s; of two commands given within it the earlier may still be sent first
_OTHER_HOST = 2.0  # s; for which a host that hears another one sends nothing that plays or feeds
_UNORDERED = (A_READ, HELLO, "GetCaps")
_READINGS = ("GetSensors", "Measure", "GetReading", "GetMeasured")
_SILENCING = ("Stop", "Disarm", "Silence")
_RAMP = QUANTITIES["ramp"]


class HostRules:
    """The rules for hosts, over all amplifiers by name."""

    def __init__(
        self, sessions: Mapping[str, AmplifierSession], *, times: TimeLimits, delays: Delays
    ) -> None:
        self._sessions = sessions
        self._delays = delays
        self._times = times
        self._inputs = KnownInputs()
        self._deadlines = Deadlines(sessions, self._inputs, times=times, delays=delays)
        self._expected: ExpectedSets | None = None

    # inputs beside the wires

    def contacts(self, time: float, contacts: Collection[Hashable], *, is_answerable: bool) -> None:
        """Replace the contacts on the plate; is_answerable: new ones must lead to a pattern."""
        was_touched = bool(self._inputs.contacts)
        new = self._inputs.set_contacts(time, contacts)
        if was_touched and not self._inputs.contacts:
            self._deadlines.expect_silence(time)
        if is_answerable:
            for contact in new:
                self._deadlines.expect_pattern(contact, time)

    def expect(self, expected: ExpectedSets | None) -> None:
        """Set what every pattern must be; None for any."""
        self._expected = expected

    def operator_command(self, time: float, command: str) -> None:
        """Note an operator's arm, disarm, stop or clear."""
        self._inputs.operator_command(time, command)
        if command == "stop":
            for session in self._sessions.values():
                if session.is_open and not session.is_disturbed(time):
                    self._deadlines.expect_stop(session, time)

    def set_stalled(self, since: float | None) -> None:
        """Note that the control loop stalls since a time [s]; None: it runs again."""
        self._inputs.stalled_since = since
        if since is None:
            for session in self._sessions.values():
                session.last_feed = None  # the next heartbeat is due after the loop has run

    def advance(self, time: float) -> None:
        """Check the deadlines and heartbeats that are due by now."""
        self._deadlines.advance(time)
        inputs = self._inputs
        for session in self._sessions.values():
            self._check_heartbeat(session, time)
            if session.amplifier.last_fault > inputs.last_command and inputs.is_arm_requested:
                inputs.is_arm_requested = False  # a fault cancels earlier commands

    # frames

    def check_request(
        self, wire: WatchedWire, session: AmplifierSession, time: float, sent: Sent
    ) -> None:
        """Check a request to one amplifier; a broadcast is checked for each."""
        request = sent.request
        if request.problem:
            what = f"host sent {request.name}: {request.problem}"
            session.report("garbage", time, what)
            return
        layers: Sequence[LayerSet] | None = None
        if request.name == "Set":
            layers, problem = session.amplifier.sets.sent(request.values, time)
            if problem:
                session.report("garbage", time, f"host sent a set: {problem}")
        elif request.name == "Commit" and session.staged is not None:
            token, staged = session.staged
            layers = staged if token == request.values["token"] else None
        is_silent = request.name == "Set" and layers is not None and not is_vibrating(layers)
        self._check_credit(wire, session, sent, is_silent=is_silent)
        self._check_stop(session, time, request)
        if request.name in FEEDING:
            self._check_feeding(session, time, request)
        if request.name == "Arm":
            self._check_arm(session, time)
        if request.name == "Set" and layers is not None:
            check_set(session, time, request.values["token"], layers)
            if is_vibrating(layers):
                self._check_justified(session, time)
                if self._expected is not None:
                    check_expected(session, time, layers, self._expected)
        self._remember(session, time, request, layers)

    def request_granted(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Note that a request was not refused."""
        if request.name == HELLO:
            session.is_identified = True
        elif request.name == "Arm":
            was_stopped, session.is_stopped = session.is_stopped, False
            if was_stopped and not session.is_disturbed(time):
                what = f"{session.name} armed before its stop was cleared"
                session.report("stop", time, what)
            session.armed_at = session.last_feed = time
        elif request.name == "Clear":
            session.is_stopped = False

    def status_heard(self, session: AmplifierSession, time: float, values: Values) -> None:
        """Note a status: whether it confirms a stop."""
        if "levels" in values and values["state"] in LATCHED and not any(values["levels"]):
            session.first_stop = None

    # rules

    def _check_credit(
        self, wire: WatchedWire, session: AmplifierSession, sent: Sent, *, is_silent: bool
    ) -> None:
        """Only a silencing request may precede a reply that is pending on its wire."""
        request = sent.request
        if request.name in _SILENCING or is_silent:
            wire.preempted_by = sent.number
            return
        if wire.is_disturbed(sent.begun):
            return
        is_to_each = wire.kind == "modbus-tcp" and len(wire.sessions) > 1
        for pending in wire.pending.values():
            awaited, at = pending.sent.request, pending.sent.begun
            is_broadcast = is_to_each and awaited.name in BROADCAST
            # A last lift preempts too, even if a finger has come since.
            is_preempted = pending.sent.number < wire.preempted_by or at <= self._inputs.last_lift
            if is_preempted or awaited.name in _READINGS or is_broadcast:
                continue
            # The host counts from its write: the bytes may have waited in a transport since.
            if sent.begun - at < self._times.reply - max(self._times.slack, _IN_TRANSPORT):
                session.report(
                    "credit",
                    sent.begun,
                    f"host sent {request.name} to {session.name} {(sent.begun - at) * 1e3:.1f} ms "
                    f"after {awaited.name} to {pending.session.name}, whose reply is pending",
                )

    def _check_stop(self, session: AmplifierSession, time: float, request: Request) -> None:
        requested_at = session.stop_requested_at
        is_other = request.name != "Stop" and request.name not in _UNORDERED
        # Requests written at the same moment as the stop may precede it.
        if requested_at is None or time <= requested_at + _IN_FLIGHT or not is_other:
            return
        if request.name == "Disarm" and requested_at < self._inputs.last_disarm + _REORDER_WINDOW:
            return  # silences as well
        what = f"stop requested at {requested_at:.4f} s, but the next request to {session.name} is "
        session.report("stop", time, f"{what}{request.name}")
        session.stop_requested_at = None

    def _check_feeding(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Nothing feeds while the loop stalls, after a stop, beside another host's session."""
        name, since = request.name, self._inputs.stalled_since
        is_late = since is not None and time > since + self._times.slack
        if is_late and name != "Silence" and not session.is_disturbed(time):
            what = f"control loop stalled since {since:.4f} s, but {name} feeds the watchdog of "
            session.report("heartbeat", time, f"{what}{session.name}")
        if name == "Arm" and session.is_disturbed(time):
            session.is_stopped = False  # the replies to it and to Clear may be lost
        if session.is_stopped and name not in ("Arm", "Silence"):
            session.report("stop", time, f"{name} sent after a stop: {session.name}")
        number = request.values["session"]
        if name in ("Set", "Commit") and session.session not in (None, number):
            what = f"host sent {name} of session {number} to {session.name}, armed with "
            session.report("session", time, f"{what}{session.session}")
        if time < session.heard_other_host + _OTHER_HOST:
            what = f"host sent {name} to {session.name}, driven by another host at "
            session.report("session", time, f"{what}{session.heard_other_host:.4f} s")
        session.last_feed = time

    def _check_heartbeat(self, session: AmplifierSession, time: float) -> None:
        if session.is_disturbed(time):
            session.last_feed = None  # the host may have given the amplifier up
        last = session.last_feed
        is_ending = self._inputs.last_silencing >= session.armed_at
        is_running = self._inputs.stalled_since is None and not is_ending
        if last is None or not (session.is_open and session.amplifier.is_enabled and is_running):
            return
        if time > last + self._times.heartbeat + self._times.slack + self._delays.since(last):
            session.last_feed = time
            session.report("heartbeat", time, f"{session.name}: no heartbeat since {last:.4f} s")

    def _check_arm(self, session: AmplifierSession, time: float) -> None:
        # An Arm on its way may still be sent, followed by what withdraws it.
        is_withdrawn = time > self._inputs.last_silencing + self._times.stop
        if self._inputs.is_arm_requested is False and is_withdrawn:
            session.report("armed", time, f"{session.name} armed without an operator's request")
        if session.is_identified is False:
            session.report("identified", time, f"{session.name} armed without identification")

    def _check_justified(self, session: AmplifierSession, time: float) -> None:
        """Vibration needs an enabled amplifier and a contact."""
        # A set that waits in a queue may still go out with the reply that says so.
        is_known = time > session.amplifier.reported_at + _IN_FLIGHT and not session.is_disturbed(
            time
        )
        if is_known and not session.is_stopped and self._is_known_disabled(session):
            session.report("enabled", time, f"vibration commanded while disabled: {session.name}")
        is_touched = self._inputs.contacts is None or self._inputs.contacts
        last_lift = self._inputs.last_lift
        if not is_touched and time > last_lift + self._times.lift + self._times.slack:
            what = f"vibration commanded on {session.name} without a contact since "
            session.report("justified", time, f"{what}{last_lift:.4f} s")

    def _is_known_disabled(self, session: AmplifierSession) -> bool:
        """Whether it is not enabled and the host can know.

        An Event of a fault may cross a set on the wire, which the amplifier then refuses.
        """
        amplifier = session.amplifier
        is_enabled = amplifier.state is None or amplifier.is_enabled
        return not is_enabled and (amplifier.is_answered or not amplifier.is_in_fault)

    # state of the session

    def _remember(
        self,
        session: AmplifierSession,
        time: float,
        request: Request,
        layers: Sequence[LayerSet] | None,
    ) -> None:
        values = request.values
        if request.name in ("Stop", "GetStatus"):
            session.last_stop = time
        if request.name in _SILENCING:
            if not session.is_stopped:
                self._check_release(session, time, _RAMP.from_wire(values["ramp"]))
            session.silence_sent(time)
        if request.name == "Stop":
            session.is_stopped, session.stop_requested_at = True, None
            session.session = None
            if session.first_stop is None:
                session.first_stop = time
            self._deadlines.expect_confirmation(session, time)
            if self._inputs.is_arm_requested:
                self._inputs.is_arm_requested, self._inputs.last_silencing = False, time
        elif request.name == "Arm":
            session.session = values["session"]
            session.silence_sent(time)
            session.last_set = None
        elif layers is not None and (request.name == "Commit" or values["now"]):
            self._note_playing(session, time, values["token"], layers)

    def _note_playing(
        self, session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
    ) -> None:
        is_new = token not in session.committed_tokens
        had_endings = any(
            command.ending is not None
            for one, _ in session.layers.values()
            for command in one.commands
        )
        session.set_sent(token, layers, time)
        if is_vibrating(layers):
            session.last_vibration = time
        if is_new:
            self._deadlines.expect_commits(session, time, token)
        if not session.vibrates(time):
            session.last_silenced = time
            if not had_endings:
                ramp = max((one.ramp for one in layers), default=0)
                self._check_release(session, time, _RAMP.from_wire(ramp))

    def _check_release(self, session: AmplifierSession, time: float, ramp: float) -> None:
        """The ramp to zero must end within the release time after the last lift."""
        last_lift = self._inputs.last_lift
        if self._inputs.contacts or not 0 <= time - last_lift <= self._times.lift:
            return
        if time + ramp > last_lift + self._times.release + self._times.slack:
            what = f"last finger lifted at {last_lift:.4f} s, {session.name} is silent only after "
            session.report("lift", time, f"{what}a ramp of {ramp:g} s")
