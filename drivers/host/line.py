"""One physical line: it carries the requests of all its amplifiers, one at a time.

`Line.submit` queues a request. Whenever the line is free, `Line.pump` sends the next one, which
`drivers.host.requests` chooses. No request has a task of its own. The values of a request are made
when its turn comes, so that they are checked once, against the requests really sent before.

An `Attempt` is the transmission of one message and the wait for its reply. It ends with a reply, at
its deadline, or earlier if a more urgent request waits. A request without a reply is repeated. The
parts of a set are sent without a pause; only the last part has a reply, and only missing parts are
repeated. On Modbus a message is a write and a read, and each part of a set is confirmed. Times [s]
refer to the event loop's clock.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from drivers import trace
from drivers.errors import (
    FrameError,
    LinkError,
    LinkTimeout,
    Preempted,
    no_reply,
    refused_by_amplifier,
)
from drivers.host.requests import Job, JobQueue, Make, Member, Priority, ReplyWait
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


@dataclass(eq=False, slots=True)
class Attempt:
    """The transmission of one message of a request, and the wait for its reply."""

    job: Job
    member: Member
    """The amplifier that it is for."""
    takes: float
    """Duration of request and reply on the wire [s]."""
    sent_at: float
    """When its first bytes were written to the port [s]."""
    started_at: float
    """When its first bit was on the wire [s], after earlier requests."""
    is_followed: bool
    """Whether the next part is sent without a reply to this message."""
    due: float = 0.0
    """Deadline of the reply [s]."""
    delays: int = 0
    """How often this process was delayed while the reply was awaited."""
    is_last_look: bool = False
    """Whether the port was read once more after the reply had become due."""


class Line:
    """One physical line: its port calls `received` with what arrives, and `lose` when it is lost.

    boot_time: how long Hello is repeated after the port was opened [s], until an amplifier has
    replied: a board may restart when its port is opened.
    """

    def __init__(self, wire: Wire, name: str, *, boot_time: float = 0.0) -> None:
        self.wire = wire
        self.name = name
        self.loss: str | None = None
        """Why the port is lost; None while it is open."""
        self.members: dict[int, Member] = {}
        """The amplifiers by address."""
        self.ahead: Callable[[str, Priority], Make | None] | None = None
        """Called before each request to one amplifier.

        It returns the commit that is broadcast on the line first, or None.
        """
        self._port: OpenPort
        """The open port; set by `open`."""
        self._commit_takes: float
        """Duration of a commit on the wire [s]; set by `open`."""
        self._queue = JobQueue()
        self._attempt: Attempt | None = None
        """The attempt whose reply is awaited; None if the line is free."""
        self._timer: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self.time = self._loop.time
        """The clock of the line [s]."""
        self._boot_time = boot_time
        self._boots_until = 0.0
        """Until when Hello is repeated [s] if no amplifier has replied."""
        self._has_replied = False
        """Whether an amplifier has replied since the port was opened."""
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
        self._has_replied = False

    @property
    def current(self) -> Job | None:
        """The request on the line; None if the line is free."""
        return None if self._attempt is None else self._attempt.job

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
        job = Job(member, priority, name, timeout, self.time())
        if callable(values):
            job.make = values
        else:
            job.parts = [values]
        future = job.result
        if trace.is_active():
            future.add_done_callback(partial(_trace, job))
        if self.loss is not None:
            self._fail(job, LinkError(self.loss))
            return future
        if self._attempt is None and not (self._queue or self._is_pumping):
            self._start(job)
            return future
        for obsolete in self._queue.superseded_by(priority, member):
            self._fail(obsolete, Preempted(SUPERSEDED))
        self._queue.append(job)
        if self._attempt is not None:
            self._shorten(self._attempt)
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
        elif self._attempt is None and self._timer is not None:
            self._timer.cancel()  # no reply is due
            self._timer = None

    def _process(self, arrival: Arrival) -> None:
        """Process a message, or another result of received bytes."""
        if isinstance(arrival, Event | OtherHost | DuplicateAddress):
            sender = self.members.get(arrival.address)
            if sender is not None:
                sender.note_unasked(arrival)
            return
        attempt = self._attempt
        if attempt is None:
            return
        self._sent_until = 0.0  # a request with a reply has arrived
        if isinstance(arrival, Continuation):
            self.late = max(self.late, min(self.time() - self._free_at, _MAX_LATE))
            if self._must_yield(attempt.job):
                self._end_without_reply(attempt)
            else:
                self._continue(attempt, arrival.data, is_present=arrival.is_present)
            return
        self._attempt = None
        attempt.member.no_reply_cause = None
        if isinstance(arrival, WrittenPart):
            self._go_on(attempt.job)
            return
        late = self.time() - attempt.started_at - attempt.takes
        self.late = min(max(late, self.late * _LATE_DECAY), _MAX_LATE)
        if isinstance(arrival, Reply):
            self._has_replied = True
            self._end_with_reply(attempt, arrival.values)
        else:
            self._end_refused(attempt, arrival)

    def _end_with_reply(self, attempt: Attempt, reply: Values) -> None:
        """End a request with its reply, or repeat the part of a set that the reply misses."""
        job = attempt.job
        member = attempt.member
        try:
            member.note_reply(job.name, job.values, reply, attempt.sent_at)
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
        if self._attempt is not None:
            jobs.insert(0, self._attempt.job)
        self._attempt = None
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
            while self.loss is None and self._attempt is None and self._queue:
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
        """Send a request and await its reply, or fail it if it cannot be sent."""
        try:
            self._send_ahead(job)
            attempt = self._send(job)
        except Exception as error:  # every caller must get a result, after any failure
            self._fail_sending(job, error)
            return
        if attempt is None:
            job.result.set_result({})
            return
        job.spend_attempt(attempt.takes)
        self._await_reply(attempt, attempt.sent_at, attempt.started_at)

    def _send_ahead(self, job: Job) -> None:
        """Send the commit that is broadcast before a request to one amplifier, if there is one."""
        if self.ahead is None or job.member is None or job.part:
            return
        make_commit = self.ahead(job.name, job.priority)
        if make_commit is not None:
            now = self.time()
            self._start(Job(None, Priority.HEARTBEAT, "Commit", 0.0, now, make=make_commit))

    def _send(self, job: Job) -> Attempt | None:
        """Send the next message of a request, and record it for each amplifier that receives it.

        Returns the attempt whose reply is awaited; None for a broadcast. Raises any error of the
        amplifier's checks, the wire and the port.
        """
        if job.attempts == ATTEMPTS:
            self.wire.counters.remark = ""
        job.make_parts()
        member = job.member
        takes = 0.0
        address = BROADCAST
        if member is not None:
            member.check_may_send(job.name, job.values, job.priority)
            takes = member.request_time(job.name, job.values)
            address = member.address
        has_reply = member is not None and not job.has_further_parts
        data = self.wire.request(address, job.name, job.values, has_reply=has_reply)
        now = self.time()
        begins = max(now, self._sent_until)  # after bytes still under way
        for receiver in self.members.values():
            if address in (BROADCAST, receiver.address):
                receiver.note_sent(job.name, job.values, now, begins + self.wire.takes)
        self._write(job, data, begins)
        if member is None:
            return None
        is_followed = job.has_further_parts and not self.wire.confirms_parts
        return Attempt(job, member, takes, now, begins, is_followed)

    def _continue(self, attempt: Attempt, data: bytes, *, is_present: bool) -> None:
        """Send the rest of a message, and await its reply.

        is_present: whether these bytes complete the request for the amplifier.
        """
        job = attempt.job
        try:
            now = self.time()
            begins = max(now, self._sent_until)
            if is_present:
                attempt.member.note_sent(job.name, job.values, now, begins + self.wire.takes)
            self._write(job, data, begins)
        except Exception as error:  # every caller must get a result, after any failure
            self._fail_sending(job, error)
            return
        self._await_reply(attempt, now, begins)

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
        self._attempt = None
        self.wire.withdraw()
        self._fail(job, error)

    def _await_reply(self, attempt: Attempt, now: float, begins: float) -> None:
        """Await the reply to bytes that were written now [s] and are on the wire from a time [s].

        If further parts of a set follow, send the next part instead.
        """
        # On Modbus each of the two responses may begin late.
        late = self.late if self.late > GRACE else 0.0
        slowness = max(attempt.takes - FAST, 0.0)
        attempt.due = max(attempt.due, begins + slowness + attempt.job.timeout + late)
        attempt.delays = 0
        attempt.is_last_look = False
        self._attempt = attempt
        if attempt.is_followed:
            self._send_further(attempt.job)
        elif self._timer is None:
            self._timer = self._loop.call_at(min(attempt.due, now + _LOOK_INTERVAL), self._look)

    def _send_further(self, job: Job) -> None:
        """Send the next part of a set once the last one has nearly arrived."""
        now = self.time()
        due = max(self._sent_until - _AHEAD, now + _FULL_PAUSE * self._port.is_blocked)
        if due <= now or self._queue.has_before(job, now):
            self._go_on(job)
        else:
            self._look_by(due)

    def _go_on(self, job: Job) -> None:
        """Send the next part of a set, unless a waiting request goes before it."""
        self._attempt = None
        job.go_on()
        if self.wire.confirms_parts:
            job.reach(job.part)
        if self._queue.has_before(job, self.time()):
            self._queue_again(job)
        else:
            self._start(job)

    def _must_yield(self, job: Job) -> bool:
        """Whether a request must yield to a request that silences."""
        return self._queue.has_stop and not job.is_stop_class

    def _end_refused(self, attempt: Attempt, arrival: Nak | BrokenReply) -> None:
        """Repeat a request that a busy amplifier refused; fail any other one."""
        job = attempt.job
        if isinstance(arrival, BrokenReply):
            self._fail(job, FrameError(f"{self.name}: {arrival.reason}"))
            return
        attempt.member.counts.refusals += 1
        if arrival.code == "BUSY" and job.attempts > 0:
            self._repeat(job, attempt.member, pause=BUSY_PAUSE)
            return
        refusal = refused_by_amplifier(
            self.name, arrival.code, arrival.channel, may_play=job.had_no_reply
        )
        self._fail(job, refusal)

    def _queue_again(self, job: Job) -> bool:
        """Queue a request again, and return True, unless a waiting request makes it obsolete."""
        if self._queue.supersedes(job):
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

    def _shorten(self, attempt: Attempt) -> None:
        """Await the current reply for less time if a more urgent request is waiting."""
        job = attempt.job
        if job.is_stop_class:
            return
        if attempt.is_followed:  # no reply is due
            self._send_further(job)
            return
        free_at = max(self.time(), self._free_at)
        match job.reply_wait(self._queue):
            case ReplyWait.NONE:
                attempt.due = min(attempt.due, free_at)
            case ReplyWait.SHORT:
                attempt.due = min(attempt.due, free_at + GRACE)
            # Where replies come late, a reading that is cut short each time would never end.
            case ReplyWait.UNTIL_START if self.late <= GRACE:
                begins_by = max(attempt.started_at + attempt.takes, self._free_at) + REACTION
                attempt.due = min(attempt.due, max(self.time(), begins_by))
        self._look_by(attempt.due)

    def _look_by(self, due: float) -> None:
        """Look at the current attempt at a time [s] or earlier."""
        if self._timer is None or self._timer.when() > due:
            if self._timer is not None:
                self._timer.cancel()
            self._timer = self._loop.call_at(due, self._look)

    def _look(self) -> None:
        """Send the next part of a set if it is time, or end an attempt whose reply is due."""
        timer = self._timer
        self._timer = None
        attempt = self._attempt
        if attempt is None or timer is None:
            return
        now = self.time()
        self._prolong_after_delay(attempt, timer.when(), now)
        if now < attempt.due and attempt.is_followed:
            self._send_further(attempt.job)
            self.pump()
        elif now >= attempt.due and self._is_unanswered(attempt, now):
            self._end_without_reply(attempt)
            self.pump()
        else:
            self._look_again()

    def _prolong_after_delay(self, attempt: Attempt, timer_due: float, now: float) -> None:
        """Prolong the wait for a reply if the timer, due at a time [s], has fired late.

        This process was delayed by as much. The reply keeps the time that it had left when the
        delay began, unless a stop is waiting.
        """
        delayed_since = max(timer_due, attempt.sent_at)
        if now - delayed_since > _LATE and attempt.delays < _DELAYS:
            attempt.delays += 1
            left = 0.0 if self._must_yield(attempt.job) else attempt.due - delayed_since
            attempt.due = now + max(left, _LATE)

    def _is_unanswered(self, attempt: Attempt, now: float) -> bool:
        """Read the port for a reply that is due, and return whether it has not come.

        The port is read twice, with the event loop's other work in between.
        """
        self._port.poll()
        if self._attempt is not attempt or self.time() < attempt.due:
            return False
        if attempt.is_last_look:
            return True
        attempt.due = now
        attempt.is_last_look = True
        return False

    def _look_again(self) -> None:
        """Look at the current attempt again when it is due, or earlier."""
        if self._attempt is not None and self._timer is None:
            due = min(self._attempt.due, self.time() + _LOOK_INTERVAL)
            self._timer = self._loop.call_at(due, self._look)

    def _end_without_reply(self, attempt: Attempt) -> None:
        """Repeat the current request, which had no reply in time, or give it up."""
        self._attempt = None
        self.wire.withdraw()
        job = attempt.job
        member = attempt.member
        was_cut = job.priority is Priority.READING and attempt.due < attempt.sent_at + job.timeout
        if was_cut or self._must_yield(job):
            job.attempts += 1
            self._repeat(job, member)
            return
        job.had_no_reply = True
        member.counts.timeouts += 1
        is_booting = job.name == "Hello" and not self._has_replied
        if job.attempts > 0 or (is_booting and self.time() < self._boots_until):
            self._repeat(job, member)
            return
        self._give_up(job, member, boot_time=self._boot_time if is_booting else 0.0)

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


def _trace(job: Job, result: "asyncio.Future[Values]") -> None:
    """Trace a request with its reply or error, and the time since it was queued."""
    outcome: object = "cancelled"
    if not result.cancelled():
        outcome = result.exception() or result.result()
    took = result.get_loop().time() - job.queued_at
    trace.request(f"{job.name}({job.values})", outcome, took)
