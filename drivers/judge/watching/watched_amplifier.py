"""An amplifier as it must be (`drivers.judge`) by what passes on a wire, where replies get lost.

A request without a reply may have been carried out: the next status says so.
"""

import math
from functools import partial

from drivers.judge.watching.capture import ReportViolation
from drivers.judge.watching.decoded import (
    CHANGING,
    FEEDING,
    REPLIES,
    Request,
    is_carried_out,
)
from drivers.protocol.definition import REACTION, REFUSALS, STATUS, name_of
from drivers.protocol.records import Values
from era_haptics.lab.expected_amplifier import OFF, ExpectedAmplifier
from era_haptics.lab.expected_output import Interval

_LEFT = 0.011  # s; tolerance of the reported time left of the watchdog, as that of a host


class WatchedAmplifier(ExpectedAmplifier):
    """The expected state of one amplifier by name; times [s].

    report_always: for violations that no fault of the wire excuses; report: for all others.
    is_answered: it has said in a reply that it is in a fault; last_fault: when that came;
    reported_at: when it showed a state other than before. unanswered: requests that have no
    reply, and may have been carried out.
    """

    def __init__(
        self,
        name: str,
        *,
        slack: float,
        report: ReportViolation,
        report_always: ReportViolation,
    ) -> None:
        self._name = name
        always, excused = partial(self._say, report_always), partial(self._say, report)
        super().__init__(excused, always, slack=slack, left_slack=_LEFT)
        self.last_fault = -math.inf
        self.is_answered = True
        self.reported_at = -math.inf
        self._answered = 0  # number of the newest request of which a reply was seen
        self._requested = 0  # statuses since the last that was heard
        self._fed_before = math.inf
        # Silence where there must be none, which an unreported fault would explain.
        self._suspicions: list[tuple[str, float, str, object, object]] = []

    def _say(
        self, report: ReportViolation, rule: str, time: float, what: str, *, must: object,
        seen: object,
    ) -> None:  # fmt: skip
        report(rule, time, f"{self._name}: {what} must be {must}, got {seen}")

    def report_silence(
        self, rule: str, time: float, what: str, *, must: object, seen: object
    ) -> None:
        """Note silence that is no violation if it has a fault, as its next status says."""
        self._suspicions.append((rule, time, what, must, seen))

    def forget(self, cause: str = "what was not heard") -> None:
        """Treat all as unknown until the next status."""
        super().forget(cause)
        self.unanswered: list[Request] = []

    def restarted(self, time: float) -> None:
        """Note a restart: disarmed and silent."""
        self.forget()
        self.state, self.token, self.last_status = OFF, 0, time
        self._settle("a restart", (time, time))

    def advance(self, time: float) -> None:
        """Apply what must have happened without a request until now."""
        if not self.unanswered:
            super().advance(time)

    def _trip(self, fault: int, since: Interval, cause: str) -> None:
        super()._trip(fault, since, cause)
        self.is_answered, self.last_fault = False, since[1]

    # requests

    def set_sent(self, request: Request) -> str:
        """Note a part of a set that is sent; returns what is wrong with it, or ""."""
        part = request.values
        if part["index"] >= part["parts"]:
            return f"index must be below {part['parts']}, got {part['index']}"
        if not request.has_reply:
            self.part_came(part, (request.started_at, request.since + REACTION))
            return ""
        return self.sets.sent(part)

    def part_came(self, part: Values, when: Interval) -> None:
        """Apply a part of a set but the last, which may be lost, and then feeds nothing."""
        fed = self.fed
        super().part_came(part, when)
        self.fed = fed

    def sent(self, request: Request) -> None:
        """Note a request without a reply, or none yet, that may be carried out soon."""
        if request.name in FEEDING:
            self._fed_before = self.fed[1]
            self.fed = self.fed[0], max(self.fed[1], request.started_at + REACTION)
        if request.name == "Mark" and request.key is None:
            self.clock.mark((request.started_at, request.since + REACTION))
        self._requested += REPLIES.get(request.name) is STATUS and request.key is not None
        if request.name in CHANGING and request.has_reply:
            self.unanswered.append(request)

    def replied(self, request: Request, values: Values, end: float) -> None:
        """Apply a request carried out until a time [s], and compare its reply.

        A reply that the wire delayed beyond that of a newer request says nothing of now.
        """
        if request.number < self._answered:
            return
        self._answered = request.number
        name = request.name
        self.advance(request.earliest)
        if REPLIES.get(name) is STATUS:
            if self._requested > 1:
                self.clock.unheard()
            self._requested = 0
            self._resolve(request.number, values, end)
        elif name in ("GetAchieved", "GetFaults") and self.unanswered:
            return
        self.granted(name, request.values, values, (request.earliest, end))

    def refused(self, request: Request, code: int, time: float) -> None:
        """Note a refusal; what silences must not be refused, nor a commit of what is staged."""
        if request.problem:  # which must be refused
            return
        if request.name == "Set":
            self.part_refused(request.values, name_of(REFUSALS, code))
        if request.name in FEEDING:
            self.fed = self.fed[0], self._fed_before
        if request.name in ("Stop", "Disarm"):
            self.report("stop", time, f"answer to {request.name}", must="a status", seen="a Nak")
        until, _ = self.sets.staged_until(request.values.get("token"))
        is_held = self.is_enabled and request.values.get("session") == self.session
        if request.name == "Commit" and is_held and time + REACTION <= until:
            what = f"answer to Commit of set {request.values['token']}, which is staged"
            self.report("commit", time, what, must="a status", seen="a Nak")

    def _resolve(self, number: int, status: Values, end: float) -> None:
        """Apply earlier requests without a reply that were carried out by a status."""
        earlier = [each for each in self.unanswered if each.number < number]
        self.unanswered = [each for each in self.unanswered if each.number >= number]
        for request in earlier if self.state is not None else ():
            started_at, is_broadcast = request.started_at, request.key is None
            until, _ = self.sets.staged_until(request.values.get("token"))
            match request.name:
                case _ if is_carried_out(request, status):
                    last = min(end, started_at + REACTION) if is_broadcast else end
                    when = started_at, max(last, started_at)
                    self.carry_out(request.name, request.values, status, when)
                case "Arm":
                    self.token = None  # 0, if it was carried out before what disarmed again
                case "Stop" if is_broadcast:
                    what = "answer to a broadcast Stop"
                    self.report("stop", end, what, must="obeyed", seen="none")
                case _ if is_broadcast and started_at + REACTION <= until:
                    what = f"answer to a broadcast Commit of set {request.values['token']}"
                    self.report("commit", end, what, must="obeyed", seen="none")

    # reports

    def note_state(self, shown: Values, when: Interval) -> bool:
        """Compare state, fault and latch, and go on with them; returns whether the state fits."""
        before = self.state, self.is_shown
        fits = super().note_state(shown, when)
        if before != (shown["state"], True):
            self.reported_at = when[1]
        for rule, time, what, must, seen in () if self.is_in_fault else self._suspicions:
            self.report(rule, time, what, must=must, seen=seen)
        self._suspicions.clear()
        return fits

    def check(self, shown: Values, when: Interval) -> None:
        """Compare a status that was true at some time between two."""
        super().check(shown, when)
        self.is_answered = True

    def event_reported(self, event: Values, time: float) -> None:
        """Compare an Event, unless a request that explains it is not replied to yet."""
        if self.unanswered:
            return
        self.advance(time)
        if not self.note_state(event, (time, time)):
            self._adopt(event, (time, time))
        self.last_status = time
