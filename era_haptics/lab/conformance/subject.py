"""The amplifier under test: rows of requests, sessions, sets and waiting, each reply judged.

Checks use a Subject. `JudgedExchange` sends a single request and judges its reply, `Stimuli` builds
tones and layers that the amplifier supports.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from inspect import isawaitable

from drivers.protocol.definition import (
    ENABLED,
    HIGH_STEPS,
    HIGH_TIME,
    HIGH_WORDS,
    MESSAGES,
    STATES,
    ahead,
    name_of,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from era_haptics.lab.conformance.dating import Dating
from era_haptics.lab.conformance.judge import Judge
from era_haptics.lab.conformance.judge_client import RequestOutcome
from era_haptics.lab.conformance.judged_exchange import JudgedExchange
from era_haptics.lab.conformance.outcomes import (
    TooLate,
    expect_equal,
    require,
    require_in_time,
    verify,
)
from era_haptics.lab.conformance.request_rows import (
    RequestRows,
    Send,
    Step,
    Wait,
    play_now,
    stage,
)
from era_haptics.lab.expectations.expected_amplifier import OFF
from era_haptics.lab.expectations.tolerances import Interval
from registry import threads

_SAMPLES = 12  # statuses per transition
_SAMPLE_TIME = 0.02  # s, within which one status must be in time
_NARROW = 0.006  # s, allowed uncertainty of a sample beyond two exchanges
_SETTLED = 3.2  # s, the longest watchdog and ramp, plus the delay of a state
_MAX_UNFED, _UNFED = 0.1, 0.02  # of the watchdog; s before requests that must not feed it
_POLL, _OVERSLEPT, _SETTLING = 0.0005, 0.05, 0.02  # s
_MOVING = STATES["SWITCHED_ON"], STATES["FAULT_REACTION_ACTIVE"]


class Subject(JudgedExchange):
    """Identified amplifier behind a client, as checks drive it."""

    _moment = 0
    """High word of its clock, named by the last Commit with a moment."""

    # Rows of requests

    async def run(self, rows: RequestRows) -> None:
        """Carry out rows in order; after each, compare a status with the expected one.

        If the reply to the last request is a status, it is not used for this.
        """
        for number, row in enumerate(rows, 1):
            if isinstance(row, Sequence):
                await self.in_time(partial(self._run_course, row))
                continue
            outcome = await self._carry_out(row)
            is_status = isinstance(outcome, RequestOutcome) and "levels" in outcome.values
            if number == len(rows) or not is_status:
                await self.status()

    async def _carry_out(self, step: Step) -> object:
        """Carry out a step; return the outcome of a request, or what a function returns."""
        match step:
            case Wait():
                await self.wait(step.duration)
                return None
            case LayerSet():
                return await self.play(step)
            case Send():
                return await self.send(step)
            case _:
                result = step()
                return await result if isawaitable(result) else None

    async def _run_course(self, rows: RequestRows) -> None:
        """Arm, carry out rows, and follow the outputs until they have settled."""
        await self.arm()
        await self.run(rows)
        await self.follow()

    async def in_time(self, case: Callable[[], Awaitable[object]]) -> None:
        """Try a case, each time from rest, until this machine was in time."""
        while True:
            started_at = threads.now()
            if not self.is_at_rest:
                await self.rest()
            try:
                await case()
                return
            except TooLate:
                if not self.client.lateness.repeats(started_at):
                    raise

    async def play(self, *layers: LayerSet) -> RequestOutcome:
        """Play a set immediately."""
        return await self.send(play_now(*layers))

    async def send_all(self, rows: Sequence[Send]) -> None:
        """Send requests in one go, without reading the status in between."""
        for row in rows:
            await self.send(row)

    # Sessions and the watchdog

    async def status(self) -> RequestOutcome:
        """Read the status; feed the watchdog if due."""
        return await (self.ping() if self.feeding.is_due else self.request("GetStatus"))

    async def ping(self) -> RequestOutcome:
        """Feed the watchdog."""
        return await self.request("Ping")

    async def arm(
        self,
        watchdog: float = 2.0,
        *,
        is_fed: bool = True,
        shift: int = 0,
        session: int | None = None,
    ) -> RequestOutcome:
        """Arm with the nearest possible watchdog [s]; session: None for the next one.

        is_fed: choose a watchdog that can be fed in time; otherwise it can expire from now on.
        shift: of its clock.
        """
        self.session = self.next_session if session is None else session
        self.client.session = self.session
        self.sets.token = 0
        self.feeding.is_starving = not is_fed
        shortest = self.shortest_watchdog if is_fed else self.can["watchdog_min"]
        milliseconds = min(max(round(1000 * watchdog), shortest), self.can["watchdog_max"])
        return await self.request("Arm", session=self.session, watchdog=milliseconds, shift=shift)

    @property
    def next_session(self) -> int:
        """The session of the next Arm."""
        return self.client.session % 0xFFFF + 1

    async def clear(self) -> RequestOutcome:
        """Clear the last stop or fault."""
        return await self.request("Clear", latch=self.latch)

    @property
    def latch(self) -> int:
        """The number of the last stop or fault."""
        return self.judge.latch or 0

    async def unfed(self) -> None:
        """Feed the watchdog if due, so that it was fed a while ago and is not due soon."""
        if self.feeding.used > _MAX_UNFED:
            await self.ping()
        await asyncio.sleep(max(self.judge.watchdog.fed.latest + _UNFED - threads.now(), 0.0))

    async def rest(self) -> None:
        """Bring it to silence, disarmed, nothing latched, and judge all replies from now on."""
        is_armed = self._judge is not None and self._judge.is_enabled
        self.feeding.judge = None
        self.dating = Dating()
        self._pending_parts = []
        reply = await self.settle(await self.request("Disarm" if is_armed else "Stop", ramp=0))
        if reply["state"] != OFF:
            reply = await self.request("Clear", latch=reply["latch"])
            expect_equal(reply["state"], OFF, "state after Clear")
        self.feeding.judge = Judge(self.can, reply.values, reply.when)
        self.is_at_rest = True

    async def watch(self) -> None:
        """Judge all replies from now on, by the status as it is."""
        status = await self.request("GetStatus")
        self.feeding.judge = Judge(self.can, status.values, status.when)

    def require_alone(self) -> None:
        """Raise NotApplicable if a broadcast would reach other amplifiers."""
        neighbors = ", ".join(map(str, sorted(self.client.neighbors)))
        reason = f"a broadcast would reach other amplifiers on the line ({neighbors})"
        require(not neighbors, reason)

    # Sets that are sent or broadcast frame by frame

    def words_of(self, *layers: LayerSet) -> tuple[Values, list[int]]:
        """Return a single-part set that plays immediately, and its words."""
        (part,) = self.sets.parts(*layers)
        words = MESSAGES["Set"].request.pack({"session": self.session, **part})
        self.sets.sent = [words]
        return part, words

    def since(self, sent_at: float) -> Interval:
        """Return the interval from a time of this machine until now, by the amplifier's clock."""
        return self.dating.interval(Interval(sent_at, threads.now()))

    def played(self, part: Values, sent_at: float) -> None:
        """Record that a single-part set, sent at a given time, was carried out."""
        self.judge.sets.sent(part)
        self.judge.carry_out("Set", part, {}, self.since(sent_at))

    # Moments of the amplifier's clock

    def moment(self, duration: float) -> int:
        """Return the high word of its clock `duration` [s] after its last status."""
        return round(self.judge.clock.present + duration / HIGH_TIME) % HIGH_WORDS

    async def commit_in(self, duration: float) -> int:
        """Commit the staged set for a moment `duration` [s] after the last status; return it."""
        self._moment = self.moment(duration)
        await self.request("Commit", token=self.sets.token, at=self._moment)
        return self._moment

    async def play_at_moment(self, *layers: LayerSet, lead: float, spacing: float = 0.0) -> None:
        """Play a set from a moment of its clock, `spacing` [s] after the last such moment.

        lead: time from the Commit to its moment [s], if spacing is 0. Raises TooLate if
        the Commit can have arrived after its moment.
        """
        await self.send(stage(*layers))
        await self.commit_in(self._until_moment + spacing if spacing else lead)
        require_in_time(self._until_moment > HIGH_TIME, "a Commit arrived after its moment")
        await self.past_moment()

    async def past_moment(self, duration: float = 0.0) -> None:
        """Read statuses until a time [s] after the moment of the last Commit that named one."""
        while self._until_moment >= -duration:
            await self.status()

    @property
    def _until_moment(self) -> float:
        """The time [s] from the last status until that moment, within a step of the high word."""
        return ahead(self._moment * HIGH_STEPS, self.judge.clock.present * HIGH_STEPS)

    # Waiting

    async def wait(self, duration: float) -> None:
        """Wait for a time [s], feeding the watchdog."""
        end = threads.now() + duration
        while (remaining := end - threads.now()) > 0:
            if self.feeding.is_due:
                await self.ping()
            else:
                await asyncio.sleep(self.feeding.sleep_time(remaining))
        self.heard_at = end
        require_in_time(threads.now() <= end + _OVERSLEPT, "a pause took too long")

    async def settle(self, reply: RequestOutcome | None = None) -> RequestOutcome:
        """Read statuses after a reply until it is silent and in a stable state."""
        due = threads.now() + _SETTLED
        reply = reply or await self.status()
        while any(reply["levels"]) or reply["state"] in (*_MOVING, ENABLED):
            status = f"{name_of(STATES, reply['state'])}, levels {reply['levels']}"
            is_in_time = threads.now() < due
            verify(is_in_time, "silence", expected=f"within {_SETTLED:g} s", actual=status)
            await asyncio.sleep(_POLL)
            reply = await self.status()
        return reply

    async def follow(self, duration: float | None = None) -> None:
        """Read statuses for a time [s] after the last change; None: until all outputs have settled.

        Raises TooLate if this machine was too slow to observe the changes.
        """
        began = self.judge.outputs.began
        if duration is None:
            end = self.judge.outputs.settled_at(began.latest) + _SETTLING
        else:
            end = began.earliest + duration
        two_exchanges = min(2 * self.timing.exchange_time, 2.0)  # of a slow line
        end = max(end, threads.now() + min(two_exchanges, 2 * self.timing.read_time))
        time = end - self.heard_at
        spacing = max(time / (2 * _SAMPLES) - min(self.timing.exchange_time, 1.0), 0.0)
        extension = max(two_exchanges, _SETTLING)
        count = 0
        while threads.now() < end + (extension if count < 2 else 0):
            reply = await self.status()
            width = reply.when.latest - reply.when.earliest + began.latest - began.earliest
            max_width = _NARROW + 2 * max(self.timing.exchange_time, self.client.transit)
            if width <= max_width:
                count += 1
                await asyncio.sleep(spacing)
            else:
                await asyncio.sleep(0)
        samples = min(_SAMPLES / 3, time / _SAMPLE_TIME, time / (4 * self.timing.exchange_time))
        is_in_time = count >= max(samples, 2)
        require_in_time(is_in_time, f"only {count} Status replies were in time")
