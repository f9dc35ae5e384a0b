"""What a host may send: to each amplifier, for those who touch, and for whoever arms and stops it.

These rules are checked as a frame passes; what it owes within a time is in `duties`.
"""

from collections.abc import Collection, Hashable, Mapping

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.config import TimeLimits
from sim.witness.deadlines import Deadlines
from sim.witness.decoded import WATCHDOG_FEEDING, ChannelCommand, Request, RequestKind
from sim.witness.known_inputs import KnownInputs
from sim.witness.set_rules import ExpectedSets, check_set, check_shape

_SETS = (RequestKind.APPLY, RequestKind.STAGE)
_BEGUN = 0.020  # s; for so long what was wished first may go before what was wished next
_UNCOUNTED = (RequestKind.READ, RequestKind.HELLO, RequestKind.CAPABILITIES)


class HostRules:
    """The rules about hosts, over all amplifiers of a plan."""

    def __init__(self, sessions: Mapping[str, AmplifierSession], *, times: TimeLimits) -> None:
        self._sessions = sessions
        self._times = times
        self._inputs = KnownInputs()
        self._deadlines = Deadlines(sessions, self._inputs, times=times)
        self._expected: ExpectedSets | None = None

    # what the witness is told beside the wires

    def contacts(self, time: float, contacts: Collection[Hashable], *, is_answerable: bool) -> None:
        """These fingers are on the plate from now on."""
        was_touched = bool(self._inputs.contacts)
        come = self._inputs.touch(time, contacts)
        if was_touched and not self._inputs.contacts:
            self._deadlines.silence(time)
        if is_answerable:
            for contact in come:
                self._deadlines.pattern(contact, time)

    def expect(self, expected: ExpectedSets | None) -> None:
        """What every pattern must be from now on; None: any."""
        self._expected = expected

    def operator_command(self, time: float, what: str) -> None:
        """Somebody wants it to arm, disarm, stop or clear."""
        self._inputs.operator_command(time, what)
        if what == "stop":
            for session in self._sessions.values():
                if session.is_open and not session.is_disturbed(time):
                    self._deadlines.stop(session, time)

    def set_stalled(self, time: float | None) -> None:
        """The control loop hangs from a time [s] on; None: it runs again."""
        self._inputs.stalled_since = time
        if time is None:
            for session in self._sessions.values():
                session.last_feed = None  # it owes the next after it has run

    # what it sends

    def check_request(self, session: AmplifierSession, time: float, request: Request) -> None:
        """A request to one amplifier; a broadcast is one to each."""
        if request.problem:
            rule = "commit" if request.problem.startswith("torn") else "garbage"
            session.report(rule, time, f"the host sent {request.kind.value}: {request.problem}")
        if request.key is not None:
            self._check_credit(session, time, request)
        self._check_stop(session, time, request)
        if request.kind in WATCHDOG_FEEDING:
            self._check_feed(session, time, request)
        if request.kind is RequestKind.ARM:
            self._check_arm(session, time)
        if request.kind in _SETS:
            self._check_set(session, time, request)
        if request.kind is RequestKind.ENVELOPE and request.envelope is not None:
            check_shape(session, time, max(request.envelope.levels, default=0.0))
        self._remember(session, time, request)

    def request_granted(self, session: AmplifierSession, time: float, request: Request) -> None:
        """A request of it was not refused."""
        match request.kind:
            case RequestKind.HELLO:
                session.is_identified = True
            case RequestKind.ARM:
                if session.is_stopped:
                    what = f"{session.name} is armed although its stop is not cleared"
                    session.report("stop", time, what)
                session.tokens.clear()
                session.armed_at = time
                session.last_feed = time
            case RequestKind.CLEAR:
                session.is_stopped = False
            case RequestKind.APPLY | RequestKind.COMMIT:
                if self._vibrates(session, request):
                    session.last_vibration = time

    def advance(self, time: float) -> None:
        """Look at what was to be done by now."""
        self._deadlines.advance(time)
        for session in self._sessions.values():
            self._check_pulse(session, time)
            if (
                session.amplifier.last_fault > self._inputs.last_command
                and self._inputs.is_arm_requested
            ):
                self._inputs.is_arm_requested = False  # a fault ends what was wished before it

    # rules

    def _check_credit(self, session: AmplifierSession, time: float, request: Request) -> None:
        """Nothing is asked while something else may still be answered, but for silence."""
        if self._is_silencing(request):
            session.preempted_at = time  # what it overtakes is waited for no more
            return
        for at, other in session.pending.values():
            # After a last lift it is waited for no more, though a finger may have come since.
            if (
                at > max(session.preempted_at, self._inputs.last_lift)
                and time - at < self._times.reply - self._times.slack
            ):
                session.report(
                    "credit",
                    time,
                    f"the host asked {session.name} {request.kind.value} {(time - at) * 1e3:.1f} ms "
                    f"after {other.kind.value}, which nobody has answered: it took something else "
                    "for the answer",
                )

    def _check_stop(self, session: AmplifierSession, time: float, request: Request) -> None:
        is_other = request.kind is not RequestKind.STOP and request.kind not in _UNCOUNTED
        # What was asked before it, at the same moment, may go before it.
        if session.stop_requested_at is not None and time > session.stop_requested_at and is_other:
            if (
                request.kind is RequestKind.DISARM
                and session.stop_requested_at < self._inputs.last_disarm + _BEGUN
            ):
                return  # which silences as well
            session.report(
                "stop",
                time,
                f"a stop was wished at {session.stop_requested_at:.4f} s, but the next that {session.name} was "
                f"told is {request.kind.value}",
            )
            session.stop_requested_at = None

    def _check_feed(self, session: AmplifierSession, time: float, request: Request) -> None:
        stalled_since = self._inputs.stalled_since
        is_by_loop = (
            request.kind in (RequestKind.PING, RequestKind.COMMIT, RequestKind.STAGE)
            or request.vibrates
        )
        if stalled_since is not None and time > stalled_since + self._times.slack and is_by_loop:
            session.report(
                "heartbeat",
                time,
                f"the control loop hangs since {stalled_since:.4f} s, but {session.name} is sent "
                f"{request.kind.value}, which feeds its watchdog",
            )
        session.last_feed = time

    def _check_pulse(self, session: AmplifierSession, time: float) -> None:
        if session.is_disturbed(time):
            session.last_feed = None  # who has given an amplifier up owes it nothing
        last = session.last_feed
        is_ending = (
            self._inputs.last_silencing >= session.armed_at
        )  # heartbeats would only be in the way
        is_running = self._inputs.stalled_since is None and not is_ending
        is_owed = session.is_open and session.amplifier.is_enabled and is_running
        if last is None or not is_owed:
            return
        if time > last + self._times.heartbeat + self._times.slack:
            session.last_feed = time
            session.report(
                "heartbeat", time, f"{session.name} has had no sign of life since {last:.4f} s"
            )

    def _check_arm(self, session: AmplifierSession, time: float) -> None:
        # What was begun may be sent yet, and is followed by what withdraws it.
        is_withdrawn = time > self._inputs.last_silencing + self._times.stop
        if self._inputs.is_arm_requested is False and is_withdrawn:
            session.report("armed", time, f"{session.name} is armed although nobody wished it")
        if session.is_identified is False:
            session.report(
                "identified", time, f"{session.name} is armed without being asked who it is"
            )

    def _check_set(self, session: AmplifierSession, time: float, request: Request) -> None:
        check_set(session, time, request, self._expected)
        if request.vibrates:
            self._check_justified(session, time)

    def _check_justified(self, session: AmplifierSession, time: float) -> None:
        if session.is_stopped:
            session.report("stop", time, f"{session.name} is told to vibrate after its stop")
        elif self._knows_of_disarmed(session):
            session.report(
                "enabled", time, f"{session.name} is told to vibrate although it is not enabled"
            )
        is_touched = self._inputs.contacts is None or self._inputs.contacts
        if not is_touched and time > self._inputs.last_lift + self._times.lift + self._times.slack:
            session.report(
                "justified",
                time,
                f"{session.name} is told to vibrate although nobody touches the plate since "
                f"{self._inputs.last_lift:.4f} s",
            )

    def _knows_of_disarmed(self, session: AmplifierSession) -> bool:
        """Whether an amplifier is not enabled, and an answer has said so, or the host has done it.

        A fault that it tells unasked may be on its way while a set goes to it, which it refuses.
        """
        amplifier = session.amplifier
        is_enabled = amplifier.state is None or amplifier.is_enabled
        return not is_enabled and (amplifier.is_answered or not amplifier.is_in_fault)

    # what is remembered

    def _remember(self, session: AmplifierSession, time: float, request: Request) -> None:
        match request.kind:
            case RequestKind.STAGE:
                session.staged = {request.token: request}
            case RequestKind.APPLY | RequestKind.COMMIT:
                is_new = request.token != session.last_token
                session.told.append(request.token)
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
        """Zero itself, not only its command, is there soon after the last lift."""
        if self._inputs.contacts or not 0 <= time - self._inputs.last_lift <= self._times.lift:
            return
        has_endings = (
            any(not command.skip_ending for command in commands.values()) and session.staged
        )
        if (
            time + ramp > self._inputs.last_lift + self._times.release + self._times.slack
            and not has_endings
        ):
            session.report(
                "lift",
                time,
                f"the last finger was lifted at {self._inputs.last_lift:.4f} s, but {session.name} is "
                f"silent only after a ramp of {ramp:g} s",
            )

    def _channel_commands(
        self, session: AmplifierSession, request: Request
    ) -> Mapping[int, ChannelCommand]:
        if request.kind is RequestKind.COMMIT:
            staged = session.staged.get(request.token)
            return staged.commands if staged is not None else session.levels
        return request.commands

    def _vibrates(self, session: AmplifierSession, request: Request) -> bool:
        return any(
            command.vibrates for command in self._channel_commands(session, request).values()
        )

    def _is_silencing(self, request: Request) -> bool:
        is_silent_set = request.kind is RequestKind.APPLY and not request.vibrates
        return is_silent_set or request.kind in (RequestKind.STOP, RequestKind.DISARM)
