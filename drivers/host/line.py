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
from drivers.host.requests import (
    Attempt,
    AttemptPhase,
    Job,
    JobQueue,
    Make,
    Member,
    Priority,
    ReplyTiming,
)
from drivers.ports import OpenPort
from drivers.protocol.definition import (
    ATTEMPTS,
    BROADCAST,
    MESSAGES,
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

BUSY_PAUSE = 0.005  # s; before a request is repeated to a busy amplifier
_LOOK_INTERVAL = 0.01  # s; between checks; each check would detect a delay of this process
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
        self._is_sending = False
        """Whether messages are being sent; requests that are submitted meanwhile are queued."""
        self._timing = ReplyTiming()

    def open(self, port: OpenPort) -> None:
        """Use this open port, once: a lost line is not opened again.

        If the port was lost meanwhile, the line stays lost.
        """
        self._port = port
        self._commit_takes = self.wire.transit(MESSAGES["Commit"].request.words)
        self._boots_until = self.time() + self._boot_time
        self._has_replied = False

    @property
    def current(self) -> Job | None:
        """The request on the line; None if the line is free."""
        return None if self._attempt is None else self._attempt.job

    @property
    def late(self) -> float:
        """Delay of replies [s] beyond the time on the wire."""
        return self._timing.late

    def submit(
        self,
        member: Member | None,
        priority: Priority,
        name: str,
        values: Values | Make,
        *,
        timeout: float = REPLY_TIMEOUT,
        check: Callable[[], None] | None = None,
    ) -> "asyncio.Future[Values]":
        """Queue a request to an amplifier; returns a future of the values of its reply.

        The future raises LinkError, LinkTimeout, FrameError, CommandRefused, or Preempted if a
        request with a higher priority made this one obsolete. member: None for a broadcast, which
        has no reply; its future ends once it was sent. check: called before each message is sent;
        raises an error if the request must not be sent any more.
        """
        job = Job(member, priority, name, timeout, self.time(), check=check)
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
        if self._attempt is None and not (self._queue or self._is_sending):
            self._send_from(job)
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
        return self._timing.commit_arrives(self.time(), self._commit_takes)

    def received(self, data: bytes) -> None:
        """Process bytes that the port has received."""
        arrivals = self.wire.received(data)
        if trace.is_active():
            trace.frame(Direction.IN, data, self.name, lambda: ", ".join(map(repr, arrivals)))
        for arrival in arrivals:
            self._process(arrival)
        self.pump()
        if self._attempt is None and self._timer is not None:
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
        self._timing.note_arrived()
        if isinstance(arrival, Continuation):
            self._timing.note_continuation(self.time())
            if self._must_yield(attempt.job):
                self._end_without_reply(attempt)
            else:
                self._continue(attempt, arrival.data, is_present=arrival.is_present)
            return
        attempt.member.no_reply_cause = None
        if isinstance(arrival, WrittenPart):
            attempt.phase = AttemptPhase.CONFIRMED
            return
        self._attempt = None
        self._timing.note_reply(attempt, self.time())
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
        """Send the next part of the set on the line, or the next request if the line is free."""
        if not self._is_sending:
            self._send_from(self._next_job())

    def _send_from(self, job: Job | None) -> None:
        """Send a message of a request, and then the next messages until one must wait."""
        self._is_sending = True
        try:
            while job is not None:
                self._start(job)
                job = self._next_job()
        finally:
            self._is_sending = False

    def _next_job(self) -> Job | None:
        """Take the request that sends a message now; None while the line is busy or nothing waits.

        After a part of a set, this is the same request, unless a waiting one goes before it.
        """
        if self.loss is not None:
            return None
        attempt = self._attempt
        if attempt is None:
            return self._take_queued()
        if not self._is_followed_now(attempt):
            return None
        self._attempt = None
        job = attempt.job
        if job.result.done():  # its caller was cancelled: further parts would complete the set
            return self._take_queued()
        job.go_on()
        if self.wire.confirms_parts:
            job.reach(job.part)
        if not self._queue.has_before(job, self.time()):
            return job
        self._queue_again(job)
        return self._take_queued()

    def _is_followed_now(self, attempt: Attempt) -> bool:
        """Whether the next part of the set on the line is sent now; else a timer waits for it."""
        if attempt.phase is not AttemptPhase.NEXT_PART:
            return attempt.phase is AttemptPhase.CONFIRMED
        now = self.time()
        due = self._timing.next_part_due(now, is_blocked=self._port.is_blocked)
        if due <= now or self._queue.has_before(attempt.job, now):
            return True
        self._look_by(due)
        return False

    def _take_queued(self) -> Job | None:
        """Take the next request from the queue; None if there is none, or it is pausing."""
        while self._queue:
            now = self.time()
            job = self._queue.next(now)
            if job is None:
                return None
            self._queue.take(job, now)
            if not job.result.done():  # its caller was not cancelled
                return job
        return None

    def _start(self, job: Job) -> None:
        """Send a message of a request and await its reply, or fail it if it cannot be sent."""
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
        if job.check is not None:
            job.check()
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
        begins = self._timing.begins(now)
        for receiver in self.members.values():
            if address in (BROADCAST, receiver.address):
                receiver.note_sent(job.name, job.values, now, begins + self.wire.takes)
        self._write(job, data, begins)
        if member is None:
            return None
        is_followed = job.has_further_parts and not self.wire.confirms_parts
        phase = AttemptPhase.NEXT_PART if is_followed else AttemptPhase.REPLY
        return Attempt(job, member, takes, now, begins, phase)

    def _continue(self, attempt: Attempt, data: bytes, *, is_present: bool) -> None:
        """Send the rest of a message, and await its reply.

        is_present: whether these bytes complete the request for the amplifier.
        """
        job = attempt.job
        try:
            now = self.time()
            begins = self._timing.begins(now)
            if is_present:
                attempt.member.note_sent(job.name, job.values, now, begins + self.wire.takes)
            self._write(job, data, begins)
        except Exception as error:  # every caller must get a result, after any failure
            self._fail_sending(job, error)
            return
        attempt.phase = AttemptPhase.REPLY
        self._await_reply(attempt, now, begins)

    def _write(self, job: Job, data: bytes, begins: float) -> None:
        """Write bytes to the port; begins: when the first bit is on the wire [s]."""
        member = job.member
        if trace.is_active():
            request = job.name if member is None else f"{job.name} to {member.address}"
            trace.frame(Direction.OUT, data, self.name, lambda: request)
        self._timing.note_written(begins, self.wire)
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

        If further parts of a set follow, there is no reply.
        """
        self._timing.set_deadline(attempt, begins)
        self._attempt = attempt
        if attempt.phase is AttemptPhase.REPLY and self._timer is None:
            self._timer = self._loop.call_at(min(attempt.due, now + _LOOK_INTERVAL), self._look)

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
        if job.is_stop_class or attempt.phase is AttemptPhase.NEXT_PART:
            return
        self._timing.shorten(attempt, job.reply_wait(self._queue), self.time())
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
        must_yield = self._must_yield(attempt.job)
        self._timing.prolong(attempt, timer.when(), now, must_yield=must_yield)
        if now >= attempt.due and self._is_unanswered(attempt, now):
            self._end_without_reply(attempt)
        self.pump()
        if self._attempt is not None and self._timer is None:
            due = min(self._attempt.due, self.time() + _LOOK_INTERVAL)
            self._timer = self._loop.call_at(due, self._look)

    def _is_unanswered(self, attempt: Attempt, now: float) -> bool:
        """Read the port for a reply that is due, and return whether it has not come.

        The port is read twice, with the event loop's other work in between.
        """
        self._port.poll()
        if self._attempt is not attempt or self.time() < attempt.due:
            return False
        if attempt.phase is not AttemptPhase.REPLY:  # read before, or there is no reply
            return True
        attempt.due = now
        attempt.phase = AttemptPhase.LAST_LOOK
        return False

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
