"""One physical line: the requests of all amplifiers on it, one at a time, by priority.

The pump is a function, called on each submission, arrival and timer; no request waits in a task of
its own. A request is made when its turn has come, so that it is checked once, against what really
went out before. The parts of a set go out without a pause; only the last has a reply, and is
repeated. Stop-class requests preempt and supersede all others. Times [s] are of the event loop's
clock.
"""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from typing import Protocol, TypeAlias

from drivers import trace
from drivers.errors import (
    CommandRefused,
    FrameError,
    LinkError,
    LinkTimeout,
    Preempted,
    WireCounters,
    WrongAmplifier,
)
from drivers.ports import OpenPort
from drivers.protocol.definition import (
    ATTEMPTS,
    BROADCAST,
    FAST,
    FAULTS,
    MESSAGES,
    REACTION,
    REPLY_TIMEOUT,
    STATES,
    name_of,
)
from drivers.protocol.records import Values
from drivers.trace import Direction
from drivers.wires.wire import (
    BrokenReply,
    Continuation,
    DuplicateAddress,
    Event,
    Nak,
    OtherHost,
    Reply,
    Wire,
    WrittenPart,
)

_NOT_ARMED = ("WRONG_STATE", "WRONG_SESSION")
_REMEDIES = {
    "WRONG_SESSION": "; another host has armed it, or did last: disarm, then arm anew",
    "WRONG_STATE": "; see what ails it by `era amp status`, then clear and arm again",
}


def refused_by_amplifier(where: str, refusal: Nak, *, may_play: bool) -> CommandRefused:
    """Return the error of a request that was refused on a line; may_play: see `CommandRefused`."""
    channel = "" if refusal.channel is None else f", channel {refusal.channel}"
    return CommandRefused(
        f"{where}: the amplifier refused the request: {refusal.code}{channel}"
        + _REMEDIES.get(refusal.code, ""),
        channel=refusal.channel,
        may_play=may_play,
        is_disarmed=refusal.code in _NOT_ARMED,
    )


def no_reply(
    where: str, name: str, timeout: float, remark: str, *, before: float, boot_time: float
) -> str:
    """Return why a request of a name on a line had no reply within a time [s].

    remark: what came instead; before [s]: for how long the reply before was awaited; boot_time [s]:
    of a board behind a port that was opened just now, else 0.
    """
    if not remark and before > timeout:
        remark = f"the reply before took {1e3 * before:.0f} ms: check what delays frames on the way"
    hint = "check that the amplifier is switched on"
    if name == "GetCaps":  # which comes behind an answered Hello
        hint = "it answered Hello, but not GetCaps"
    came = f", but {remark}" if remark else f"; {hint}"
    cause = f"{where}: no reply within {1e3 * timeout:g} ms{came}"
    if boot_time:
        cause += (
            f". A board that restarts when its port is opened must reply within {boot_time:g} s; "
            "set one that takes longer not to restart"
        )
    return cause


def contradicted(name: str, problem: str) -> CommandRefused:
    """Return the error of an amplifier that contradicts its requests again and again."""
    return CommandRefused(
        f"amplifier {name} contradicts its requests: {problem}; look for a derated or broken "
        "channel, an exchanged cable or firmware, then clear and arm again"
    )


def disarmed(name: str, status: Values) -> CommandRefused:
    """Return the error of what plays or feeds, once a status shows that it is not armed."""
    return CommandRefused(
        f"amplifier {name} is not armed but in {name_of(STATES, status['state'])}, fault "
        f"{name_of(FAULTS, status['fault'])}; once the cause is gone, clear and arm again",
        is_disarmed=True,
    )


def driven_by_another(name: str) -> WrongAmplifier:
    """Return the error of an amplifier that another host drives."""
    return WrongAmplifier(f"amplifier {name} is driven by another host; end that one first")


MAX_WAIT = 0.05  # s; after which a request goes before newer sets and heartbeats


class Priority(IntEnum):
    """Priority of a request: the smaller is sent first."""

    STOP = 0
    SILENCE = 1
    HEARTBEAT = 2
    SET = 3
    ARM = 4
    CLEAR = 5
    OTHER = 6
    READING = 7


_SUPERSEDED = {
    # A queued heartbeat would feed the watchdog of an amplifier that did not receive the stop.
    Priority.STOP: (Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR),
    Priority.SILENCE: (Priority.SET, Priority.ARM),
}


Make: TypeAlias = Callable[[], list[Values]]
"""What a request says, known once its turn has come.

Called once, then; returns the values of its messages, or raises CommandRefused.
"""


@dataclass
class LinkStatistics(WireCounters):
    """Statistics of a link at one moment.

    Inherited counters restart when the link is opened, the following count since its construction.
    retries: repeated requests; timeouts: requests without a reply in time; refusals: Naks.
    last_round_trip [s].
    """

    retries: int = 0
    timeouts: int = 0
    refusals: int = 0
    last_round_trip: float | None = None


class Member(Protocol):
    """An amplifier on a line, which notes what is sent to it and what comes from it."""

    name: str
    address: int
    counts: LinkStatistics
    silence_cause: str | None
    """Why it counts as mute: it did not reply to a request."""

    def next_request(self, name: str, values: Values, priority: Priority) -> float:
        """Return how long it and its reply take on the wire [s]; raises if it must not go out."""

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and arrives at a time [s]."""

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s]."""

    def note_unasked(self, arrival: Event | OtherHost | DuplicateAddress) -> None:
        """Note what came without a request."""


@dataclass(eq=False, slots=True)
class Job:
    """A request from its queueing to its result; member: None for a broadcast.

    values: of the message on the line, or next. make: until its turn has come; parts: the messages
    that it made, the last of which is replied to; part: number of the one on the line, or next.
    reached: the first part that was missing when the last reply came. attempts: left. started_at
    [s]: when it went out behind what was sent before. takes: on the wire with its reply [s].
    delays: of this process, while its reply is awaited. had_no_reply: to an earlier attempt.
    """

    member: Member | None
    priority: Priority
    name: str
    values: Values
    timeout: float
    queued_at: float
    make: Make | None = None
    result: "asyncio.Future[Values]" = field(default_factory=asyncio.Future)
    parts: Sequence[Values] = ()
    part: int = 0
    reached: int = 0
    attempts: int = ATTEMPTS
    is_pausing: bool = False
    sent_at: float = 0.0
    started_at: float = 0.0
    due: float = 0.0
    takes: float = 0.0
    delays: int = 0
    is_last_look: bool = False
    had_no_reply: bool = False

    @property
    def has_further_parts(self) -> bool:
        """Whether the message on the line is no last part, and so has no reply."""
        return self.part < len(self.parts) - 1

    def reach(self, part: int) -> None:
        """Note that all before a part have arrived: one that is farther than ever begins anew."""
        if part > self.reached:
            self.reached, self.attempts = part, ATTEMPTS

    def is_missing(self, taken: Values) -> bool:
        """Go back to the first part that a reply to the last says is missing; False if none is."""
        missing = taken["missing"]
        if taken["staged"] or taken["played"] or missing >= self.part:
            return False
        self.part, self.values = missing, self.parts[missing]
        self.reach(missing)
        return True

    @property
    def is_stop_class(self) -> bool:
        """Whether it silences the amplifier: sent and repeated before all others."""
        return self.priority <= Priority.SILENCE

    def has_waited(self, now: float) -> bool:
        """Whether it is as urgent as a heartbeat by now [s], for it waits for long."""
        is_minor = Priority.HEARTBEAT < self.priority < Priority.READING
        return is_minor and now - self.queued_at > MAX_WAIT

    def is_superseded_by(self, priority: Priority, member: Member | None) -> bool:
        """Whether a request for an amplifier, None for all, makes it obsolete."""
        return self.priority in _SUPERSEDED.get(priority, ()) and member in (self.member, None)


class JobQueue:
    """Jobs that wait for one line."""

    def __init__(self) -> None:
        self.jobs: list[Job] = []
        """In the order in which they were queued, as those of one rank are sent."""
        self.add = self.jobs.append
        self._had_waited = False  # the last one that was taken

    def remove(self, job: Job) -> None:
        """Take a job out, if it waits."""
        if job in self.jobs:
            self.jobs.remove(job)

    def take(self, job: Job, now: float) -> None:
        """Take the one out whose turn it is."""
        self.jobs.remove(job)
        self._had_waited = job.has_waited(now)

    def _rank(self, job: Job, now: float) -> tuple[int, int]:
        """Place at a time [s]: of those that have waited for long one before a heartbeat."""
        if job.has_waited(now):
            return Priority.HEARTBEAT, 2 if self._had_waited else 1
        is_reading = job.priority is Priority.READING
        return job.priority if is_reading else min(job.priority, Priority.ARM), 1

    def has_before(self, job: Job, now: float) -> bool:
        """Whether a job that waits goes before another one at a time [s]."""
        first = self.next(now) if self.jobs else None
        return first is not None and self._rank(first, now) < self._rank(job, now)

    def next(self, now: float) -> Job | None:
        """Return the job whose turn it is; None while all pause, or a stop does."""
        first: Job | None = self.jobs[0]
        if len(self.jobs) > 1:
            ready = [job for job in self.jobs if job.is_stop_class or not job.is_pausing]
            first = min(ready, key=lambda job: self._rank(job, now), default=None)
        return None if first is None or first.is_pausing else first


GRACE = 0.008  # s; how long a stop waits for the reply to another request
BUSY_PAUSE = 0.005  # s; before a request goes again to a busy amplifier
_AHEAD = 0.005  # s; what is on its way when the next part of a set follows: a stop waits for it
_FULL_PAUSE = 0.0005  # s; before a port that is blocked is looked at again
_LOOK_INTERVAL = 0.01  # s; in which a delay of this process is noticed
_LATE = 0.005  # s; a timer later than this means that this process was delayed
MAX_LATE = 0.032
"""By so much longer [s] than on a prompt wire a reply is awaited where replies have come late.

An adapter may keep what passes for 16 ms, each way.
"""
_LATE_DECAY = 0.9  # with each reply
_MAX_COMMIT_LATE = 0.003  # s; frames of USB at full speed, 1 ms, of port, hub and adapter
_SENDING = 0.0005  # s; until this process has written to all lines
_DELAYS = 4  # of this process that prolong the wait for one reply
SUPERSEDED = "superseded by a newer set, or by a stop or disarm"


class Line:
    """A line of a port that takes what is received to `received`, and a loss to `lose`.

    boot_time [s]: for which Hello is repeated once it is open, until an amplifier has replied: its
    board may restart when its port is opened.
    """

    def __init__(self, wire: Wire, name: str, *, boot_time: float = 0.0) -> None:
        self.wire = wire
        self.name = name
        self.loss: str | None = None
        self.members: dict[int, Member] = {}
        self.seen: Callable[[str, int, str, object], None] | None = None
        """Called with each message: out, in, event or none; address, name, content. Must return."""
        self.ahead: Callable[[str, Priority], Make | None] | None = None
        """Called with each request to one amplifier: what to commit on all of the line ahead."""
        self._queue = JobQueue()
        self.current: Job | None = None
        """The request on the line; None if it is free."""
        self._timer: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self.time = self._loop.time
        """The clock of the line [s]."""
        self._boot_time, self._boots_until = boot_time, -math.inf
        self._is_pumping = False
        self._sent_until = 0.0  # s; before, what was sent is still on its way
        self._free_at = 0.0  # s; before, a reply may still take the line
        self.late = 0.0
        """By how much later [s] than the wire takes replies have come, at most `MAX_LATE`."""

    def open(self, port: OpenPort) -> None:
        """Send by a port that is open."""
        self._port = port
        self._commit_takes = self.wire.transit(MESSAGES["Commit"].request.words)
        self._boots_until = self.time() + self._boot_time

    def submit(
        self,
        member: Member | None,
        priority: Priority,
        name: str,
        values: Values | Make,
        *,
        timeout: float = REPLY_TIMEOUT,
    ) -> "asyncio.Future[Values]":
        """Queue a request of an amplifier; the future has the values of its last reply.

        Or raises LinkError, LinkTimeout, FrameError, CommandRefused; Preempted where another
        request came first. member: None for a broadcast, which has no reply: the future ends once
        it was sent.
        """
        make, values = (values, Values()) if callable(values) else (None, values)
        job = Job(member, priority, name, values, timeout, self.time(), make)
        future = job.result
        if trace.is_active():
            future.add_done_callback(partial(_trace, job))
        if self.loss is not None:
            self._fail(job, LinkError(self.loss))
            return future
        if self.current is None and not (self._queue.jobs or self._is_pumping):
            self._start(job)
            return future
        for queued in [*self._queue.jobs]:
            if queued.is_superseded_by(priority, member):
                self._fail(queued, Preempted(SUPERSEDED))
        self._queue.add(job)
        if self.current is not None:
            self._preempt(self.current)
        self.pump()
        return future

    def commit_arrives(self) -> float:
        """Return by when [s] a commit arrives that is sent next.

        As late as replies have come, by three frames of USB at the most. One that is lost is not
        waited for: it is repeated 30 ms later.
        """
        begins = max(self.time(), self._free_at, self._sent_until)
        late = min(self.late, _MAX_COMMIT_LATE) + _SENDING
        return begins + self._commit_takes + late

    def received(self, data: bytes) -> None:
        """Take bytes from the port."""
        arrivals = self.wire.received(data)
        if trace.is_active():
            trace.frame(Direction.IN, data, self.name, lambda: ", ".join(map(repr, arrivals)))
        for arrival in arrivals:
            if isinstance(arrival, Event | OtherHost | DuplicateAddress):
                if self.seen is not None:
                    self.seen("event", arrival.address, type(arrival).__name__, arrival)
                if (unasked := self.members.get(arrival.address)) is not None:
                    unasked.note_unasked(arrival)
                continue
            job = self.current
            if job is None or (member := job.member) is None:  # no broadcast is on the line
                continue
            self._sent_until = 0.0  # what is replied to has arrived
            if isinstance(arrival, Continuation):
                self.late = max(self.late, min(self.time() - self._free_at, MAX_LATE))
                if self._queue.jobs and self._must_yield(job):
                    self._not_answered(job)
                else:
                    self._start(job, arrival.data, is_present=arrival.is_present)
                continue
            self.current = member.silence_cause = None
            if isinstance(arrival, WrittenPart):
                self._go_on(job)
                continue
            late = self.time() - job.started_at - job.takes
            self.late = min(max(late, self.late * _LATE_DECAY), MAX_LATE)
            if self.seen is not None:
                self.seen("in", member.address, type(arrival).__name__, arrival)
            if not isinstance(arrival, Reply):
                self._refused(job, member, arrival)
                continue
            self._boots_until = -math.inf
            try:
                member.note_reply(job.name, job.values, arrival.values, job.sent_at)
            except Exception as error:  # whatever it is, no caller may wait for ever
                self._fail(job, error)
                continue
            if job.result.done():  # its caller has gone
                continue
            if len(job.parts) > 1 and job.is_missing(arrival.values):
                if job.attempts > 0:
                    self._repeat(job, member)
                else:
                    self.wire.counters.remark = f"part {job.part} of a set does not arrive"
                    self._give_up(job, member)
            else:
                job.result.set_result(arrival.values)
        if self._queue.jobs:
            self.pump()
        elif self.current is None and self._timer is not None:
            self._timer.cancel()  # nothing is awaited: it would wake the process for nothing
            self._timer = None

    def lose(self, cause: str) -> None:
        """Fail every request: the port is lost, or closed."""
        self.loss = cause
        current, self.current = self.current, None
        for job in (*([] if current is None else [current]), *self._queue.jobs):
            self._fail(job, LinkError(cause))
        if self._timer is not None:
            self._timer.cancel()

    def pump(self) -> None:
        """Put the next request on the line, if it is free."""
        if self._is_pumping:
            return
        self._is_pumping = True
        try:
            while self.loss is None and self.current is None and self._queue.jobs:
                job = self._queue.next(self.time())
                if job is None:
                    break
                self._queue.take(job, self.time())
                if job.result.done():
                    self._fail(job, Preempted(SUPERSEDED))  # its caller has gone: so have others
                else:
                    self._start(job)
        finally:
            self._is_pumping = False

    def _start(self, job: Job, rest: bytes = b"", *, is_present: bool = False) -> None:
        """Make a request in its turn and send it, noted for all that it reaches: no other way.

        rest: of the request that is on the line already. is_present: its reply is made by that.
        """
        member, data = job.member, rest
        address = BROADCAST if member is None else member.address
        try:
            if not rest:
                if self.ahead is not None and member is not None and not job.part:
                    ahead = self.ahead(job.name, job.priority)
                    if ahead is not None:
                        beat = Priority.HEARTBEAT
                        self._start(Job(None, beat, "Commit", {}, 0.0, self.time(), ahead))
                if job.attempts == ATTEMPTS:
                    self.wire.counters.remark = ""
                if job.make is not None:
                    job.parts, job.make = job.make(), None
                    job.values = job.parts[0]
                if member is not None:
                    job.takes = member.next_request(job.name, job.values, job.priority)
                if self.seen is not None:
                    self.seen("out", address, job.name, job.values)
                has_reply = member is not None and job.part >= len(job.parts) - 1
                data = self.wire.request(address, job.name, job.values, has_reply=has_reply)
            now = self.time()
            begins = max(now, self._sent_until)  # behind what is still on its way
            if not rest:
                job.sent_at, job.started_at, job.due = now, begins, 0.0
                for each in self.members.values():
                    if address in (BROADCAST, each.address):
                        each.note_sent(job.name, job.values, now, begins + self.wire.takes)
            elif is_present and member is not None:
                member.note_sent(job.name, job.values, now, begins + self.wire.takes)
            if trace.is_active():
                what = job.name if member is None else f"{job.name} to {address}"
                trace.frame(Direction.OUT, data, self.name, lambda: what)
            self._sent_until, self._free_at = begins + self.wire.takes, begins + self.wire.busy
            try:
                self._port.write(data)
            except LinkTimeout as error:  # it takes nothing: the amplifier counts as degraded
                if member is not None:
                    member.silence_cause = str(error)
                raise
            if self.loss is not None:  # by what the port did
                raise LinkError(self.loss)
        except Exception as error:  # no caller may wait for ever
            self.current = None
            self.wire.withdraw()
            self._fail(job, error)
            return
        if member is None:
            job.result.set_result({})
            return
        if not rest:
            # A slow wire: as long as on others until it counts as degraded. But each of several
            # parts is lost as easily: heartbeats, which go between them, find one that is mute.
            is_cut = job.takes > FAST and job.attempts == ATTEMPTS and len(job.parts) < 2
            job.attempts -= 2 if is_cut else 1
        # Each of the two responses on Modbus may begin late.
        late = self.late if self.late > GRACE else 0.0
        longer = job.takes - FAST if job.takes > FAST else 0.0
        job.due = max(job.due, begins + longer + job.timeout + late)
        job.delays, job.is_last_look = 0, False
        self.current = job
        if job.part < len(job.parts) - 1 and not self.wire.confirms_parts:  # often: without a call
            self._send_further(job)
        elif self._timer is None:
            self._timer = self._loop.call_at(min(job.due, now + _LOOK_INTERVAL), self._look)

    def _send_further(self, job: Job) -> None:
        """Send the next part of a set once what is under way has nearly arrived, or give way."""
        now = self.time()
        due = max(self._sent_until - _AHEAD, now + _FULL_PAUSE * self._port.is_blocked)
        if due <= now or (self._queue.jobs and self._queue.has_before(job, now)):
            self._go_on(job)
        else:
            self._look_by(due)

    def _go_on(self, job: Job) -> None:
        """Go on with the next part of a set, unless a request that waits comes before it."""
        self.current = None
        job.attempts += 1  # this part has not been awaited in vain
        job.part, job.values = job.part + 1, job.parts[job.part + 1]
        if self.wire.confirms_parts:
            job.reach(job.part)
        if self._queue.jobs and self._queue.has_before(job, self.time()):
            self._queue_again(job)
        else:
            self._start(job)

    def _must_yield(self, job: Job) -> bool:
        """Whether a request gives way to one that silences."""
        return not job.is_stop_class and any(other.is_stop_class for other in self._queue.jobs)

    def _refused(self, job: Job, member: Member, arrival: Nak | BrokenReply) -> None:
        """End the request that was on the line with an error, or repeat it to a busy amplifier."""
        if isinstance(arrival, BrokenReply):
            self._fail(job, FrameError(f"{self.name}: {arrival.reason}"))
            return
        member.counts.refusals += 1
        if arrival.code == "BUSY" and job.attempts > 0:
            self._repeat(job, member, pause=BUSY_PAUSE)
        else:
            self._fail(job, refused_by_amplifier(self.name, arrival, may_play=job.had_no_reply))

    def _queue_again(self, job: Job) -> bool:
        """Queue a request again, unless another one of its amplifier comes before it."""
        if any(job.is_superseded_by(other.priority, other.member) for other in self._queue.jobs):
            self._fail(job, Preempted(SUPERSEDED))
            return False
        # Behind those of its priority, so that a mute amplifier does not keep others waiting.
        self._queue.add(job)
        return True

    def _repeat(self, job: Job, member: Member, *, pause: float = 0.0) -> None:
        """Send a request once more in its turn, after a pause [s]."""
        if self._queue_again(job):
            member.counts.retries += 1
            if pause:
                job.is_pausing = True
                self._loop.call_later(pause, self._resume, job)

    def _resume(self, job: Job) -> None:
        """Send a request that has paused in its turn."""
        job.is_pausing = False
        self.pump()

    def _fail(self, job: Job, error: Exception) -> None:
        """End a request with an error, unless its caller has gone."""
        self._queue.remove(job)
        if not job.result.done():
            job.result.set_exception(error)
            job.result.exception()  # retrieved, where nobody waits for it

    def _preempt(self, current: Job) -> None:
        """Shorten the time of the request on the line for one that must not wait."""
        if current.is_stop_class:
            return
        if current.has_further_parts and not self.wire.confirms_parts:  # no reply is due
            self._send_further(current)
            return
        waiting = [job.priority for job in self._queue.jobs if job.priority < current.priority]
        first, is_reading = min(waiting, default=8), current.priority is Priority.READING
        free_at = max(self.time(), self._free_at)
        if first <= Priority.SILENCE:
            current.due = min(current.due, free_at + (0.0 if is_reading else GRACE))
        # Where replies come late one that is cut short would never end.
        elif is_reading and first <= Priority.SET and self.late <= GRACE:
            begins_by = max(current.started_at + current.takes, self._free_at) + REACTION
            current.due = min(current.due, max(self.time(), begins_by))  # none begins from then on
        self._look_by(current.due)

    def _look_by(self, due: float) -> None:
        """Look at the request on the line at a time [s], or before."""
        if self._timer is None or self._timer.when() > due:
            if self._timer is not None:
                self._timer.cancel()
            self._timer = self._loop.call_at(due, self._look)

    def _look(self) -> None:
        """Give up the request on the line if it is due, once the port was read once more.

        By what the timer is late this process was delayed, and the reply has as much time left as
        it had then.
        """
        timer, self._timer = self._timer, None
        job, now = self.current, self.time()
        if job is None or timer is None:
            return
        since = max(timer.when(), job.sent_at)
        if now - since > _LATE and job.delays < _DELAYS:
            job.delays += 1
            left = 0.0 if self._must_yield(job) else job.due - since
            job.due = now + max(left, _LATE)
        if now < job.due and job.has_further_parts and not self.wire.confirms_parts:
            self._send_further(job)
            self.pump()
            return
        if now >= job.due:
            self._port.poll()
            if self.current is job and self.time() >= job.due:
                if job.is_last_look:
                    self._not_answered(job)
                    self.pump()
                    return
                job.due, job.is_last_look = now, True
        if self.current is not None and self._timer is None:
            due = min(self.current.due, self.time() + _LOOK_INTERVAL)
            self._timer = self._loop.call_at(due, self._look)

    def _not_answered(self, job: Job) -> None:
        """Take the request off the line, and repeat it or give it up."""
        self.current = None
        self.wire.withdraw()
        member = job.member
        if member is None:
            return
        if self.seen is not None:
            self.seen("none", member.address, "no reply", "")
        was_cut = job.priority is Priority.READING and job.due < job.sent_at + job.timeout
        if was_cut or self._must_yield(job):
            job.attempts += 1
            self._repeat(job, member)
            return
        job.had_no_reply = True
        member.counts.timeouts += 1
        is_first = job.name == "Hello" and self._boots_until > -math.inf
        if job.attempts > 0 or (is_first and self.time() < self._boots_until):
            self._repeat(job, member)
            return
        self._give_up(job, member, boot_time=self._boot_time if is_first else 0.0)

    def _give_up(self, job: Job, member: Member, *, boot_time: float = 0.0) -> None:
        """End a request that has had no reply, or whose parts do not arrive."""
        remark = self.wire.blocked if self._port.is_blocked else self.wire.counters.remark
        member.silence_cause = no_reply(
            self.name,
            job.name,
            job.timeout,
            remark,
            before=member.counts.last_round_trip or 0.0,
            boot_time=boot_time,
        )
        self._fail(job, LinkTimeout(member.silence_cause))


def _trace(job: Job, result: "asyncio.Future[Values]") -> None:
    """Trace a request with its reply or error, and how long it took since it was queued."""
    outcome: object = "cancelled"
    if not result.cancelled():
        outcome = result.exception() or result.result()
    took = result.get_loop().time() - job.queued_at
    trace.request(f"{job.name}({job.values})", outcome, took)
