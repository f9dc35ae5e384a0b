"""The amplifier under test: send requests by name, compare each status with the expected one."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from drivers.protocol.definition import (
    ENABLED,
    HIGH_STEPS,
    HIGH_TIME,
    HIGH_WORDS,
    MESSAGES,
    QUANTITIES,
    STATES,
    ahead,
    name_of,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_last, pack_layers, parts
from drivers.wires.wire import reply_words
from era_haptics.lab.conformance.capabilities import STATED, Capabilities
from era_haptics.lab.conformance.dating import Dating
from era_haptics.lab.conformance.judge import Judge
from era_haptics.lab.conformance.judge_client import (
    JUDGE_REPLY_TIMEOUT,
    QUIET_TIME,
    JudgeClient,
    RequestOutcome,
)
from era_haptics.lab.conformance.outcomes import (
    TooLate,
    expect_equal,
    expect_one_of,
    read_as,
    require,
    require_in_time,
    verify,
)
from era_haptics.lab.conformance.request_rows import (
    FULL,
    RequestRows,
    Row,
    Send,
    layer,
    play_now,
    send,
    stage,
)
from era_haptics.lab.conformance.stimuli import READ_REQUESTS, Stimuli
from era_haptics.lab.expectations.expected_amplifier import OFF, request_text
from era_haptics.lab.expectations.tolerances import SAMPLE, Interval
from registry import threads

_SAMPLES = 12  # statuses per transition
_SAMPLE_TIME = 0.02  # s, within which one status must be in time
_NARROW = 0.006  # s, allowed uncertainty of a sample beyond two exchanges
_SETTLED = 3.2  # s, the longest watchdog and ramp, plus the delay of a state
_MAX_WATCHDOG_USE = 0.8
_HUNGRY = 0.25  # share of the watchdog time after which it is fed
_DONE = "carried out"
_MAX_UNFED, _UNFED = 0.1, 0.02  # of the watchdog; s before requests that must not feed it
_POLL, _OVERSLEPT, _SETTLING = 0.0005, 0.05, 0.02  # s
_BY_EXCEPTION = ("UNKNOWN_TYPE", "BAD_LENGTH")  # on Modbus, rejections without a channel
RATE_STEP = 1 / QUANTITIES["rate"].per_unit
"""Relative change of the clock per step of a Ping's rate."""
_MOVING = STATES["SWITCHED_ON"], STATES["FAULT_REACTION_ACTIVE"]


class SentPart(NamedTuple):
    """Part of a set that has no reply of its own: time sent [s], values, number of words."""

    sent_at: float
    values: Values
    words: int


class Subject(Stimuli):
    """Identified amplifier behind a client.

    identity: its reply to Hello. session: begun last. token: of the last set built. sent_set: words
    of the parts of the last set sent. dating: converts times to its clock. is_starving: the
    watchdog may expire. is_at_rest: nothing was sent since it was brought to rest. heard_at: time
    of the last reply [s].
    """

    def __init__(
        self, client: JudgeClient, identity: Values, can: Capabilities, max_level: float
    ) -> None:
        super().__init__(client, can, max_level)
        self.identity = identity
        self.session = 1
        self.token = 0
        self.is_starving = True
        self.is_at_rest = False
        self.sent_set: list[Sequence[int]] = []
        self.dating = Dating()
        self.heard_at = threads.now()
        self._judge: Judge | None = None  # until it was brought to rest
        self._moment = 0  # high word of its clock, named by the last Commit with a moment
        self._pending_parts: list[SentPart] = []
        client.quiet = JUDGE_REPLY_TIMEOUT
        client.reply_words = {
            message.number: reply_words(name, can["channels"], can["layers"])
            for name, message in MESSAGES.items()
        }

    @property
    def judge(self) -> Judge:
        """Expected state."""
        assert self._judge is not None  # noqa: S101
        return self._judge

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

    async def _carry_out(self, row: Row) -> object:
        match row:
            case float():
                await self.pause(row)
                return None
            case LayerSet():
                return await self.play(row)
            case Send():
                return await self.send(row)
            case _:
                return await row()  # type: ignore[operator]

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

    # Requests

    async def request(self, name: str, **values: Any) -> RequestOutcome:
        """Send a request that must be carried out; its reply must match the expected state."""
        return await self.send(send(name, **values))

    async def send(self, row: Send) -> RequestOutcome:
        """Send a request whose outcome must be one of its codes."""
        codes = [code or _DONE for code in row.codes]
        for values in self._requests_of(row):
            reply = await self.answer(row.name, row.raw, **values)
            if not _has_reply(row.name, row.raw, values):
                continue
            text = raw_text(row.name, row.raw) if row.raw else request_text(row.name, values)
            self._require_set_in_time(row.name, reply, codes)
            # Check this first: a message that is too short lacks some of its values.
            expect_one_of(reply.code or _DONE, codes, f"reply to {text}")
            if reply.code:
                break
            reply = await self._compared(row.name, self.filled(values), reply)
        is_on_modbus = self.client.kind in ("rtu", "tcp")
        has_channel = not is_on_modbus or reply.code not in _BY_EXCEPTION
        if reply.code and has_channel:
            expect_one_of(reply.channel, row.channels, f"channel in the Nak to {text}")
        return reply

    def _requests_of(self, row: Send) -> list[Values]:
        """Return the values of the requests of a row: of a set, one for each part."""
        if not row.layers:
            return [row.values]
        token = row.values.get("token", 0)
        set_parts = self.parts(*row.layers, token=token, now=row.values["now"])
        return [{**part, **row.values} for part in set_parts]

    def _require_set_in_time(self, name: str, reply: RequestOutcome, codes: list[str]) -> None:
        """Raise TooLate if a set can have expired before a request that got another reply."""
        is_about_set = name == "Set" or (name == "Commit" and reply.code != "")
        if is_about_set and self._judge is not None and self._judge.sets.has_expired:
            require_in_time((reply.code or _DONE) in codes, f"a set expired before {name}")

    async def answer(
        self, name: str, raw: Sequence[int] | None = None, **values: Any
    ) -> RequestOutcome:
        """Send a request from values or raw words, and return the outcome.

        A part other than the last has no reply; errors show in what arrives with the next message.
        """
        self._check_fed()
        number = MESSAGES[name].number
        values = self.filled(values)
        words = _words_of(name, values) if raw is None else raw
        self.is_at_rest = False
        if name == "Set":
            self._keep_sent(words)
        sent_at = threads.now()
        if not _has_reply(name, raw, values):
            self._pending_parts.append(SentPart(sent_at, values, len(words)))
            await self.client.part(number, words)
            return RequestOutcome("", None, (), Interval(sent_at, threads.now()))
        reply = await self.client.exchange(number, words)
        self._check_fed()  # it can have been carried out after the watchdog tripped
        duration = threads.now() - sent_at
        parts_time = self._parts_received(reply.when.latest)
        if self._judge is not None:
            self._judge.sets.expire(self.dating.interval(reply.when))
            if "index" in values and reply.code:
                self._judge.part_refused(values, reply.code)
        self._note_duration(name, reply, duration, len(words), parts_time)
        self.heard_at = reply.when.latest
        return reply

    def filled(self, values: Values) -> Values:
        """Return values completed by the default values of a request."""
        present = 0 if self._judge is None else self._judge.clock.present
        return {"session": self.session, "rate": 0, "shift": 0, "at": present, **values}

    def _keep_sent(self, words: Sequence[int]) -> None:
        """Keep the words of a part, with the earlier parts of its set."""
        head = MESSAGES["Set"].request.places["index"]  # session and token
        if self.sent_set and list(self.sent_set[-1][:head]) != list(words[:head]):
            self.sent_set = []
        self.sent_set = [*self.sent_set, words]

    def _parts_received(self, latest: float) -> float:
        """Record that the pending parts arrived by a time [s]; return their time on the wire."""
        pending = self._pending_parts
        self._pending_parts = []
        if pending:
            expect_equal(len(self.client.inbox), 0, "number of replies to parts before the last")
        if self._judge is not None:
            for part in pending:
                when = self.dating.interval(Interval(part.sent_at, latest))
                self._judge.part_came(part.values, when)
        if self.client.transactions > 1:  # each had its response
            return 0.0
        return sum(self.client.wire_time(part.words, 0) for part in pending)

    def _note_duration(
        self, name: str, reply: RequestOutcome, duration: float, words: int, parts_time: float
    ) -> None:
        """Record how long an exchange took, and how late its reply was."""
        client = self.client
        client.quiet = min(client.quiet, QUIET_TIME + duration)
        wire_time = client.wire_time(words, len(reply.words))
        if not reply.code:  # a rejection can arrive earlier
            client.pace = min(client.pace, duration / wire_time if wire_time else 0.0)
            client.fastest[name] = min(client.fastest.get(name, math.inf), duration)
        beyond = max(duration - client.pace * (parts_time + wire_time), 0.0)
        count = 1 if name in READ_REQUESTS else client.transactions
        lateness = client.lateness
        reactions = lateness.reactions["refusals" if reply.code else name]
        reactions.append(beyond / count)
        lateness.largest = max(lateness.largest, beyond - count * min(reactions))

    # Comparison with the expected state

    async def _compared(self, name: str, values: Values, reply: RequestOutcome) -> RequestOutcome:
        """Parse the reply to a request, and compare it with the expected state."""
        record = STATED if name == "GetCaps" else MESSAGES[name].reply
        shown = read_as(f"reply to {name}", record.unpack, reply.words, is_strict=False)
        self._check_sizes(name, shown)
        is_dated = self._is_dated(name, shown)
        reply = replace(reply, when=self._dated(name, values, shown, reply.when))
        judge = self._judge
        if judge is not None:
            if name == "Set":
                self._note_token(judge, values)
            if name == "Commit" or shown.get("played"):
                is_exact = bool(shown.get("exact", judge.sets.is_exact))
                await self._learn_achieved(values["token"], is_exact=is_exact)
            judge.granted(name, values, shown, reply.when)
            if is_dated:  # sets that start with the next sample can show already
                latest = reply.when.latest
                judge.clock.check(shown["clock"], Interval(latest - SAMPLE, latest))
            self.is_starving = self.is_starving or name in ("Stop", "Disarm")
        return replace(reply, values=shown)

    def _check_sizes(self, name: str, reply: Values) -> None:
        """Check that a reply repeats the stated capabilities."""
        if name == "GetCaps":
            expect_equal(reply, self.can, "capabilities, read a second time")
        if "levels" in reply:
            for size in ("channels", "layers"):
                expect_equal(reply[size], self.can[size], f"number of {size} in Status")

    def _note_token(self, judge: Judge, values: Values) -> None:
        """Record the token of a set, and the set itself unless it is known."""
        self.token = values["token"]
        if self.token not in (judge.token, judge.sets.staged):
            judge.sets.sent(values)

    def _is_dated(self, name: str, reply: Values) -> bool:
        """Return whether a reply contains the current clock."""
        is_marked = self._judge is not None and self._judge.clock.is_marked
        return "clock" in reply and name != "Mark" and not is_marked

    def _dated(self, name: str, values: Values, reply: Values, when: Interval) -> Interval:
        """Return when a status was true and its request was carried out, on the amplifier's clock.

        The clock can be read after the request is carried out, except for GetStatus.
        """
        dating, judge = self.dating, self._judge
        between = dating.interval(when)
        if not self._is_dated(name, reply):
            return between
        if name == "Arm":
            held_session = judge.session if judge is not None and judge.is_enabled else None
            if held_session != values["session"]:
                dating.shift(values["shift"])
        dated = dating.dated(reply["clock"], when, self.can["clock_error"])
        if reply["state"] != ENABLED:
            dating.pace = 1.0
        elif name == "Ping":
            dating.pace = 1 + values["rate"] * RATE_STEP
        return dated if name == "GetStatus" else dating.between(between.earliest, dated.latest)

    async def _learn_achieved(self, token: int, *, is_exact: bool) -> None:
        """Read the achieved values of a set that does not play exactly."""
        judge = self.judge
        layers = None if token == judge.token else judge.sets.whole(token)
        if layers is None or is_exact:
            return
        achieved_layers = []
        unpack = MESSAGES["GetAchieved"].reply.unpack
        for layer_set in layers:
            reply = await self.answer("GetAchieved", layer=layer_set.layer)
            shown = read_as("reply to GetAchieved", unpack, reply.words, is_strict=False)
            if shown["token"] == token and not layer_set.renew:
                layer_set = judge.achieved(layer_set, shown)
            achieved_layers.append(layer_set)
        judge.sets.replace(token, tuple(achieved_layers))

    # Sessions and the watchdog

    async def status(self) -> RequestOutcome:
        """Read the status; feed the watchdog if due."""
        return await (self.ping() if self.is_hungry else self.request("GetStatus"))

    async def ping(self) -> RequestOutcome:
        """Feed the watchdog."""
        return await self.request("Ping")

    async def arm(
        self, watchdog: float = 2.0, *, is_fed: bool = True, shift: int = 0
    ) -> RequestOutcome:
        """Arm with a new session and the nearest possible watchdog [s].

        is_fed: choose a watchdog that can be fed in time; otherwise it can expire from now on.
        shift: of its clock.
        """
        self.session = self.next_session
        self.client.session = self.session
        self.token = 0
        self.is_starving = not is_fed
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

    def _check_fed(self) -> None:
        """Raise TooLate if this machine can have missed the watchdog's deadline."""
        require_in_time(self._since_fed <= _MAX_WATCHDOG_USE, "the watchdog was not fed in time")

    @property
    def _since_fed(self) -> float:
        """Share of the watchdog time that has passed."""
        judge = self._judge
        if self.is_starving or judge is None or judge.state != ENABLED:
            return 0.0
        return (threads.now() - judge.fed.earliest) / judge.watchdog

    @property
    def is_hungry(self) -> bool:
        """Return whether the watchdog must be fed now."""
        return self._since_fed > _HUNGRY

    async def unfed(self) -> None:
        """Feed the watchdog if due, so that it was fed a while ago and is not due soon."""
        if self._since_fed > _MAX_UNFED:
            await self.ping()
        await asyncio.sleep(max(self.judge.fed.latest + _UNFED - threads.now(), 0.0))

    async def starve(self) -> None:
        """Stop feeding: from now on the watchdog may expire."""
        self.is_starving = True

    async def rest(self) -> None:
        """Bring it to silence, disarmed, nothing latched, and judge all replies from now on."""
        is_armed = self._judge is not None and self._judge.is_enabled
        self._judge = None
        self.dating = Dating()
        self._pending_parts = []
        reply = await self.settle(await self.request("Disarm" if is_armed else "Stop", ramp=0))
        if reply["state"] != OFF:
            reply = await self.request("Clear", latch=reply["latch"])
            expect_equal(reply["state"], OFF, "state after Clear")
        self._judge = Judge(self.can, reply.values, reply.when)
        self.is_at_rest = True

    async def watch(self) -> None:
        """Judge all replies from now on, by the status as it is."""
        status = await self.request("GetStatus")
        self._judge = Judge(self.can, status.values, status.when)

    def require_alone(self) -> None:
        """Raise NotApplicable if a broadcast would reach other amplifiers."""
        neighbors = ", ".join(map(str, sorted(self.client.neighbors)))
        reason = f"a broadcast would reach other amplifiers on the line ({neighbors})"
        require(not neighbors, reason)

    # Sets

    def parts(
        self, *layers: LayerSet, token: int = 0, now: int = 1, count: int = 1
    ) -> list[Values]:
        """Make the parts of a set but for their session; token: 0 for the next; count: at least."""
        if not token:
            token = self.token % 0xFFFF + 1
            self.token = token
        ramp_max = self.can["ramp_max"]
        limited = [replace(layer_set, ramp=min(layer_set.ramp, ramp_max)) for layer_set in layers]
        stream = pack_layers(tuple(limited))
        max_words = math.ceil(len(stream) / count)
        set_parts = parts(stream, session=1, token=token, now=bool(now), max_words=max_words)
        return [
            {name: value for name, value in part.items() if name != "session"} for part in set_parts
        ]

    def words_of(self, *layers: LayerSet) -> tuple[Values, list[int]]:
        """Return a single-part set that plays immediately, and its words."""
        (part,) = self.parts(*layers)
        words = MESSAGES["Set"].request.pack({"session": self.session, **part})
        self.sent_set = [words]
        return part, words

    def since(self, sent_at: float) -> Interval:
        """Return the interval from a time of this machine until now, by the amplifier's clock."""
        return self.dating.interval(Interval(sent_at, threads.now()))

    def played(self, part: Values, sent_at: float) -> None:
        """Record that a single-part set, sent at a given time, was carried out."""
        self.judge.sets.sent(part)
        self.judge.carry_out("Set", part, {}, self.since(sent_at))

    async def play(self, *layers: LayerSet) -> RequestOutcome:
        """Play a set immediately."""
        return await self.send(play_now(*layers))

    async def send_all(self, rows: Sequence[Send]) -> None:
        """Send requests in one go, without reading the status in between."""
        for row in rows:
            await self.send(row)

    # Moments of the amplifier's clock

    def moment(self, duration: float) -> int:
        """Return the high word of its clock `duration` [s] after its last status."""
        return round(self.judge.clock.present + duration / HIGH_TIME) % HIGH_WORDS

    async def commit_in(self, duration: float) -> int:
        """Commit the staged set for a moment `duration` [s] after the last status; return it."""
        self._moment = self.moment(duration)
        await self.request("Commit", token=self.token, at=self._moment)
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

    async def pause(self, duration: float) -> None:
        """Wait for a time [s], feeding the watchdog."""
        end = threads.now() + duration
        while (remaining := end - threads.now()) > 0:
            if self.is_hungry:
                await self.ping()
                continue
            needs_feeding = not self.is_starving and self.judge.state == ENABLED
            if needs_feeding:
                remaining = min(remaining, self.judge.watchdog / 8)
            await asyncio.sleep(remaining)
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
        two_exchanges = min(2 * self.exchange_time, 2.0)  # of a slow line
        end = max(end, threads.now() + min(two_exchanges, 2 * self.read_time))
        time = end - self.heard_at
        pause = max(time / (2 * _SAMPLES) - min(self.exchange_time, 1.0), 0.0)
        extension = max(two_exchanges, _SETTLING)
        count = 0
        while threads.now() < end + (extension if count < 2 else 0):
            reply = await self.status()
            width = reply.when.latest - reply.when.earliest + began.latest - began.earliest
            max_width = _NARROW + 2 * max(self.exchange_time, self.client.transit)
            if width <= max_width:
                count += 1
                await asyncio.sleep(pause)
            else:
                await asyncio.sleep(0)
        samples = min(_SAMPLES / 3, time / _SAMPLE_TIME, time / (4 * self.exchange_time))
        is_in_time = count >= max(samples, 2)
        require_in_time(is_in_time, f"only {count} Status replies were in time")

    async def require_interference(self) -> None:
        """Raise NotApplicable unless levels show that tones at the same frequency cancel."""
        opposite_tones = [
            layer(number, self.tone(0, 0.5, phase)) for number, phase in enumerate((0.0, 180.0))
        ]
        await self.play(*opposite_tones)
        level = (await self.request("GetStatus"))["levels"][0]
        await self.play(layer(0), layer(1))
        shows_interference = level <= 0.75 * self.level * FULL  # phases may be rounded
        reason = "the levels do not show that tones at the same frequency interfere"
        require(shows_interference, reason)
        self.judge.outputs.interferes = True


def raw_text(name: str, words: Sequence[int]) -> str:
    """Return a request with its raw words, as reasons name it."""
    return f"{name} with the words {' '.join(f'{word:04X}' for word in words)}"


def _words_of(name: str, values: Values) -> Sequence[int]:
    """Return the words of a request, also of values beyond the table."""
    request = MESSAGES[name].request
    try:
        return request.pack(values)
    except ValueError:
        return [values[field] for field in request.names]


def _has_reply(name: str, raw: Sequence[int] | None, values: Values) -> bool:
    """Whether a request has a reply: all but a part of a set that is not the last."""
    return name != "Set" or raw is not None or is_last(values)
