"""A reference model of one amplifier by the documented protocol, compared with its replies.

State, fault, active set, watchdog and levels are known only within the interval between a request
and its reply; reports are compared with all of that interval.
"""

import math
from collections.abc import Mapping, Sequence

from sim.witness.achieved_rules import check_achieved
from sim.witness.config import AmplifierConfig, TimeLimits
from sim.witness.decoded import (
    WATCHDOG_FEEDING,
    ChannelCommand,
    Reply,
    Request,
    RequestKind,
    Status,
)
from sim.witness.quantities import is_newer
from sim.witness.reference_outputs import ReferenceOutputs
from sim.witness.reports import Faults, Interval, fault_list_problem
from sim.witness.violation import ReportViolation
from sim.witness.watchdog import Watchdog

SILENCING_RAMP = 0.005  # s; along which the watchdog and faults silence
_CARRIED_OUT = 0.010  # s; within which a request is carried out, replied to or not
_STAGED_LIFE = 1.0  # s; of a set without its commit
_WARM = 60.0  # °C; from here on an amplifier may derate
_ENABLED, _STOPPED, _REACTING, _FAULT = 4, 5, 6, 7
_OFF = (0, 1, 2)
_LATCHED = (_STOPPED, _REACTING, _FAULT)
_SILENT = (*_OFF, _FAULT)
_SPONTANEOUS = {3: (3, 1), _REACTING: (_REACTING, _FAULT), **dict.fromkeys(_OFF, _OFF)}

NAMES = (
    "NOT_READY",
    "SWITCH_ON_DISABLED",
    "READY_TO_SWITCH_ON",
    "SWITCHED_ON",
    "OPERATION_ENABLED",
    "QUICK_STOP_ACTIVE",
    "FAULT_REACTION_ACTIVE",
    "FAULT",
)


class ReferenceAmplifier:
    """The expected state of one amplifier; None while it is unknown.

    report_always: for violations that no fault of the wire excuses; report: for all others.
    """

    def __init__(
        self,
        name: str,
        config: AmplifierConfig,
        *,
        times: TimeLimits,
        report: ReportViolation,
        report_always: ReportViolation,
    ) -> None:
        self._name = name
        self._config = config
        self._report = report
        self._report_always = report_always
        self._slack = times.slack
        self.state: int | None = None
        self._fault = 0
        self._is_reported = True  # the amplifier has reported this state
        self.is_answered = True  # in a reply
        self.last_fault = -math.inf  # when it was seen to enter a fault
        self._fault_since: Interval | None = None  # when the present one came, if known
        self.watchdog = Watchdog(name, slack=times.slack, report=report)
        self._last_status = -math.inf  # time of its last status
        self._token: int | None = None
        self._token_before: tuple[int | None, float] = (
            None,
            -math.inf,
        )  # and until when it is valid
        self._states_before: tuple[set[int], float] = (set(), -math.inf)  # of a stop
        self._broadcast_stop: Request | None = None  # the last one
        self._stopped_between = (-math.inf, -math.inf)  # when it took effect
        self._session: int | None = None  # None: unknown
        self._staged: Request | None = None
        self._staged_until = -math.inf
        self._outputs = ReferenceOutputs(name, config, slack=times.slack, report=report)

    @property
    def is_enabled(self) -> bool:
        """Whether it is armed, as far as is known."""
        return self.state == _ENABLED

    @property
    def is_in_fault(self) -> bool:
        """Whether it is in a fault, or reacting to one."""
        return self.state in (_REACTING, _FAULT)

    def forget_state(self) -> None:
        """Treat the state as unknown until the next status."""
        self.state = self._token = self._session = None
        self._fault = 0
        self.watchdog.forget()
        self._staged = None
        self._outputs.forget()

    def restarted(self, time: float) -> None:
        """Note a restart: disarmed and silent."""
        self.forget_state()
        self.state, self._token = 1, 0
        self._outputs.settle("a restart")
        self._last_status = time

    def feed(self, time: float) -> None:
        """Feed its watchdog by a frame that has no reply, carried out soon."""
        if self.state == _ENABLED:
            self.watchdog.feed((time, time + _CARRIED_OUT))

    def may_feed(self, time: float) -> None:
        """Note a request that feeds its watchdog unless refused or lost, carried out soon."""
        self.watchdog.may_feed(time + _CARRIED_OUT)

    def advance(self, time: float) -> None:
        """Apply what must have happened without a request until now."""
        self._outputs.advance(time)
        if self.state == _ENABLED and self.watchdog.has_expired(time):
            self._silence(self.watchdog.expiry, SILENCING_RAMP, "the watchdog")
            self.state, self._fault, self._is_reported = _REACTING, 1, False
            self.is_answered = False
            self.last_fault, self._fault_since = time, self.watchdog.expiry

    # requests

    def request_granted(self, request: Request, reply: Reply, begin: float, end: float) -> None:
        """Apply a request sent at `begin` and granted by a reply at `end` [s]."""
        self.advance(begin)
        self._check_state_allows(request, end)
        self._check_session(request, end)
        is_late = reply.status is not None and reply.status.state in (_REACTING, _FAULT)
        if request.kind in WATCHDOG_FEEDING and not is_late:  # else it may have expired before
            self.watchdog.feed((begin, end))
        match request.kind:
            case RequestKind.ARM:
                if self.state != _ENABLED:
                    self._silence((begin, end), SILENCING_RAMP, "Arm")
                    self._token = 0
                self.state, self._fault, self._session = _ENABLED, 0, request.session
                self.watchdog.time = request.watchdog
            case RequestKind.DISARM | RequestKind.STOP:
                self._stopped(request, begin, end)
            case RequestKind.STAGE:
                self._staged, self._staged_until = request, end + _STAGED_LIFE
                self._check_achieved(request, reply, end)
            case RequestKind.APPLY:
                self._check_achieved(request, reply, end)
                self._applied(request, reply, begin, end)
            case RequestKind.COMMIT:
                self._committed(request, reply, begin, end)
            case RequestKind.CLEAR if self.state in (_STOPPED, _FAULT, _REACTING):
                self._cleared(reply, begin)
            case RequestKind.ENVELOPE if request.envelope is not None:
                self._outputs.load(request.envelope)
            case _:
                pass
        if reply.status is not None:
            self.status_reported(reply.status, begin, end)

    def granted_before_stop(self, request: Request, reply: Reply, begin: float, end: float) -> None:
        """Apply a request that preceded the last broadcast Stop, and whose reply came after it.

        A line delivers in order: the request was carried out first, and its reply reports how the
        amplifier was then. Of that only the set is compared.
        """
        self.advance(begin)
        stop, between = self._broadcast_stop, self._stopped_between
        if stop is None or self.state is None:
            return
        if request.kind in WATCHDOG_FEEDING:
            self.watchdog.may_feed(between[1])
        match request.kind:
            case RequestKind.ARM:
                self.watchdog.time, self._session = request.watchdog, request.session
                self._token = 0
                self._states_before[0].add(_ENABLED)
            case RequestKind.DISARM:
                self._states_before[0].add(3)
            case RequestKind.CLEAR if reply.status is not None and reply.status.state in _OFF:
                self.state, self._fault, self._is_reported = _STOPPED, 0, False
            case RequestKind.APPLY | RequestKind.STAGE:
                self._check_achieved(request, reply, end)
            case _:
                pass
        if request.kind in (RequestKind.APPLY, RequestKind.COMMIT) and request.token != self._token:
            self._token = request.token
            self._outputs.set_unknown(between[1] + stop.ramp)

    def broadcast_sent(self, request: Request, time: float) -> None:
        """Apply a broadcast, which has no reply."""
        self.advance(time)
        if self.state is None:
            return
        self.may_feed(time)
        soon = (time, time + _CARRIED_OUT)
        if request.kind is RequestKind.STOP:
            self._states_before = ({self.state}, soon[1])
            self._broadcast_stop, self._stopped_between = request, soon
            self._stopped(request, *soon)
        elif (
            request.kind is RequestKind.COMMIT
            and self._staged is not None
            and request.token == self._staged.token
            and time <= self._staged_until
            and self.state == _ENABLED
        ):
            self._token_before = (self._token, soon[1])
            self._play(self._staged, self._staged.commands, *soon)

    def _check_session(self, request: Request, end: float) -> None:
        """Only the session that is held plays, and feeds the watchdog."""
        known = None not in (self._session, request.session)
        if self.state == _ENABLED and known and request.session != self._session:
            self._report(
                "session",
                end,
                f"{self._name} accepted {request.kind.value} of session {request.session}, held by "
                f"{self._session}",
            )

    def _check_state_allows(self, request: Request, end: float) -> None:
        sets = (RequestKind.STAGE, RequestKind.COMMIT, RequestKind.APPLY)
        if request.kind in sets and self.state not in (None, _ENABLED):
            overdue = not self._is_reported
            self._report(
                "watchdog" if overdue else "enabled",
                end,
                f"{self._name} accepted a set in {self._state_name()}",
            )
        if request.kind is RequestKind.ARM and self.state in _LATCHED and self._is_reported:
            self._report("latched", end, f"{self._name} accepted Arm in {self._state_name()}")

    def _stopped(self, request: Request, begin: float, end: float) -> None:
        self._silence((begin, end), request.ramp, request.kind.value)
        if request.kind is RequestKind.STOP:
            if self.state is None:  # it may have been in a fault before
                self.watchdog.feed((-math.inf, end))
            self.state = self.state if self.state in (_REACTING, _FAULT) else _STOPPED
        elif self.state == _ENABLED:
            self.state = 3

    def _cleared(self, reply: Reply, begin: float) -> None:
        """Apply Clear, which may leave the state as it is."""
        reported = reply.status
        # The event that ends the reaction is not heard while other requests are pending.
        is_reacting = self.state == _REACTING and begin <= self._last_status + SILENCING_RAMP
        if reported is None:
            self.state = None
        elif reported.state in _OFF and not (is_reacting and self._is_reported):
            self.state, self._fault = 1, 0
            self._outputs.cause = "Clear"

    def _committed(self, request: Request, reply: Reply, begin: float, end: float) -> None:
        if request.token == self._token:
            return
        if self._staged is None or self._staged.token != request.token:
            if self.state is not None:
                self._report(
                    "token", end, f"{self._name} committed set {request.token}, which is not staged"
                )
            self.forget_state()
            return
        if begin > self._staged_until + self._slack:
            self._report("token", end, f"{self._name} committed set {request.token} of long ago")
        self._check_achieved(self._staged, reply, end)
        self._applied(self._staged, reply, begin, end)

    def _applied(self, request: Request, reply: Reply, begin: float, end: float) -> None:
        if request.token == self._token:
            return
        if self._token is not None and not is_newer(request.token, self._token):
            self._report_always(
                "token", end, f"{self._name} accepted set {request.token} after set {self._token}"
            )
        commands = reply.achieved if reply.achieved is not None else request.commands
        self._play(request, commands, begin, end)
        if reply.is_exact is False and reply.achieved is None:
            self._outputs.set_unknown(
                math.inf
            )  # it plays something else, which only an object reports

    # reports

    def status_reported(self, status: Status, begin: float, end: float) -> None:
        """Compare a status that was true at some time between two [s]."""
        self.advance(begin)
        if status.temperature is not None:
            self._outputs.is_warm = status.temperature >= _WARM
        self._check_condition(status, begin, end)
        self._last_status = end
        self.is_answered = True

    def event_received(self, state: int, fault: int, time: float) -> None:
        """Compare an unsolicited state event."""
        self.refusal_received(Status(state, fault), time, time)

    def refusal_received(self, status: Status, begin: float, end: float) -> None:
        """Compare the status in a refusal, of which hosts need to read the reason only."""
        was_answered = self.is_answered and status.state == self.state
        self.status_reported(status, begin, end)
        self.is_answered = was_answered

    def faults_reported(self, faults: Faults, start: float, end: float) -> None:
        """Compare a list of faults that was true at some time between two [s]."""
        self.advance(start)
        is_known = self.is_in_fault and self._is_reported
        problem = fault_list_problem(
            faults,
            (start - self._slack, end + self._slack),
            present=self._fault if is_known else 0,
            since=self._fault_since,
        )
        if problem is not None:
            self._report("faults", end, f"{self._name} {problem}")

    def _check_condition(self, reported: Status, begin: float, end: float) -> None:
        if self.state is None:
            self._adopt(reported, end)
        else:
            self._check_state(reported, end)
        before, until = self._token_before
        was_earlier = end <= until and reported.token == before  # than a broadcast commit
        if reported.token is not None and not was_earlier:
            if self._token not in (None, reported.token):
                self._report(
                    "token",
                    end,
                    f"{self._name} reports active set {reported.token}, expected {self._token}",
                )
            self._token = reported.token
        if reported.watchdog_left is not None:
            self._check_left(reported.watchdog_left, reported.state, begin, end)
        if reported.levels is not None:
            may_be_off = self._may_trip(end)
            self._outputs.check_levels(reported.levels, begin, end, may_be_off=may_be_off)
        if reported.high_voltage is not None:
            must = {_ENABLED: True, _FAULT: False, **dict.fromkeys(_OFF, False)}.get(reported.state)
            if must is not None and must != reported.high_voltage:
                what = "off" if must else "on"
                self._report(
                    "high_voltage",
                    end,
                    f"{self._name} reports high voltage {what} in {NAMES[reported.state]}",
                )

    def _adopt(self, reported: Status, time: float) -> None:
        """Adopt a reported status where the state is unknown."""
        self.state, self._fault, self._is_reported = reported.state, reported.fault, True
        self._fault_since = None
        if reported.state in _SILENT:
            self._outputs.settle(NAMES[reported.state])
        else:
            self._outputs.set_unknown(math.inf)
            self.watchdog.feed((-math.inf, time))

    def _check_state(self, reported: Status, end: float) -> None:
        here, now = self.state, reported.state
        trips = now in (_REACTING, _FAULT) and here not in (None, *_OFF, _REACTING, _FAULT)
        states, until = self._states_before
        is_earlier = end <= until and any(now in _possible_states(state) for state in states)
        if is_earlier and now not in _possible_states(here or 0):
            return  # reported before the broadcast stop
        if trips:
            self.last_fault = end
            self._check_trip(reported, end)
        elif now not in _possible_states(here or 0):
            self._report(self._rule_against(now), end, self._state_problem(now))
        elif now in _LATCHED and self._fault and reported.fault != self._fault:
            self._report(
                "latched",
                end,
                f"{self._name} reports fault {reported.fault} instead of {self._fault}",
            )
        if now in (_REACTING, _FAULT):
            self._fault = reported.fault
        self._outputs.resolve_suspicions(is_enabled=now not in (_REACTING, _FAULT))
        self.state, self._is_reported = now, True

    def _check_trip(self, reported: Status, end: float) -> None:
        """Check a transition into a fault: the watchdog not before its time."""
        since = (min(self._last_status, end), end)
        if reported.fault == 1:
            self.watchdog.check_trip(end)
            since = (min(max(self.watchdog.expiry[0], self._last_status), end), end)
        elif reported.fault == 0:
            self._report(
                "state", end, f"{self._name} is in {NAMES[reported.state]} without a fault"
            )
        self._fault_since = since
        self._silence(since, SILENCING_RAMP, "a fault")

    def _rule_against(self, now: int) -> str:
        if not self._is_reported:
            return "watchdog" if now == _ENABLED else "latched"
        if now == _ENABLED:
            return "armed"
        return "latched" if self.state in _LATCHED else "state"

    def _state_problem(self, now: int) -> str:
        if not self._is_reported and now == _ENABLED:
            return f"{self._name} is still enabled: {self.watchdog}"
        return f"{self._name} must be in {self._state_name()}, got {NAMES[now]}"

    def _check_left(self, left: float, state: int, begin: float, end: float) -> None:
        if state == _ENABLED:
            self.watchdog.check_left(left, begin, end)
        elif state in _OFF and left:
            self._report("watchdog", end, f"{self._name}: watchdog runs while disarmed")

    # outputs

    def check_sensors(
        self, levels: Sequence[float], frequencies: Mapping[int, float], time: float
    ) -> None:
        """Compare what sensors measure on its channels: levels, and known frequencies [Hz]."""
        self.advance(time)
        self._outputs.check_sensors(
            levels,
            frequencies,
            time,
            may_be_off=self._may_trip(time),
            is_enabled=self.is_enabled,
        )

    def _play(
        self, request: Request, commands: Mapping[int, ChannelCommand], begin: float, end: float
    ) -> None:
        self._token, self._staged = request.token, None
        self._outputs.play(request, commands, begin, end)

    def _silence(self, begin: tuple[float, float], ramp: float, cause: str) -> None:
        self._staged = None
        self._outputs.silence(begin, ramp, cause)

    def _check_achieved(self, request: Request, reply: Reply, time: float) -> None:
        is_warm = self._outputs.is_warm
        check_achieved(
            self._name,
            request,
            reply,
            time,
            is_warm=is_warm,
            report=self._report,
        )

    def _may_trip(self, time: float) -> bool:
        return self.state == _ENABLED and self.watchdog.may_have_expired(time)

    def _state_name(self) -> str:
        return NAMES[self.state] if self.state is not None else "an unknown state"


def _possible_states(state: int) -> tuple[int, ...]:
    """The states that an amplifier may enter from a state without a request."""
    return _SPONTANEOUS.get(state, (state,))
