"""Rules for what a host sends: allowed requests, silence after lifts, heartbeats and stops.

Checked as each frame passes; time limits are in `deadlines`.
"""

from collections.abc import Collection, Hashable, Mapping

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.config import TimeLimits
from sim.witness.deadlines import Deadlines, KnownInputs
from sim.witness.decoded import WATCHDOG_FEEDING, ChannelCommand, Request, RequestKind
from sim.witness.delays import Delays
from sim.witness.set_rules import ExpectedSets, check_envelope, check_set

_IN_FLIGHT = 0.001  # s; from the host's write until a frame is seen
_REORDER_WINDOW = 0.020  # s; of two commands given within it the earlier may still be sent first
_HEARTBEAT_STATUS = 0.002  # s; over CAN a heartbeat is followed by the order of its status
_UNORDERED = (RequestKind.READ, RequestKind.HELLO, RequestKind.CAPABILITIES)


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

    # frames

    def check_request(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Check a request to one amplifier; a broadcast is checked for each."""
        if request.problem:
            session.report(
                "commit" if request.is_incomplete_set else "garbage",
                time,
                f"host sent {request.kind.value}: {request.problem}",
            )
        if request.key is not None:
            self._check_credit(session, time, request)
        self._check_stop(session, time, request)
        if request.kind in WATCHDOG_FEEDING:
            self._check_stall(session, time, request)
        if request.kind is RequestKind.ARM:
            self._check_arm(session, time)
        if request.kind in (RequestKind.APPLY, RequestKind.STAGE):
            check_set(session, time, request, self._expected)
            if request.vibrates:
                self._check_justified(session, time)
        if request.kind is RequestKind.ENVELOPE and request.envelope is not None:
            check_envelope(session, time, max(request.envelope.levels, default=0.0))
        self._remember(session, time, request)

    def request_granted(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Note that a request was not refused."""
        match request.kind:
            case RequestKind.HELLO:
                session.is_identified = True
            case RequestKind.ARM:
                if session.is_stopped:
                    session.report(
                        "stop", time, f"{session.name} armed before its stop was cleared"
                    )
                session.last_set = session.active_set = None
                session.armed_at = time
                session.last_feed = time
            case RequestKind.CLEAR:
                session.is_stopped = False
            case RequestKind.APPLY | RequestKind.COMMIT:
                if self._vibrates(session, request):
                    session.last_vibration = time

    def advance(self, time: float) -> None:
        """Check the deadlines and heartbeats that are due by now."""
        self._deadlines.advance(time)
        inputs = self._inputs
        for session in self._sessions.values():
            self._check_heartbeat(session, time)
            if session.amplifier.last_fault > inputs.last_command and inputs.is_arm_requested:
                inputs.is_arm_requested = False  # a fault cancels earlier commands

    # rules

    def _check_credit(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Only a silencing request, to any amplifier of a wire, may precede a pending reply."""
        is_silent_set = request.kind is RequestKind.APPLY and not request.vibrates
        if is_silent_set or request.kind in (RequestKind.STOP, RequestKind.DISARM):
            for other in self._sessions.values():
                if other.config.wire == session.config.wire:
                    other.preempted_at = time
            return
        for at, awaited in session.pending.values():
            # A last lift preempts too, even if a finger has come since.
            preempted = max(session.preempted_at, self._inputs.last_lift)
            if awaited.kind is RequestKind.STATUS and _is_part_of_heartbeat(
                session, at, begun_before=preempted
            ):
                session.preempted_at = preempted = at
            is_awaited = at > preempted
            if is_awaited and time - at < self._times.reply - self._times.slack:
                session.report(
                    "credit",
                    time,
                    f"host sent {request.kind.value} to {session.name} {(time - at) * 1e3:.1f} ms "
                    f"after {awaited.kind.value}, whose reply is pending",
                )

    def _check_stop(self, session: AmplifierSession, time: float, request: Request) -> None:
        requested_at = session.stop_requested_at
        is_other = request.kind is not RequestKind.STOP and request.kind not in _UNORDERED
        # Requests written at the same moment as the stop may precede it.
        if requested_at is None or time <= requested_at + _IN_FLIGHT or not is_other:
            return
        if (
            request.kind is RequestKind.DISARM
            and requested_at < self._inputs.last_disarm + _REORDER_WINDOW
        ):
            return  # silences as well
        if request.kind is RequestKind.STATUS and _is_part_of_heartbeat(
            session, time, begun_before=requested_at
        ):
            return
        session.report(
            "stop",
            time,
            f"stop requested at {requested_at:.4f} s, but the next request to {session.name} is "
            f"{request.kind.value}",
        )
        session.stop_requested_at = None

    def _check_stall(self, session: AmplifierSession, time: float, request: Request) -> None:
        """A stalled control loop must not feed the watchdog."""
        since = self._inputs.stalled_since
        is_by_loop = request.vibrates or request.kind in (
            RequestKind.PING,
            RequestKind.COMMIT,
            RequestKind.STAGE,
        )
        if since is not None and time > since + self._times.slack and is_by_loop:
            session.report(
                "heartbeat",
                time,
                f"control loop stalled since {since:.4f} s, but {request.kind.value} feeds the "
                f"watchdog of {session.name}",
            )
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
        """Vibration needs an enabled, unstopped amplifier and a contact."""
        if session.is_stopped:
            session.report("stop", time, f"vibration commanded after a stop: {session.name}")
        elif self._is_known_disabled(session):
            session.report("enabled", time, f"vibration commanded while disabled: {session.name}")
        is_touched = self._inputs.contacts is None or self._inputs.contacts
        last_lift = self._inputs.last_lift
        if not is_touched and time > last_lift + self._times.lift + self._times.slack:
            session.report(
                "justified",
                time,
                f"vibration commanded on {session.name} without a contact since {last_lift:.4f} s",
            )

    def _is_known_disabled(self, session: AmplifierSession) -> bool:
        """Whether it is not enabled and the host can know.

        A fault event may cross a set on the wire, which the amplifier then refuses.
        """
        amplifier = session.amplifier
        is_enabled = amplifier.state is None or amplifier.is_enabled
        return not is_enabled and (amplifier.is_answered or not amplifier.is_in_fault)

    # state of the session

    def _remember(self, session: AmplifierSession, time: float, request: Request) -> None:
        match request.kind:
            case RequestKind.STAGE:
                session.staged = {request.token: request}
            case RequestKind.APPLY | RequestKind.COMMIT:
                is_commit = request.kind is RequestKind.COMMIT
                staged = session.staged.get(request.token) if is_commit else request
                session.active_set = staged or session.active_set
                is_new = request.token != session.last_token
                session.committed_tokens.append(request.token)
                commands = self._channel_commands(session, request)
                session.vibrates = self._vibrates(session, request)
                session.last_token = request.token
                session.levels = {
                    channel: command for channel, command in commands.items() if command.level
                }
                if is_new and session.vibrates:
                    self._deadlines.expect_all_amplifiers(session, time, request.token)
                if not session.vibrates:
                    session.last_silenced = time
                    self._check_release(session, time, request.ramp, commands)
            case RequestKind.STOP | RequestKind.DISARM | RequestKind.ARM:
                session.vibrates = False
                session.last_silenced = time
                session.levels = {}
                session.staged = {}
                if request.kind is RequestKind.STOP:
                    session.is_stopped, session.stop_requested_at = True, None
                    if self._inputs.is_arm_requested:
                        self._inputs.is_arm_requested, self._inputs.last_silencing = False, time
            case _:
                pass

    def _check_release(
        self,
        session: AmplifierSession,
        time: float,
        ramp: float,
        commands: Mapping[int, ChannelCommand],
    ) -> None:
        """The ramp to zero must end within the release time after the last lift."""
        last_lift = self._inputs.last_lift
        if self._inputs.contacts or not 0 <= time - last_lift <= self._times.lift:
            return
        has_endings = session.staged and any(not one.skip_ending for one in commands.values())
        if time + ramp > last_lift + self._times.release + self._times.slack and not has_endings:
            session.report(
                "lift",
                time,
                f"last finger lifted at {last_lift:.4f} s, {session.name} is silent only after a "
                f"ramp of {ramp:g} s",
            )

    def _channel_commands(
        self, session: AmplifierSession, request: Request
    ) -> Mapping[int, ChannelCommand]:
        if request.kind is RequestKind.COMMIT:
            staged = session.staged.get(request.token)
            return staged.commands if staged is not None else session.levels
        return request.commands

    def _vibrates(self, session: AmplifierSession, request: Request) -> bool:
        return any(one.vibrates for one in self._channel_commands(session, request).values())


def _is_part_of_heartbeat(session: AmplifierSession, time: float, *, begun_before: float) -> bool:
    """Whether a request for the status at a time [s] belongs to a heartbeat on the line before."""
    return session.last_ping <= begun_before and time <= session.last_ping + _HEARTBEAT_STATUS
