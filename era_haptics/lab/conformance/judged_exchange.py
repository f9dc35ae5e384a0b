"""Requests to the amplifier under test, and the comparison of its replies with the expected state.

A request is carried out in this order:

1. Require that this machine has fed the watchdog in time (`WatchdogFeeding`).
2. Complete the values by defaults, and pack the words.
3. Send the frames. A part of a set other than the last has no reply: it is pending.
4. Await the reply, and require again that the watchdog was fed.
5. The pending parts have arrived between their sending and this reply.
6. Expire sets that are too old, and drop the parts of a set that was rejected.
7. Record the duration of the exchange (`ExchangeTiming`).
8. Compare the code, and the channel of a rejection, with those that are allowed.
9. Convert the time of the reply to the amplifier's clock (`Dating`), and compare the values with
   the expected state (`Judge`).

A difference raises ContractViolation; a deadline that this machine has missed raises TooLate.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from drivers.protocol.definition import ENABLED, MESSAGES, QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import is_last
from drivers.wires.wire import reply_words
from era_haptics.lab.conformance.capabilities import STATED, Capabilities
from era_haptics.lab.conformance.conformance_sets import ConformanceSets
from era_haptics.lab.conformance.dating import Dating
from era_haptics.lab.conformance.judge import Judge
from era_haptics.lab.conformance.judge_client import (
    JUDGE_REPLY_TIMEOUT,
    JudgeClient,
    RequestOutcome,
)
from era_haptics.lab.conformance.outcomes import (
    expect_equal,
    expect_one_of,
    read_as,
    require_in_time,
)
from era_haptics.lab.conformance.request_rows import Send, send
from era_haptics.lab.conformance.stimuli import Stimuli
from era_haptics.lab.conformance.watchdog_feeding import WatchdogFeeding
from era_haptics.lab.expectations.expected_amplifier import request_text
from era_haptics.lab.expectations.tolerances import SAMPLE, Interval
from registry import threads

RATE_STEP = 1 / QUANTITIES["rate"].per_unit
"""Relative change of the clock per step of a Ping's rate."""

_DONE = "carried out"
_BY_EXCEPTION = ("UNKNOWN_TYPE", "BAD_LENGTH")  # on Modbus, rejections without a channel


class SentPart(NamedTuple):
    """Part of a set that has no reply of its own: time sent [s], values, number of words."""

    sent_at: float
    values: Values
    words: int


class JudgedExchange(Stimuli):
    """Identified amplifier behind a client, whose replies are compared with the expected state.

    Until the amplifier was brought to rest, its state is unknown and replies are only parsed.
    """

    def __init__(
        self, client: JudgeClient, identity: Values, can: Capabilities, max_level: float
    ) -> None:
        super().__init__(client, can, max_level)
        self.identity = identity
        """Reply to Hello."""
        self.session = 1
        """Session begun last."""
        self.sets = ConformanceSets(can)
        self.feeding = WatchdogFeeding()
        self.dating = Dating()
        """Converts times to the amplifier's clock."""
        self.is_at_rest = False
        """Whether nothing was sent since the amplifier was brought to rest."""
        self.heard_at = threads.now()
        """Time of the last reply [s]."""
        self._pending_parts: list[SentPart] = []
        client.quiet = JUDGE_REPLY_TIMEOUT
        client.reply_words = {
            message.number: reply_words(name, can["channels"], can["layers"])
            for name, message in MESSAGES.items()
        }

    @property
    def judge(self) -> Judge:
        """Expected state."""
        if self._judge is None:
            raise RuntimeError("the amplifier is not judged before it was brought to rest")
        return self._judge

    @property
    def _judge(self) -> Judge | None:
        """Expected state, None until the amplifier was brought to rest."""
        return self.feeding.judge

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
        set_parts = self.sets.parts(*row.layers, token=token, now=row.values["now"])
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
        self.feeding.require_fed()
        number = MESSAGES[name].number
        values = self.filled(values)
        words = _words_of(name, values) if raw is None else raw
        self.is_at_rest = False
        if name == "Set":
            self.sets.note_sent(words)
        sent_at = threads.now()
        if not _has_reply(name, raw, values):
            self._pending_parts.append(SentPart(sent_at, values, len(words)))
            await self.client.part(number, words)
            return RequestOutcome("", None, (), Interval(sent_at, threads.now()))
        reply = await self.client.exchange(number, words)
        self.feeding.require_fed()  # it can have been carried out after the watchdog tripped
        duration = threads.now() - sent_at
        parts_time = self._parts_received(reply.when.latest)
        if self._judge is not None:
            self._judge.sets.expire(self.dating.interval(reply.when))
            if "index" in values and reply.code:
                self._judge.part_refused(values, reply.code)
        self.timing.note(name, reply, duration, len(words), parts_time)
        self.heard_at = reply.when.latest
        return reply

    def filled(self, values: Values) -> Values:
        """Return values completed by the default values of a request."""
        present = 0 if self._judge is None else self._judge.clock.present
        return {"session": self.session, "rate": 0, "shift": 0, "at": present, **values}

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
            if name in ("Stop", "Disarm"):
                self.feeding.starve()
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
        token = values["token"]
        self.sets.token = token
        if token not in (judge.token, judge.sets.staged):
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
