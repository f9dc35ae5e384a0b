"""One physical line: the requests of all amplifiers on it, one at a time, by priority.

`Line.pump` is called with each submission, arrival and timer; no request has a task of its own. The
values of a request are made when its turn comes, so that they are checked once, against the
requests really sent before. The parts of a set are sent without a pause; only the last part has a
reply, and only that part is repeated. Stop-class requests preempt and supersede all others. Times
[s] refer to the event loop's clock.
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
)
from drivers.ports import OpenPort
from drivers.protocol.definition import (
    ATTEMPTS,
    BROADCAST,
    FAST,
    MESSAGES,
    REACTION,
    REPLY_TIMEOUT,
)
from drivers.protocol.records import Values
from drivers.trace import Direction
from drivers.wires.wire import (
    Arrival,
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
    "WRONG_SESSION": "; another host has armed it, or armed it last: disarm, then arm again",
    "WRONG_STATE": "; find the cause with `era amp status`, then clear and arm again",
}


def refused_by_amplifier(where: str, refusal: Nak, *, may_play: bool) -> CommandRefused:
    """Return the error of a request that an amplifier refused; may_play: see `CommandRefused`.

    where: the line and the amplifier, as the message begins.
    """
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
    """Return why the request with this name had no reply within a timeout [s].

    where: the line, as the message begins. remark: what arrived instead. before: how long the
    previous reply took [s]. boot_time: how long a board may take to boot [s] if its port was
    opened just now, else 0.
    """
    if not remark and before > timeout:
        remark = f"the previous reply took {1e3 * before:.0f} ms: find the cause of the delay"
    hint = "check that the amplifier is switched on"
    if name == "GetCaps":  # sent after a reply to Hello
        hint = "it answered Hello, but not GetCaps"
    came = f", but {remark}" if remark else f"; {hint}"
    cause = f"{where}: no reply within {1e3 * timeout:g} ms{came}"
    if boot_time:
        cause += (
            f". A board that restarts when its port is opened must reply within {boot_time:g} s; "
            "if it takes longer, disable the restart"
        )
    return cause


MAX_WAIT = 0.05  # s; a request that has waited for longer is sent before newer sets and heartbeats


class Priority(IntEnum):
    """Priority of a request: the smallest is sent first."""

    STOP = 0
    SILENCE = 1
    HEARTBEAT = 2
    SET = 3
    ARM = 4
    CLEAR = 5
    OTHER = 6
    READING = 7


_NONE_WAITING = max(Priority) + 1
"""In place of a priority, if no request waits: less urgent than all priorities."""

_SUPERSEDED = {
    # A queued heartbeat would feed the watchdog of an amplifier that did not receive the stop.
    Priority.STOP: (Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR),
    Priority.SILENCE: (Priority.SET, Priority.ARM),
}

Make: TypeAlias = Callable[[], list[Values]]
"""A function that makes a request when its turn comes.

It is called once, and returns the values of each message of the request or raises CommandRefused.
"""


@dataclass
class LinkStatistics(WireCounters):
    """Statistics of a link at one moment.

    The inherited counters restart when the link is opened; those below never do.
    """

    retries: int = 0
    """Number of requests that were repeated."""
    timeouts: int = 0
    """Number of requests that had no reply in time."""
    refusals: int = 0
    """Number of requests that the amplifier refused by a Nak."""
    last_round_trip: float | None = None
    """Time from the last request with a reply to that reply [s]."""


class Member(Protocol):
    """Interface of an amplifier to its line: records requests and replies."""

    name: str
    address: int
    counts: LinkStatistics
    no_reply_cause: str | None
    """Why the amplifier counts as mute, after a request without reply; None if it replies."""

    def request_time(self, name: str, values: Values) -> float:
        """Return how long a request and its reply take on the wire [s]."""

    def check_may_send(self, name: str, values: Values, priority: Priority) -> None:
        """Raise DriverError if a request must not be sent."""

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and reaches the amplifier at a time [s]."""

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s]."""

    def note_unasked(self, arrival: Event | OtherHost | DuplicateAddress) -> None:
        """Note a message that the amplifier sent without a request."""


@dataclass(eq=False, slots=True)
class Job:
    """A request, from the time when it is queued to its result."""

    member: Member | None
    """The amplifier that it is for; None for a broadcast."""
    priority: Priority
    name: str
    values: Values
    """Values of the message that is on the line, or is sent next."""
    timeout: float
    """How long its reply is awaited on a fast wire [s]."""
    queued_at: float
    make: Make | None = None
    """Makes the messages; None once it has been called."""
    result: "asyncio.Future[Values]" = field(default_factory=asyncio.Future)
    parts: Sequence[Values] = ()
    """The messages that were made; only the last has a reply."""
    part: int = 0
    """Index of the part that is on the line, or is sent next."""
    reached: int = 0
    """Index of the first part that was missing when the last reply came."""
    attempts: int = ATTEMPTS
    """Remaining number of attempts."""
    is_pausing: bool = False
    sent_at: float = 0.0
    """Time of the last transfer to the port [s]."""
    started_at: float = 0.0
    """Time [s] of its first bit on the wire at the last attempt, after earlier requests."""
    due: float = 0.0
    """Deadline of the reply [s]."""
    takes: float = 0.0
    """Duration of request and reply on the wire [s]."""
    delays: int = 0
    """How often this process was delayed while the reply was awaited."""
    is_last_look: bool = False
    """Whether the port was read once more after it had become due."""
    had_no_reply: bool = False
    """Whether an earlier attempt had no reply."""

    @property
    def has_further_parts(self) -> bool:
        """Whether parts follow the one on the line, which then has no reply."""
        return self.part < len(self.parts) - 1

    def reach(self, part: int) -> None:
        """Note that all parts before this one have arrived; any progress restores all attempts."""
        if part > self.reached:
            self.reached = part
            self.attempts = ATTEMPTS

    def go_back_to_missing(self, reply: Values) -> bool:
        """Go back to the first part that a reply reports as missing; return False without one."""
        missing = reply["missing"]
        if reply["staged"] or reply["played"] or missing >= self.part:
            return False
        self.part = missing
        self.values = self.parts[missing]
        self.reach(missing)
        return True

    @property
    def is_stop_class(self) -> bool:
        """Whether it silences the amplifier, and so is sent and repeated before all others."""
        return self.priority <= Priority.SILENCE

    def has_waited(self, now: float) -> bool:
        """Whether it has waited for so long that it is as urgent as a heartbeat; now [s]."""
        is_minor = Priority.HEARTBEAT < self.priority < Priority.READING
        return is_minor and now - self.queued_at > MAX_WAIT

    def is_superseded_by(self, priority: Priority, member: Member | None) -> bool:
        """Whether a request with a priority makes it obsolete; member: None for a broadcast."""
        return self.priority in _SUPERSEDED.get(priority, ()) and member in (self.member, None)


class JobQueue(list[Job]):
    """The requests waiting for a line, in the order of queueing.

    Requests of equal rank are sent in this order.
    """

    _had_waited = False  # whether the last job taken had waited for long

    def take(self, job: Job, now: float) -> None:
        """Remove the job whose turn it is."""
        self.remove(job)
        self._had_waited = job.has_waited(now)

    def _rank(self, job: Job, now: float) -> tuple[int, int]:
        """Return the rank of a job; now [s].

        One job that has waited for long goes before the heartbeats, the next one after them.
        """
        if job.has_waited(now):
            return Priority.HEARTBEAT, 2 if self._had_waited else 1
        is_reading = job.priority is Priority.READING
        return job.priority if is_reading else min(job.priority, Priority.ARM), 1

    def has_before(self, job: Job, now: float) -> bool:
        """Whether any waiting job goes before this one; now [s]."""
        first = self.next(now) if self else None
        return first is not None and self._rank(first, now) < self._rank(job, now)

    def next(self, now: float) -> Job | None:
        """Return the next job, or None while all jobs, or a stop, are pausing."""
        first: Job | None = self[0]
        if len(self) > 1:
            ready = [job for job in self if job.is_stop_class or not job.is_pausing]
            first = min(ready, key=lambda job: self._rank(job, now), default=None)
        return None if first is None or first.is_pausing else first


GRACE = 0.008  # s; how long a stop waits for the reply to another request
BUSY_PAUSE = 0.005  # s; before a request is repeated to a busy amplifier
_AHEAD = 0.005  # s; lead for writing the next part of a set; a stop waits for bytes already sent
_FULL_PAUSE = 0.0005  # s; before checking a blocked port again
_LOOK_INTERVAL = 0.01  # s; between checks; each check would detect a delay of this process
_LATE = 0.005  # s; if a timer fires later than this, this process was delayed
_MAX_LATE = 0.032
"""Maximum extra time [s] to await a reply after late replies.

An adapter can delay data by 16 ms in each direction.
"""
_LATE_DECAY = 0.9  # of the lateness of replies, with each reply
_MAX_COMMIT_LATE = 0.003  # s; one frame of full-speed USB, 1 ms, for each of port, hub and adapter
_SENDING = 0.0005  # s; this process needs it to write to all lines
_DELAYS = 4  # delays of this process that prolong the wait for one reply
SUPERSEDED = "superseded by a newer set, or by a stop or disarm"


class Line:
    """One physical line: its port calls `received` with what arrives, and `lose` when it is lost.

    boot_time: how long Hello is repeated after the port was opened [s], until an amplifier has
    replied: a board may restart when its port is opened.
    """

    def __init__(self, wire: Wire, name: str, *, boot_time: float = 0.0) -> None:
        self.wire = wire
        self.name = name
        self.loss: str | None = None
        self.members: dict[int, Member] = {}
        self.ahead: Callable[[str, Priority], Make | None] | None = None
        """Called before each request to one amplifier.

        It returns the commit that is broadcast on the line first, or None.
        """
        self._port: OpenPort
        """The open port; set by `open`."""
        self._commit_takes: float
        """Duration of a commit on the wire [s]; set by `open`."""
        self._queue = JobQueue()
        self.current: Job | None = None
        """The request on the line; None if the line is free."""
        self._timer: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self.time = self._loop.time
        """The clock of the line [s]."""
        self._boot_time = boot_time
        self._boots_until = -math.inf
        """Until when Hello is repeated [s]; -infinite once an amplifier has replied."""
        self._is_pumping = False
        """Whether `pump` is running, which must not call itself."""
        self._sent_until = 0.0
        """Until when sent bytes are still under way [s]."""
        self._free_at = 0.0
        """Until when a reply may still occupy the line [s]."""
        self.late = 0.0
        """Delay of replies [s] beyond the time on the wire, at most `_MAX_LATE`."""

    def open(self, port: OpenPort) -> None:
        """Use this open port from now on."""
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
        """Queue a request to an amplifier; returns a future of the values of its reply.

        The future raises LinkError, LinkTimeout, FrameError, CommandRefused, or Preempted if a
        request with a higher priority made this one obsolete. member: None for a broadcast, which
        has no reply; its future ends once it was sent.
        """
        job = Job(member, priority, name, {}, timeout, self.time())
        if callable(values):
            job.make = values
        else:
            job.values = values
        future = job.result
        if trace.is_active():
            future.add_done_callback(partial(_trace, job))
        if self.loss is not None:
            self._fail(job, LinkError(self.loss))
            return future
        if self.current is None and not (self._queue or self._is_pumping):
            self._start(job)
            return future
        for queued in [*self._queue]:
            if queued.is_superseded_by(priority, member):
                self._fail(queued, Preempted(SUPERSEDED))
        self._queue.append(job)
        if self.current is not None:
            self._preempt(self.current)
        self.pump()
        return future

    def commit_arrives(self) -> float:
        """Return when a commit arrives at the latest [s] if it is sent next.

        It may be as late as replies have been, but by three frames of USB at the most. The time of
        a repetition is not included: a lost commit is repeated 30 ms later.
        """
        begins = max(self.time(), self._free_at, self._sent_until)
        late = min(self.late, _MAX_COMMIT_LATE) + _SENDING
        return begins + self._commit_takes + late

    def received(self, data: bytes) -> None:
        """Process bytes that the port has received."""
        arrivals = self.wire.received(data)
        if trace.is_active():
            trace.frame(Direction.IN, data, self.name, lambda: ", ".join(map(repr, arrivals)))
        for arrival in arrivals:
            self._process(arrival)
        if self._queue:
            self.pump()
        elif self.current is None and self._timer is not None:
            self._timer.cancel()  # no reply is due
            self._timer = None

    def _process(self, arrival: Arrival) -> None:
        """Process a message, or another result of received bytes."""
        if isinstance(arrival, Event | OtherHost | DuplicateAddress):
            sender = self.members.get(arrival.address)
            if sender is not None:
                sender.note_unasked(arrival)
            return
        job = self.current
        if job is None or job.member is None:  # no broadcast is on the line
            return
        member = job.member
        self._sent_until = 0.0  # a request with a reply has arrived
        if isinstance(arrival, Continuation):
            self.late = max(self.late, min(self.time() - self._free_at, _MAX_LATE))
            if self._queue and self._must_yield(job):
                self._not_answered(job)
            else:
                self._continue(job, arrival.data, is_present=arrival.is_present)
            return
        self.current = None
        member.no_reply_cause = None
        if isinstance(arrival, WrittenPart):
            self._go_on(job)
            return
        late = self.time() - job.started_at - job.takes
        self.late = min(max(late, self.late * _LATE_DECAY), _MAX_LATE)
        if isinstance(arrival, Reply):
            self._boots_until = -math.inf
            self._replied(job, member, arrival.values)
        else:
            self._refused(job, member, arrival)

    def _replied(self, job: Job, member: Member, reply: Values) -> None:
        """End a request with its reply, or repeat the part of a set that the reply misses."""
        try:
            member.note_reply(job.name, job.values, reply, job.sent_at)
        except Exception as error:  # every caller must get a result, after any failure
            self._fail(job, error)
            return
        if job.result.done():  # its caller was cancelled
            return
        if len(job.parts) < 2 or not job.go_back_to_missing(reply):
            job.result.set_result(reply)
        elif job.attempts > 0:
            self._repeat(job, member)
        else:
            self.wire.counters.remark = f"part {job.part} of a set does not arrive"
            self._give_up(job, member)

    def lose(self, cause: str) -> None:
        """Fail every request: the port is lost, or closed."""
        self.loss = cause
        jobs = [*self._queue]
        if self.current is not None:
            jobs.insert(0, self.current)
        self.current = None
        for job in jobs:
            self._fail(job, LinkError(cause))
        if self._timer is not None:
            self._timer.cancel()

    def pump(self) -> None:
        """Send the next request if the line is free."""
        if self._is_pumping:
            return
        self._is_pumping = True
        try:
            while self.loss is None and self.current is None and self._queue:
                job = self._queue.next(self.time())
                if job is None:
                    break
                self._queue.take(job, self.time())
                if job.result.done():
                    self._fail(job, Preempted(SUPERSEDED))  # its caller was cancelled
                else:
                    self._start(job)
        finally:
            self._is_pumping = False

    def _start(self, job: Job) -> None:
        """Make and send a request, and record it for each amplifier that receives it.

        Requests are sent here, and the rest of a request in `_continue`; nothing else sends.
        """
        member = job.member
        try:
            self._send_ahead(job)
            self._make(job)
            data = self._encoded(job)
            now = self.time()
            begins = max(now, self._sent_until)  # after bytes still under way
            job.sent_at = now
            job.started_at = begins
            job.due = 0.0
            address = _address_of(member)
            for receiver in self.members.values():
                if address in (BROADCAST, receiver.address):
                    receiver.note_sent(job.name, job.values, now, begins + self.wire.takes)
            self._write(job, data, begins)
        except Exception as error:  # every caller must get a result, after any failure
            self._fail_sending(job, error)
            return
        if member is None:
            job.result.set_result({})
            return
        # On a slow wire there is one attempt less, so that an amplifier counts as degraded as soon
        # as on other wires. A set of several parts keeps its attempts, because each part can be
        # lost; heartbeats between the parts detect a mute amplifier.
        is_cut = job.takes > FAST and job.attempts == ATTEMPTS and len(job.parts) < 2
        job.attempts -= 2 if is_cut else 1
        self._await_reply(job, now, begins)

    def _continue(self, job: Job, rest: bytes, *, is_present: bool) -> None:
        """Send unsent bytes of the current request.

        is_present: whether these bytes complete the request for the amplifier.
        """
        member = job.member
        try:
            now = self.time()
            begins = max(now, self._sent_until)
            if is_present and member is not None:
                member.note_sent(job.name, job.values, now, begins + self.wire.takes)
            self._write(job, rest, begins)
        except Exception as error:  # every caller must get a result, after any failure
            self._fail_sending(job, error)
            return
        self._await_reply(job, now, begins)

    def _send_ahead(self, job: Job) -> None:
        """Send the commit that is broadcast before a request to one amplifier, if there is one."""
        if self.ahead is None or job.member is None or job.part:
            return
        make_commit = self.ahead(job.name, job.priority)
        if make_commit is not None:
            now = self.time()
            self._start(Job(None, Priority.HEARTBEAT, "Commit", {}, 0.0, now, make_commit))

    def _make(self, job: Job) -> None:
        """Make the messages of a request at its first turn, and check the one to be sent next."""
        if job.attempts == ATTEMPTS:
            self.wire.counters.remark = ""
        if job.make is not None:
            job.parts = job.make()
            job.make = None
            job.values = job.parts[0]
        if job.member is not None:
            job.member.check_may_send(job.name, job.values, job.priority)
            job.takes = job.member.request_time(job.name, job.values)

    def _encoded(self, job: Job) -> bytes:
        """Return the bytes of the message of a request that is sent next."""
        member = job.member
        has_reply = member is not None and job.part >= len(job.parts) - 1
        return self.wire.request(_address_of(member), job.name, job.values, has_reply=has_reply)

    def _write(self, job: Job, data: bytes, begins: float) -> None:
        """Write bytes to the port; begins: when the first bit is on the wire [s]."""
        member = job.member
        if trace.is_active():
            request = job.name if member is None else f"{job.name} to {member.address}"
            trace.frame(Direction.OUT, data, self.name, lambda: request)
        self._sent_until = begins + self.wire.takes
        self._free_at = begins + self.wire.busy
        try:
            self._port.write(data)
        except LinkTimeout as error:  # the port accepts nothing: the amplifier is degraded
            if member is not None:
                member.no_reply_cause = str(error)
            raise
        if self.loss is not None:  # the port was lost while it was written
            raise LinkError(self.loss)

    def _fail_sending(self, job: Job, error: Exception) -> None:
        """End a request that could not be made or sent."""
        self.current = None
        self.wire.withdraw()
        self._fail(job, error)

    def _await_reply(self, job: Job, now: float, begins: float) -> None:
        """Await the reply to a request whose first bit is on the wire at a time [s].

        If further parts of a set follow, send the next part instead.
        """
        # On Modbus each of the two responses may begin late.
        late = self.late if self.late > GRACE else 0.0
        slowness = max(job.takes - FAST, 0.0)
        job.due = max(job.due, begins + slowness + job.timeout + late)
        job.delays = 0
        job.is_last_look = False
        self.current = job
        # This is `has_further_parts`, written out because it runs with every message.
        if job.part < len(job.parts) - 1 and not self.wire.confirms_parts:
            self._send_further(job)
        elif self._timer is None:
            self._timer = self._loop.call_at(min(job.due, now + _LOOK_INTERVAL), self._look)

    def _send_further(self, job: Job) -> None:
        """Send the next part of a set once the last one has nearly arrived."""
        now = self.time()
        due = max(self._sent_until - _AHEAD, now + _FULL_PAUSE * self._port.is_blocked)
        if due <= now or (self._queue and self._queue.has_before(job, now)):
            self._go_on(job)
        else:
            self._look_by(due)

    def _go_on(self, job: Job) -> None:
        """Send the next part of a set, unless a waiting request goes before it."""
        self.current = None
        job.attempts += 1  # the attempt for this part did not fail
        job.part += 1
        job.values = job.parts[job.part]
        if self.wire.confirms_parts:
            job.reach(job.part)
        if self._queue and self._queue.has_before(job, self.time()):
            self._queue_again(job)
        else:
            self._start(job)

    def _must_yield(self, job: Job) -> bool:
        """Whether a request must yield to a request that silences."""
        return not job.is_stop_class and any(queued.is_stop_class for queued in self._queue)

    def _refused(self, job: Job, member: Member, arrival: Nak | BrokenReply) -> None:
        """Repeat a request that a busy amplifier refused; fail any other one."""
        if isinstance(arrival, BrokenReply):
            self._fail(job, FrameError(f"{self.name}: {arrival.reason}"))
            return
        member.counts.refusals += 1
        if arrival.code == "BUSY" and job.attempts > 0:
            self._repeat(job, member, pause=BUSY_PAUSE)
        else:
            self._fail(job, refused_by_amplifier(self.name, arrival, may_play=job.had_no_reply))

    def _queue_again(self, job: Job) -> bool:
        """Queue a request again, and return True, unless a waiting request makes it obsolete."""
        for queued in self._queue:
            if job.is_superseded_by(queued.priority, queued.member):
                self._fail(job, Preempted(SUPERSEDED))
                return False
        # Last within its priority, so that a mute amplifier does not delay others.
        self._queue.append(job)
        return True

    def _repeat(self, job: Job, member: Member, *, pause: float = 0.0) -> None:
        """Queue a request again, to be sent in its turn after a pause [s]."""
        if self._queue_again(job):
            member.counts.retries += 1
            if pause:
                job.is_pausing = True
                self._loop.call_later(pause, self._resume, job)

    def _resume(self, job: Job) -> None:
        """End the pause of a request."""
        job.is_pausing = False
        self.pump()

    def _fail(self, job: Job, error: Exception) -> None:
        """End a request with an error, unless its caller was cancelled."""
        if job in self._queue:
            self._queue.remove(job)
        if not job.result.done():
            job.result.set_exception(error)
            job.result.exception()  # so that asyncio does not report it as never retrieved

    def _preempt(self, current: Job) -> None:
        """Shorten the wait for the current reply where a more urgent request is waiting."""
        if current.is_stop_class:
            return
        if current.has_further_parts and not self.wire.confirms_parts:  # no reply is due
            self._send_further(current)
            return
        waiting = [job.priority for job in self._queue if job.priority < current.priority]
        first = min(waiting, default=_NONE_WAITING)
        is_reading = current.priority is Priority.READING
        free_at = max(self.time(), self._free_at)
        if first <= Priority.SILENCE:
            current.due = min(current.due, free_at + (0.0 if is_reading else GRACE))
        # Where replies come late, a reading that is cut short each time would never end.
        elif is_reading and first <= Priority.SET and self.late <= GRACE:
            begins_by = max(current.started_at + current.takes, self._free_at) + REACTION
            current.due = min(current.due, max(self.time(), begins_by))  # no reply begins later
        self._look_by(current.due)

    def _look_by(self, due: float) -> None:
        """Look at the current request at a time [s] or earlier."""
        if self._timer is None or self._timer.when() > due:
            if self._timer is not None:
                self._timer.cancel()
            self._timer = self._loop.call_at(due, self._look)

    def _look(self) -> None:
        """Give up the current request if it is due and a last reading of the port brings no reply.

        If the timer fires late, this process was delayed by as much; the reply then keeps the time
        that it had left when the delay began.
        """
        timer = self._timer
        self._timer = None
        job = self.current
        now = self.time()
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
                job.due = now
                job.is_last_look = True
        if self.current is not None and self._timer is None:
            due = min(self.current.due, self.time() + _LOOK_INTERVAL)
            self._timer = self._loop.call_at(due, self._look)

    def _not_answered(self, job: Job) -> None:
        """Repeat the current request, which had no reply in time, or give it up."""
        self.current = None
        self.wire.withdraw()
        member = job.member
        if member is None:
            return
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
        """Fail a request that had no reply, or whose parts do not arrive."""
        remark = self.wire.blocked if self._port.is_blocked else self.wire.counters.remark
        member.no_reply_cause = no_reply(
            self.name,
            job.name,
            job.timeout,
            remark,
            before=member.counts.last_round_trip or 0.0,
            boot_time=boot_time,
        )
        self._fail(job, LinkTimeout(member.no_reply_cause))


def _address_of(member: Member | None) -> int:
    return BROADCAST if member is None else member.address


def _trace(job: Job, result: "asyncio.Future[Values]") -> None:
    """Trace a request with its reply or error, and the time since it was queued."""
    outcome: object = "cancelled"
    if not result.cancelled():
        outcome = result.exception() or result.result()
    took = result.get_loop().time() - job.queued_at
    trace.request(f"{job.name}({job.values})", outcome, took)
