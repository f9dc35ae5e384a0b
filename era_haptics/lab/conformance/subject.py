"""The amplifier under test: send requests by name, compare each status with the expected one."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

from drivers.protocol.definition import (
    ENABLED,
    HIGH_STEPS,
    HIGH_TIME,
    HIGH_WORDS,
    MESSAGES,
    QUANTITIES,
    REACTION,
    STATES,
    ahead,
    has_feature,
    name_of,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, is_last, pack_layers, parts
from drivers.wires.wire import reply_words
from era_haptics.lab.conformance.judge_client import (
    FULL,
    JUDGE_REPLY_TIMEOUT,
    QUIET_TIME,
    STATED,
    Capabilities,
    Dating,
    Judge,
    JudgeClient,
    RequestOutcome,
    RequestRows,
    Send,
    TooLate,
    When,
    expect_equal,
    expect_one_of,
    layer,
    play_now,
    read_as,
    require,
    require_in_time,
    send,
    stage,
    verify,
)
from era_haptics.lab.expected_amplifier import OFF, request_text
from era_haptics.lab.expected_output import SAMPLE
from registry import threads

DEFAULT_LEVEL = 0.2
"""Default level of driven channels: perceptible and far from any limit."""
_SAMPLES, _EACH = 12, 0.02  # samples per transition; s, within which one must succeed
_PROMPT, _SLOWEST = 0.02, 0.1  # s, exchange time of a fast line, and the longest that counts
_NARROW = 0.006  # s, allowed uncertainty of a sample beyond two exchanges
_SETTLED = 3.2  # s, the longest watchdog and ramp, plus the delay of a state
_MAX_WATCHDOG_USE = 0.8
_DONE = "carried out"
_MAX_UNFED, _UNFED = 0.1, 0.02  # of the watchdog; s before requests that must not feed it
_POLL, _OVERSLEPT, _SETTLING = 0.0005, 0.05, 0.02  # s
# s; lead of a Commit before its moment, in addition to the exchanges; largest lateness allowed for
_LEAD, _MAX_LATENESS = 0.0025, 0.02
_READ_ALONE = ("GetCaps", "GetStatus", "GetFaults")  # on Modbus, takes half an exchange
_BY_EXCEPTION = ("UNKNOWN_TYPE", "BAD_LENGTH")  # on Modbus, rejections without a channel
RATE_STEP = 1 / QUANTITIES["rate"].per_unit
"""Relative change of the clock per step of a Ping's rate."""
_MOVING = STATES["SWITCHED_ON"], STATES["FAULT_REACTION_ACTIVE"]


class Subject:
    """Identified amplifier behind a client; level: upper bound for driven channels.

    expected: expected state, None until it was brought to rest. token: of the last set built.
    sent_set: parts of the last set sent. dating: converts times to its clock. is_at_rest: nothing
    was sent since it was brought to rest.
    """

    def __init__(
        self, client: JudgeClient, identity: Values, can: Capabilities, level: float
    ) -> None:
        self.client, self.identity, self.can = client, identity, can
        self._level = level
        self.session, self.token = 1, 0
        self.expected: Judge | None = None
        self.is_starving, self.is_at_rest = True, False
        self.sent_set: list[Sequence[int]] = []
        self.dating = Dating()
        self._moment = 0  # high word of its clock named by the last such Commit
        self._parts: list[tuple[float, Values, int]] = []  # unanswered parts: time sent, words
        client.quiet = JUDGE_REPLY_TIMEOUT
        self.heard_at = threads.now()
        self.channels, layers = range(can["channels"]), can["layers"]
        client.reply_words = {
            each.number: reply_words(name, can["channels"], layers)
            for name, each in MESSAGES.items()
        }

    @property
    def shown(self) -> Judge:
        """Expected state."""
        assert self.expected is not None  # noqa: S101
        return self.expected

    # Supported values; a capability is read only when needed

    @property
    def layers(self) -> range:
        """The numbers of its layers."""
        return range(self.can["layers"])

    @cached_property
    def level(self) -> float:
        """Level of driven channels; NotApplicable if no level step is that low."""
        limits, step = [self.can, *self.can["limits"]], self.can["level_step"] / FULL
        level: float = min(self._level, *(one["level_max"] / FULL for one in limits))
        require(level >= step, f"level_max of {level:g} is below level_step of {step:g}")
        return level

    @cached_property
    def lowest(self) -> int:
        """Lowest frequency common to all channels, in steps; raises NotApplicable without one."""
        limits = [self.can, *self.can["limits"]]
        lowest = max(one["frequency_min"] for one in limits)
        require(lowest <= self.highest, "the channels have no frequency in common")
        return int(lowest)

    @cached_property
    def highest(self) -> int:
        """The highest frequency of every channel, in steps."""
        return int(min(one["frequency_max"] for one in (self.can, *self.can["limits"])))

    @cached_property
    def frequency(self) -> int:
        """The usual frequency, in steps."""
        ordinary = QUANTITIES["frequency"].to_wire(110.0)
        return min(max(ordinary, self.lowest), self.highest)

    @cached_property
    def other(self) -> int:
        """A second frequency, in steps, if there is one."""
        both = self.frequency + 800, self.lowest, self.highest
        return next(each for each in both if each <= self.highest)

    def has(self, feature: str) -> bool:
        """Return whether the amplifier states a feature; empty: a feature of all amplifiers."""
        return not feature or has_feature(self.can, feature)

    def require(self, feature: str) -> None:
        """Raise NotApplicable unless it states a feature."""
        require(self.has(feature), f"the feature {feature} is not stated")

    def require_knots(self) -> None:
        """Raise NotApplicable unless its envelopes have knots."""
        require(self.can["knots"] > 0, "the stated number of knots is 0")

    def tone(
        self,
        channel: int = 0,
        fraction: float = 1.0,
        phase: float = 0.0,
        *,
        frequency: int = 0,
        keep: bool = False,
        onset: Envelope | None = None,
        ending: Envelope | None = None,
    ) -> Command:
        """Build a command at a fraction of the test level; frequency in steps, 0 for the usual one.

        Raises NotApplicable for a level that the amplifier can round to 0.
        """
        level, step = round(fraction * self.level * FULL), self.can["level_step"]
        require(
            not 0 < level < step,
            f"level_step is coarser than {level / FULL:g}; raise --level",
        )
        numbers = frequency or self.frequency, level, QUANTITIES["phase"].to_wire(phase)
        return Command(channel, *numbers, keep, onset=onset, ending=ending)

    def one(
        self, *commands: Command, level: float = 1.0, ramp: int = 0, valid_for: int = 0
    ) -> LayerSet:
        """Build the content of layer 0, by default the usual tone on channel 0."""
        tones = commands or [self.tone(0, level)]
        return layer(0, *tones, ramp=ramp, valid_for=valid_for)

    def whole(self) -> LayerSet:
        """Build the usual tone on all channels."""
        return layer(0, *map(self.tone, self.channels))

    def transitions(self, ramp: int) -> list[list[Send]]:
        """Build a sequence of sets during which layers rise, fade, begin, end and wait."""
        slow = self.envelope(0.1, 0.25, 0.25, 0.25)
        tones = [self.beside(number, 0.25) for number in range(4)]
        begins = [replace(each, onset=slow) for each in tones]
        ends = [replace(each, ending=slow) for each in tones]
        other = self.beside(len(self.layers), 0.25)
        others = [layer(number, self.beside(number, 0.05)) for number in self.layers[4:]]
        changes = [
            layer(0, tones[0], ramp=ramp, valid_for=60_000),
            layer(1, ramp=ramp),
            layer(2, other, ramp=ramp),
            layer(3, tones[3], ramp=ramp),
        ]
        shaped = layer(0, begins[0]), layer(1, ends[1]), layer(2, ends[2]), layer(3, begins[3])
        return [
            [play_now(layer(1, tones[1]), layer(2, tones[2]), *others), play_now(*changes)],
            [play_now(*shaped), play_now(layer(2), layer(3, other, after=True))],
        ]

    def envelope(self, step: float, *amplitudes: complex) -> Envelope:
        """Build an envelope of knots in fractions of the test level, with the nearest possible step
        [s].

        Uses as many knots as the amplifier supports.
        """
        amplitudes = amplitudes[: self.can["knots"]]
        low, high = self.can["envelope_step_min"], self.can["envelope_step_max"]
        steps = min(max(QUANTITIES["envelope_step"].to_wire(step), low), high)
        phases = [math.degrees(math.atan2(each.imag, each.real)) for each in amplitudes]
        knots = [
            (round(abs(each) * self.level * FULL), QUANTITIES["phase"].to_wire(phase))
            for each, phase in zip(amplitudes, phases, strict=True)
        ]
        return Envelope(steps, tuple(knots))

    def beside(self, number: int, fraction: float) -> Command:
        """Build a tone on channel 0 that does not interfere with the tones of other layers."""
        return self.tone(0, fraction, frequency=self.apart(number))

    def near(self, number: int) -> int:
        """Return one of many close frequencies; all equal if there is no room."""
        room = max(self.highest - self.frequency, 0)
        return int(self.frequency + min(max(10, self.can["frequency_step"]) * number, room))

    def apart(self, number: int) -> int:
        """Return a separate frequency for a layer, so that layers do not interfere."""
        step = self.can["frequency_step"]
        above = self.frequency + max(40, step) * number
        highest = self.highest - (len(self.layers) - number) * step
        return int(max(min(above, highest), self.lowest))

    # Requests

    async def run(self, rows: RequestRows) -> None:
        """Carry out rows in order; after each, compare a status with the expected one.

        If the reply to the last request is a status, it is not used for this.
        """
        for at, row in enumerate(rows, 1):
            found: object = None
            match row:
                case float():
                    await self.pause(row)
                case LayerSet():
                    await self.play(row)
                case Send():
                    found = await self.send(row)
                case Sequence():
                    await self.in_time(partial(self._course, row))
                    continue
                case _:
                    found = await row()
            if at == len(rows) or not (
                isinstance(found, RequestOutcome) and "levels" in found.values
            ):
                await self.status()

    async def _course(self, rows: RequestRows) -> None:
        await self.arm()
        await self.run(rows)
        await self.follow()

    async def send(self, row: Send) -> RequestOutcome:
        """Send a request whose outcome must be one of its codes."""
        name, several = row.name, [row.values]
        if row.layers:
            token, now = row.values.get("token", 0), row.values["now"]
            parts = self.parts(*row.layers, token=token, now=now)
            several = [{**each, **row.values} for each in parts]
        codes = [each or _DONE for each in row.codes]
        for values in several:
            answer = await self.answer(name, row.raw, **values)
            if not _has_reply(name, row.raw, values):
                continue
            what = raw_text(name, row.raw) if row.raw else request_text(name, values)
            is_of_set = name == "Set" or (name == "Commit" and answer.code != "")
            if is_of_set and self.expected is not None and self.shown.sets.has_expired:
                require_in_time((answer.code or _DONE) in codes, f"a set expired before {name}")
            # Check this first: a message that is too short lacks some of its values.
            expect_one_of(answer.code or _DONE, codes, f"reply to {what}")
            if answer.code:
                break
            answer = await self._carried_out(name, self.filled(values), answer)
        is_named = self.client.kind not in ("rtu", "tcp") or answer.code not in _BY_EXCEPTION
        if answer.code and is_named:
            expect_one_of(answer.channel, row.channels, f"channel in the Nak to {what}")
        return answer

    async def answer(
        self, name: str, raw: Sequence[int] | None = None, **values: Any
    ) -> RequestOutcome:
        """Send a request from values or raw words, and return the outcome.

        A part other than the last has no reply; errors show in what arrives with the next message.
        """
        self._check_fed()
        message, values = MESSAGES[name], self.filled(values)
        has_reply = _has_reply(name, raw, values)
        self.is_at_rest = False
        if raw is None:
            try:
                raw = message.request.pack(values)
            except ValueError:  # beyond the table
                raw = [values[each] for each in message.request.names]
        if name == "Set":
            head = message.request.places["index"]  # session and token
            is_part = self.sent_set and [*self.sent_set[-1][:head]] == [*raw[:head]]
            self.sent_set = [*(self.sent_set if is_part else ()), raw]
        client, sent = self.client, threads.now()
        if not has_reply:
            self._parts.append((sent, values, len(raw)))
            await client.part(message.number, raw)
            return RequestOutcome("", None, (), When(sent, threads.now()))
        answer = await client.exchange(message.number, raw)
        self._check_fed()  # it can have been carried out after the watchdog tripped
        took = threads.now() - sent
        client.quiet = min(client.quiet, QUIET_TIME + took)
        before = self._parts_came(answer.when.latest)
        if self.expected is not None:
            self.expected.sets.expire(self.dating.interval(answer.when))
            if "index" in values and answer.code:
                self.expected.part_refused(values, answer.code)
        bits = client.wire_time(len(raw), len(answer.words))
        if not answer.code:  # a rejection can arrive earlier
            client.pace = min(client.pace, took / bits if bits else 0.0)
            client.fastest[name] = min(client.fastest.get(name, math.inf), took)
        beyond = max(took - client.pace * (before + bits), 0.0)
        count = 1 if name in _READ_ALONE else client.transactions
        reactions = client.reactions["refusals" if answer.code else name]
        reactions.append(beyond / count)
        client.lateness = max(client.lateness, beyond - count * min(reactions))
        self.heard_at = answer.when.latest
        return answer

    def moment(self, duration: float) -> int:
        """Return the high word of its clock `duration` [s] after its last status."""
        return round(self.shown.clock.present + duration / HIGH_TIME) % HIGH_WORDS

    def filled(self, values: Values) -> Values:
        """Return values completed by the default values of a request."""
        present = self.expected.clock.present if self.expected is not None else 0
        return {"session": self.session, "rate": 0, "shift": 0, "at": present, **values}

    def _parts_came(self, latest: float) -> float:
        """Mark the sent parts as received by a time [s]; returns their time on the wire."""
        made, self._parts = self._parts, []
        if made:
            expect_equal(len(self.client.heard), 0, "number of replies to parts before the last")
        for sent, part, _ in made if self.expected is not None else ():
            self.shown.part_came(part, self.dating.interval(When(sent, latest)))
        if self.client.transactions > 1:  # each had its response
            return 0.0
        return sum(self.client.wire_time(words, 0) for _, _, words in made)

    async def request(self, name: str, **values: Any) -> RequestOutcome:
        """Send a request that must be carried out; its reply must match the expected state."""
        return await self.send(send(name, **values))

    async def _carried_out(
        self, name: str, values: Values, answer: RequestOutcome
    ) -> RequestOutcome:
        """Parse the reply to a request, and compare it with the expected state."""
        record = STATED if name == "GetCaps" else MESSAGES[name].reply
        shown = read_as(f"reply to {name}", record.unpack, answer.words, is_strict=False)
        if name == "GetCaps":
            expect_equal(shown, self.can, "capabilities, read a second time")
        if "levels" in shown:
            for each in ("channels", "layers"):
                expect_equal(shown[each], self.can[each], f"number of {each} in Status")
        is_dated = self._is_dated(name, shown)
        answer = replace(answer, when=self._dated(name, values, shown, answer.when))
        if self.expected is not None:
            if name == "Set":
                self.token = values["token"]
                if self.token not in (self.expected.token, self.expected.sets.staged):
                    self.expected.sets.sent(values)
            if name == "Commit" or shown.get("played"):
                is_exact = shown.get("exact", self.expected.sets.is_exact)
                await self._learn_achieved(values["token"], is_exact=bool(is_exact))
            self.expected.granted(name, values, shown, answer.when)
            if is_dated:  # sets that start with the next sample can show already
                read = answer.when.latest - SAMPLE, answer.when.latest
                self.expected.clock.check(shown["clock"], read)
            self.is_starving = self.is_starving or name in ("Stop", "Disarm")
        return replace(answer, values=shown)

    def _is_dated(self, name: str, shown: Values) -> bool:
        """Return whether a reply contains the current clock."""
        is_marked = name == "Mark" or (self.expected and self.expected.clock.is_marked)
        return "clock" in shown and not is_marked

    def _dated(self, name: str, values: Values, shown: Values, when: When) -> When:
        """Return the interval, on the amplifier's clock, in which a status was true and its request
        carried out.

        The clock can be read after the request is carried out, except for GetStatus.
        """
        dating, judge = self.dating, self.expected
        between = dating.interval(when)
        if not self._is_dated(name, shown):
            return between
        if name == "Arm" and not (
            judge and judge.is_enabled and judge.session == values["session"]
        ):
            dating.shift(values["shift"])
        dated = dating.dated(shown["clock"], when, self.can["clock_error"])
        if shown["state"] != ENABLED:
            dating.pace = 1.0
        elif name == "Ping":
            dating.pace = 1 + values["rate"] * RATE_STEP
        return dated if name == "GetStatus" else dating.between(between.earliest, dated.latest)

    async def _learn_achieved(self, token: int, *, is_exact: bool) -> None:
        """Read the achieved values of a set that does not play exactly."""
        judge, played = self.shown, []
        layers = judge.sets.whole(token) if token != judge.token else None
        if layers is None or is_exact:
            return
        for one in layers:
            answer = await self.answer("GetAchieved", layer=one.layer)
            unpack = MESSAGES["GetAchieved"].reply.unpack
            shown = read_as("reply to GetAchieved", unpack, answer.words, is_strict=False)
            is_shown = shown["token"] == token and not one.renew
            played.append(judge.achieved(one, shown) if is_shown else one)
        judge.sets.replace(token, tuple(played))

    async def status(self) -> RequestOutcome:
        """Read the status; feed the watchdog if due."""
        if self.is_hungry:
            return await self.ping()
        return await self.request("GetStatus")

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
        self.session = self.client.session = self.next_session
        self.token, self.is_starving = 0, not is_fed
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
        return self.shown.latch or 0

    def _check_fed(self) -> None:
        """Raise TooLate if this machine can have missed the watchdog's deadline."""
        require_in_time(self._since_fed <= _MAX_WATCHDOG_USE, "the watchdog was not fed in time")

    @property
    def _since_fed(self) -> float:
        """Share of the watchdog time that has passed."""
        if self.is_starving or self.expected is None or self.expected.state != ENABLED:
            return 0.0
        return (threads.now() - self.expected.fed[0]) / self.expected.watchdog

    @property
    def is_hungry(self) -> bool:
        """Return whether the watchdog must be fed now."""
        return self._since_fed > 0.25

    async def unfed(self) -> None:
        """Feed the watchdog if due, so that it was fed a while ago and is not due soon."""
        if self._since_fed > _MAX_UNFED:
            await self.ping()
        await asyncio.sleep(max(self.shown.fed[1] + _UNFED - threads.now(), 0.0))

    async def starve(self) -> None:
        """From now on the watchdog may expire."""
        self.is_starving = True

    async def rest(self) -> None:
        """Bring it to silence, disarmed, nothing latched, and judge all replies from now on."""
        is_armed = self.expected is not None and self.expected.is_enabled
        self.expected, self.dating, self._parts = None, Dating(), []
        reply = await self.settle(await self.request("Disarm" if is_armed else "Stop", ramp=0))
        if reply["state"] != OFF:
            reply = await self.request("Clear", latch=reply["latch"])
            expect_equal(reply["state"], OFF, "state after Clear")
        self.expected, self.is_at_rest = Judge(self.can, reply.values, reply.when), True

    def require_alone(self) -> None:
        """Raise NotApplicable if a broadcast would reach other amplifiers."""
        where = ", ".join(map(str, sorted(self.client.neighbours)))
        require(not where, f"a broadcast would reach other amplifiers on the line ({where})")

    async def watch(self) -> None:
        """Judge all replies from now on, by the status as it is."""
        status = await self.request("GetStatus")
        self.expected = Judge(self.can, status.values, status.when)

    def parts(
        self, *layers: LayerSet, token: int = 0, now: int = 1, count: int = 1
    ) -> list[Values]:
        """Make the parts of a set but for their session; token: 0 for the next; count: at least."""
        if not token:
            token = self.token = self.token % 0xFFFF + 1
        ramp_max = self.can["ramp_max"]
        layers = tuple([replace(one, ramp=min(one.ramp, ramp_max)) for one in layers])
        stream = pack_layers(layers)
        max_words = math.ceil(len(stream) / count)
        made = parts(stream, session=1, token=token, now=bool(now), max_words=max_words)
        return [{name: each[name] for name in each if name != "session"} for each in made]

    def words_of(self, *layers: LayerSet) -> tuple[Values, list[int]]:
        """Return a single-part set that plays immediately, and its words."""
        (part,) = self.parts(*layers)
        words = MESSAGES["Set"].request.pack({"session": self.session, **part})
        self.sent_set = [words]
        return part, words

    def since(self, sent: float) -> When:
        """Return the interval from a time of this machine until now, by the amplifier's clock."""
        return self.dating.interval(When(sent, threads.now()))

    def played(self, part: Values, sent: float) -> None:
        """Record that a single-part set, sent at a given time, was carried out."""
        self.shown.sets.sent(part)
        self.shown.carry_out("Set", part, {}, self.since(sent))

    async def play(self, *layers: LayerSet) -> RequestOutcome:
        """Play a set immediately."""
        return await self.send(play_now(*layers))

    async def send_all(self, rows: Sequence[Send]) -> None:
        """Send requests in one go, without a look at the status between."""
        for row in rows:
            await self.send(row)

    async def commit_in(self, duration: float) -> int:
        """Commit the staged set for a moment a time [s] ahead of the last status; return that."""
        self._moment = self.moment(duration)
        await self.request("Commit", token=self.token, at=self._moment)
        return self._moment

    async def at(self, *layers: LayerSet, lead: float, apart: float = 0.0) -> None:
        """Play a set from a moment of its clock, `apart` [s] after the last such moment.

        lead: time by which the Commit precedes its moment [s], if apart is 0. Raises TooLate if the
        Commit can have arrived after its moment.
        """
        await self.send(stage(*layers))
        await self.commit_in(self._until_moment + apart if apart else lead)
        require_in_time(self._until_moment > HIGH_TIME, "a Commit arrived after its moment")
        await self.past_moment()

    async def past_moment(self, duration: float = 0.0) -> None:
        """Read statuses until a time [s] after the moment of the last Commit that named one."""
        while self._until_moment >= -duration:
            await self.status()

    def lead(self, count: int, duration: float) -> float:
        """How long before their moments some Commits are sent [s], which have a time [s] in all.

        By how late this run has been, but at least what an exchange takes, so that a machine that
        was late once leaves no amplifier without a verdict.
        """
        late = min(self.client.lateness, _MAX_LATENESS)
        least = 2.5 * self.exchange_time + _LEAD
        return max(least, min(least + late, duration / count))

    @property
    def _until_moment(self) -> float:
        """The time [s] from the last status until that moment, less than a step more or less."""
        return ahead(self._moment * HIGH_STEPS, self.shown.clock.present * HIGH_STEPS)

    # In time

    @property
    def exchange_time(self) -> float:
        """Shortest exchange [s] of the slowest message so far, or the allowed time if shorter.

        The bound keeps a slow amplifier from extending its own deadlines. An unknown delay of the
        line shows in a reading.
        """
        count, fastest, read = self.client.transactions, self.client.fastest, self.read_time
        slowest = max((fastest[each] for each in fastest if each not in _READ_ALONE), default=read)
        return min(slowest, count * REACTION + max(self.client.transit, count * read))

    @property
    def read_time(self) -> float:
        """The shortest exchange [s] so far of a message that only reads."""
        fastest = self.client.fastest
        return min((fastest[each] for each in _READ_ALONE if each in fastest), default=math.inf)

    @property
    def slowness(self) -> float:
        """By what times must be longer than those for a line with exchanges of 20 ms or less."""
        return max(min(self.exchange_time, _SLOWEST) / _PROMPT, 1.0)

    def lasting(self, milliseconds: int) -> int:
        """Return a time [ms] that is long against an exchange, as this one is on a quick line."""
        return math.ceil(milliseconds * self.slowness)

    @property
    def shortest_watchdog(self) -> int:
        """The shortest watchdog time [ms], or that in which it can be fed on a slow line."""
        fed = math.ceil(8_000 * min(self.exchange_time, _SLOWEST))
        return int(min(max(self.can["watchdog_min"], fed), self.can["watchdog_max"]))

    @property
    def ramp(self) -> int:
        """A ramp [ms] that is long against an exchange."""
        required = max(100, math.ceil(6_000 * min(self.exchange_time, 0.1)))
        return int(min(required, self.can["ramp_max"]))

    def require_ramp(self, duration: float = 0.0) -> None:
        """Raise NotApplicable unless a ramp can last for `duration` [s], or for a few exchanges."""
        duration = max(duration, 0.03 + 2 * min(self.exchange_time, 1.0))
        require(
            self.can["ramp_max"] >= 1000 * duration, f"ramp_max is shorter than {duration:.2g} s"
        )

    @property
    def long_onset(self) -> Envelope:
        """An onset with knots that is long against an exchange, as far as there are knots."""
        duration = max(0.2, 12 * min(max(self.exchange_time, self.client.transit / 2), 1.3))
        step_max = QUANTITIES["envelope_step"].from_wire(self.can["envelope_step_max"])
        self.require_knots()
        count = min(max(math.ceil(duration / step_max) - 1, 3), self.can["knots"])
        return self.envelope(duration / (count + 1), *([0.5, 1.0] * count)[:count])

    @property
    def short_onset(self) -> Envelope:
        """An onset with one knot, shorter than the long one where the line is quick enough."""
        return self.envelope(0.05, 1.0) if self.slowness == 1 else self.long_onset

    async def pause(self, duration: float) -> None:
        """Wait for a time [s], feeding the watchdog."""
        end = threads.now() + duration
        while (left := end - threads.now()) > 0:
            if self.is_hungry:
                await self.ping()
                continue
            is_fed = self.is_starving or self.shown.state != ENABLED
            await asyncio.sleep(left if is_fed else min(left, self.shown.watchdog / 8))
        self.heard_at = end
        require_in_time(threads.now() <= end + _OVERSLEPT, "a pause took too long")

    async def settle(self, reply: RequestOutcome | None = None) -> RequestOutcome:
        """Read statuses behind a reply until it is silent and in a state that lasts."""
        due, reply = threads.now() + _SETTLED, reply or await self.status()
        while any(reply["levels"]) or reply["state"] in (*_MOVING, ENABLED):
            seen = f"{name_of(STATES, reply['state'])}, levels {reply['levels']}"
            verify(threads.now() < due, "silence", expected=f"within {_SETTLED:g} s", seen=seen)
            await asyncio.sleep(_POLL)
            reply = await self.status()
        return reply

    async def follow(self, duration: float | None = None) -> None:
        """Read statuses for a time [s] after the last change; None: until all outputs have settled.

        Raises TooLate if this machine was too slow to observe the changes.
        """
        began = self.shown.outputs.began
        end = self.shown.outputs.settled_at(began[1]) + _SETTLING
        end = end if duration is None else began[0] + duration
        few = min(2 * self.exchange_time, 2.0)  # of a slow line
        end = max(end, threads.now() + min(few, 2 * self.read_time))
        time, seen = end - self.heard_at, 0
        pause = max(time / (2 * _SAMPLES) - min(self.exchange_time, 1.0), 0.0)
        while threads.now() < end + max(few, _SETTLING) * (seen < 2):
            reply = await self.status()
            width = reply.when.latest - reply.when.earliest + began[1] - began[0]
            is_narrow = width <= _NARROW + 2 * max(self.exchange_time, self.client.transit)
            seen += is_narrow
            await asyncio.sleep(pause * is_narrow)
        needed = max(min(_SAMPLES / 3, time / _EACH, time / (4 * self.exchange_time)), 2)
        require_in_time(seen >= needed, f"only {seen} Status replies were in time")

    async def in_time(self, case: Callable[[], Awaitable[object]]) -> None:
        """Try a case, each time from rest, until this machine was in time."""
        while True:
            began = threads.now()
            if not self.is_at_rest:
                await self.rest()
            try:
                await case()
                return
            except TooLate:
                if not self.client.was_late(began):
                    raise

    async def require_interference(self) -> None:
        """Raise NotApplicable unless levels show that tones at the same frequency cancel."""
        halves = [self.tone(0, 0.5, phase) for phase in (0.0, 180.0)]
        await self.play(*(layer(at, each) for at, each in enumerate(halves)))
        level = (await self.request("GetStatus"))["levels"][0]
        await self.play(*map(layer, range(2)))
        require(
            level <= 0.75 * self.level * FULL,  # phases may be rounded
            "the levels do not show that tones at the same frequency interfere",
        )
        self.shown.outputs.interferes = True


def raw_text(name: str, words: Sequence[int]) -> str:
    """Return a request with its raw words, as reasons name it."""
    return f"{name} with the words {' '.join(f'{word:04X}' for word in words)}"


def _has_reply(name: str, raw: Sequence[int] | None, values: Values) -> bool:
    """Whether a request has a reply: all but a part of a set that is not the last."""
    return name != "Set" or raw is not None or is_last(values)
