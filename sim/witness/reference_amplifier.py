"""Follows one amplifier by the documented protocol, and says where it does something else.

State, fault, active set, watchdog and levels are known within the time between a request and its
answer, and what is said about them holds for all of that time. What it grants and what it says are
told here together: each is judged by what the other has left.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence

from sim.witness.achieved_rules import check_achieved
from sim.witness.config import AmplifierConfig, TimeLimits
from sim.witness.decoded import (
    WATCHDOG_FEEDING,
    ChannelCommand,
    Reply,
    ReportViolation,
    Request,
    RequestKind,
    Status,
)
from sim.witness.reference_outputs import ReferenceOutputs
from sim.witness.watchdog import Watchdog

SILENCING_RAMP = 0.005  # s; along which the watchdog and faults silence
_REMEMBERED = 16  # tokens since Arm
_WARM = 60.0  # °C; from here on an amplifier may play less than it was told
_ENABLED, _STOPPED, _REACTING, _FAULT = 4, 5, 6, 7
_OFF = (0, 1, 2)
_LATCHED = (_STOPPED, _REACTING, _FAULT)
_SILENT = (*_OFF, _FAULT)  # in which no level may be left
_BY_ITSELF = {3: (3, 1), _REACTING: (_REACTING, _FAULT), **dict.fromkeys(_OFF, _OFF)}

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
    """What one amplifier must be doing. state: None while nobody knows.

    insist: is told of what no fault of a wire excuses, complain of everything else.
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
        self.state: int | None = None
        self._fault = 0
        self._is_reported = True  # the state, by the amplifier itself
        self.is_answered = True  # and in an answer to its host
        self.last_fault = -math.inf  # when it was seen to go into a fault last
        self.watchdog = Watchdog(name, slack=times.slack, report=report)
        self._last_status = -math.inf  # when it last said how it is
        self._token: int | None = None
        self._token_before: tuple[int | None, float] = (None, -math.inf)  # and until when it counts
        self._states_before: tuple[set[int], float] = (set(), -math.inf)  # the same, of a stop
        self._played_tokens: deque[int] = deque(maxlen=_REMEMBERED)
        self._staged: Request | None = None
        self._outputs = ReferenceOutputs(name, config, slack=times.slack, report=report)

    @property
    def is_enabled(self) -> bool:
        """Whether it is armed, as far as anybody knows."""
        return self.state == _ENABLED

    @property
    def is_in_fault(self) -> bool:
        """Whether it is in a fault of its own, or of its watchdog."""
        return self.state in (_REACTING, _FAULT)

    def forget_state(self) -> None:
        """What it does now is not known until it says so."""
        self.state = self._token = None
        self._fault = 0
        self.watchdog.forget()
        self._staged = None
        self._outputs.forget()

    def restarted(self, time: float) -> None:
        """It has got its supply anew: disarmed and silent."""
        self.forget_state()
        self.state, self._token = 1, 0
        self._outputs.rest("its restart")
        self._last_status = time

    def fed(self, time: float) -> None:
        """Its watchdog was filled."""
        if self.state == _ENABLED:
            self.watchdog.fed((time, time))

    def advance(self, time: float) -> None:
        """Let happen what it must have done by itself until now."""
        self._outputs.advance(time)
        if self.state == _ENABLED and self.watchdog.has_run_out(time):
            self._silence(self.watchdog.runs_out, SILENCING_RAMP, "the watchdog")
            self.state, self._fault, self._is_reported = _REACTING, 1, False
            self.is_answered = False
            self.last_fault = time

    # what it grants

    def request_granted(self, request: Request, reply: Reply, begin: float, end: float) -> None:
        """A request that was seen at `begin` was not refused, as is known at `end`."""
        self.advance(begin)
        self._check_state_allows(request, end)
        if request.kind in WATCHDOG_FEEDING:
            self.watchdog.fed((begin, end))
        match request.kind:
            case RequestKind.ARM:
                self._silence((begin, end), SILENCING_RAMP, "Arm")
                self.state, self._fault, self._token = _ENABLED, 0, 0
                self.watchdog.time = request.watchdog
                self._played_tokens.clear()
            case RequestKind.DISARM | RequestKind.STOP:
                self._stopped(request, begin, end)
            case RequestKind.STAGE:
                self._staged = request
                self._check_achieved(request, reply, end)
            case RequestKind.APPLY:
                self._check_achieved(request, reply, end)
                self._applied(request, reply, begin, end)
            case RequestKind.COMMIT:
                self._committed(request, reply, begin, end)
            case RequestKind.CLEAR if self.state in (_STOPPED, _FAULT, _REACTING):
                self._cleared(reply)
            case RequestKind.ENVELOPE if request.envelope is not None:
                self._outputs.load(request.envelope)
            case _:
                pass
        if reply.status is not None:
            self.status_reported(reply.status, begin, end)

    def broadcast_sent(self, request: Request, time: float) -> None:
        """A broadcast that it may follow; nobody answers."""
        self.advance(time)
        if self.state is None:
            return
        self.watchdog.may_feed(time)
        soon = (time, time + 0.010)  # as an answer would take
        if request.kind is RequestKind.STOP:
            self._states_before = ({self.state}, soon[1])
            self._stopped(request, *soon)
        elif (
            request.kind is RequestKind.COMMIT
            and self._staged is not None
            and request.token == self._staged.token
            and self.state == _ENABLED
        ):
            self._token_before = (self._token, soon[1])
            self._play(self._staged, self._staged.commands, *soon)

    def _check_state_allows(self, request: Request, end: float) -> None:
        sets = (RequestKind.STAGE, RequestKind.COMMIT, RequestKind.APPLY)
        if request.kind in sets and self.state not in (None, _ENABLED):
            overdue = not self._is_reported
            self._report(
                "watchdog" if overdue else "enabled",
                end,
                f"{self._name} took a set although it must be in {self._state_name()}",
            )
        if request.kind is RequestKind.ARM and self.state in _LATCHED and self._is_reported:
            self._report(
                "latched", end, f"{self._name} let itself be armed in {self._state_name()}"
            )

    def _stopped(self, request: Request, begin: float, end: float) -> None:
        self._silence((begin, end), request.ramp, request.kind.value)
        if request.kind is RequestKind.STOP:
            if self.state is None:  # it may have been in a fault for long
                self.watchdog.fed((-math.inf, end))
            self.state = self.state if self.state in (_REACTING, _FAULT) else _STOPPED
        elif self.state == _ENABLED:
            self.state = 3
        elif _ENABLED in self._states_before[0] and begin <= self._states_before[1]:
            self._states_before[0].add(3)  # it may have been disarmed before it was stopped

    def _cleared(self, reply: Reply) -> None:
        """It may stay as it is, or go to disarmed."""
        said = reply.status
        if said is None:
            self.state = None
        elif said.state in _OFF and not (self.state == _REACTING and self._is_reported):
            self.state, self._fault = 1, 0
            self._outputs.cause = "Clear"

    def _committed(self, request: Request, reply: Reply, begin: float, end: float) -> None:
        if request.token == self._token:
            return
        if self._staged is None or self._staged.token != request.token:
            if self.state is not None:
                self._report(
                    "token", end, f"{self._name} played set {request.token}, which is not staged"
                )
            self.forget_state()
            return
        self._check_achieved(self._staged, reply, end)
        self._applied(self._staged, reply, begin, end)

    def _applied(self, request: Request, reply: Reply, begin: float, end: float) -> None:
        if request.token == self._token:
            return
        if request.token in self._played_tokens:
            self._report_always(
                "token", end, f"{self._name} took set {request.token} a second time after others"
            )
        commands = reply.achieved if reply.achieved is not None else request.commands
        self._play(request, commands, begin, end)
        if reply.is_exact is False and reply.achieved is None:
            self._outputs.free(math.inf)  # only an object tells what it plays

    # what it says

    def status_reported(self, status: Status, begin: float, end: float) -> None:
        """How it says it is, at some time between two [s]."""
        self.advance(begin)
        if status.temperature is not None:
            self._outputs.is_warm = status.temperature >= _WARM
        self._check_condition(status, begin, end)
        self._last_status = end
        self.is_answered = True

    def told(self, state: int, fault: int, time: float) -> None:
        """What it says unasked."""
        was_answered = self.is_answered and state == self.state
        self.status_reported(Status(state, fault), time, time)
        self.is_answered = was_answered

    def _check_condition(self, said: Status, begin: float, end: float) -> None:
        if self.state is None:
            self._adopt(said, end)
        else:
            self._check_state(said, end)
        before, until = self._token_before
        was_earlier = end <= until and said.token == before  # than a commit that nobody answers
        if said.token is not None and not was_earlier:
            if self._token not in (None, said.token):
                self._report(
                    "token",
                    end,
                    f"{self._name} says that set {said.token} plays, but the last that it took is "
                    f"{self._token}",
                )
            self._token = said.token
        if said.watchdog_left is not None:
            self._check_left(said.watchdog_left, said.state, begin, end)
        if said.levels is not None:
            may_be_off = self._may_trip(end)
            self._outputs.check_levels(said.levels, begin, end, may_be_off=may_be_off)
        if said.high_voltage is not None:
            must = {_ENABLED: True, _FAULT: False, **dict.fromkeys(_OFF, False)}.get(said.state)
            if must is not None and must != said.high_voltage:
                what = "off" if must else "on"
                self._report(
                    "high_voltage",
                    end,
                    f"{self._name} has its high voltage {what} in {NAMES[said.state]}",
                )

    def _adopt(self, said: Status, time: float) -> None:
        """The first that is known of it."""
        self.state, self._fault, self._is_reported = said.state, said.fault, True
        if said.state in _SILENT:
            self._outputs.rest(NAMES[said.state])
        else:
            self._outputs.free(math.inf)
            self.watchdog.fed((-math.inf, time))

    def _check_state(self, said: Status, end: float) -> None:
        here, now = self.state, said.state
        trips = now in (_REACTING, _FAULT) and here not in (None, *_OFF, _REACTING, _FAULT)
        states, until = self._states_before
        if end <= until and any(now in _possible_states(state) for state in states):
            return  # it was said before the stop that nobody answers
        if trips:
            self.last_fault = end
            self._check_trip(said, end)
        elif now not in _possible_states(here or 0):
            self._report(self._rule_against(now), end, self._what_is_wrong(now))
        elif now in _LATCHED and self._fault and said.fault != self._fault:
            self._report(
                "latched", end, f"{self._name} was in fault {self._fault}, now it says {said.fault}"
            )
        if now in (_REACTING, _FAULT):
            self._fault = said.fault
        self._outputs.resolve_suspicions(is_enabled=now not in (_REACTING, _FAULT))
        self.state, self._is_reported = now, True

    def _check_trip(self, said: Status, end: float) -> None:
        """A fault of its own, or the watchdog, not before its time."""
        since = (min(self._last_status, end), end)
        if said.fault == 1:
            self.watchdog.check_trip(end)
            since = (min(max(self.watchdog.runs_out[0], self._last_status), end), end)
        elif said.fault == 0:
            self._report("state", end, f"{self._name} is in {NAMES[said.state]} without a fault")
        self._silence(since, SILENCING_RAMP, "a fault")

    def _rule_against(self, now: int) -> str:
        if not self._is_reported:
            return "watchdog" if now == _ENABLED else "latched"
        if now == _ENABLED:
            return "armed"
        return "latched" if self.state in _LATCHED else "state"

    def _what_is_wrong(self, now: int) -> str:
        if not self._is_reported and now == _ENABLED:
            return f"{self._name} is still enabled although {self.watchdog}"
        return f"{self._name} must be in {self._state_name()}, but it says {NAMES[now]}"

    def _check_left(self, left: float, state: int, begin: float, end: float) -> None:
        if state == _ENABLED:
            self.watchdog.check_left(left, begin, end)
        elif state in _OFF and left:
            self._report("watchdog", end, f"{self._name}'s watchdog runs while it is disarmed")

    # what it plays

    def plays(self, levels: Sequence[float], frequencies: Mapping[int, float], time: float) -> None:
        """What a sensor finds on its channels: levels, and where it is known the frequency [Hz]."""
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
        self._played_tokens.append(request.token)
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
        return self.state == _ENABLED and self.watchdog.may_have_run_out(time)

    def _state_name(self) -> str:
        return NAMES[self.state] if self.state is not None else "some state"


def _possible_states(state: int) -> tuple[int, ...]:
    """The states in which an amplifier may be that was in one, and was asked nothing since."""
    return _BY_ITSELF.get(state, (state,))
