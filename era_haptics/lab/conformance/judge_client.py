"""Raw protocol client for conformance checks: one message at a time, no retries, no recovery.

There is one client class per kind of wire, which builds and parses frames. Messages that no request
was waiting for are kept for the checks. A check ends with one of three outcomes: a violation of the
contract, not applicable, or too late (this machine missed a deadline).

`Dating` converts to times of the amplifier's own clock, however late this machine was: a reading
that shows u seconds was taken between s and r, so the amplifier's clock is ahead of this machine's
by u - r to u - s. The intersection of all these intervals is short.

`Capabilities` are the amplifier's own statement, `Row` is a request of a check, and `Judge` is the
expected state of the amplifier.
"""

import asyncio
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeAlias, TypeVar

from drivers import trace
from drivers.errors import LinkError
from drivers.protocol.definition import (
    CLOCK_UNKNOWN,
    FEATURES,
    HIGH_STEPS,
    MESSAGES,
    NAK,
    NAK_RECORD,
    QUANTITIES,
    REACTION,
    REQUEST_NAMES,
    SPAN,
    ahead,
    capability_ranges,
)
from drivers.protocol.records import Field, Number, Record, Refusal, Values
from drivers.protocol.records import Rows as RowsOf
from drivers.protocol.sets import Command, LayerSet, achieved_layer, achieved_problem
from drivers.wires.wire import read_nak
from era_haptics.lab.expected_amplifier import ExpectedAmplifier
from era_haptics.lab.expected_output import DRIFT, Interval
from registry import threads


class CheckOutcome(Exception):
    """Ends the steps of a check; this class itself means that nothing is wrong.

    seen, expected: of a violation; sent: the last set before it, in words and hexadecimal; came:
    the last bytes received from the amplifier.
    """

    seen = expected = sent = came = ""


class ContractViolation(CheckOutcome):
    """The amplifier violates the contract; holds the name, the expected and the seen value."""

    def __init__(self, what: str, *, expected: object, seen: object) -> None:
        must, got = (
            "none" if isinstance(each, Sized) and not each else str(each)
            for each in (expected, seen)
        )
        self.expected, self.seen = must, f"{what}: {got}"
        super().__init__(f"{what} must be {must}, got {got}")


class NoReply(ContractViolation):
    """The amplifier did not reply in time; holds the request and the bytes received instead."""

    def __init__(self, what: str, seen: str) -> None:
        super().__init__(what, expected="a reply", seen=seen)
        self.args = (self.seen,)


class AlreadyArmed(ContractViolation):
    """The amplifier is armed already, perhaps by another host: nothing is driven."""


class UntimedClock(ContractViolation):
    """The amplifier's clock does not follow time, so playback cannot be judged."""


class NotApplicable(CheckOutcome):
    """The amplifier or its wire lacks an optional feature that the check needs."""


class UnusableCapability(CheckOutcome):
    """A capability that the check needs is invalid; its own check reports this."""


class TooLate(CheckOutcome):
    """This machine was too late for the check, which must be repeated."""


def message_name(number: int) -> str:
    """Return a message's name with its number, or the number if it has no name."""
    name = REQUEST_NAMES.get(number)
    return f"{name} (message {number})" if name else f"message {number}"


def require(is_possible: bool, why: str) -> None:
    """Raise NotApplicable, with the reason, if the check is impossible."""
    if not is_possible:
        raise NotApplicable(why)


def require_in_time(is_in_time: bool, why: str) -> None:
    """Raise TooLate, with the reason, if this machine was late."""
    if not is_in_time:
        raise TooLate(why)


def verify(condition: bool, what: str, *, expected: object, seen: object) -> None:
    """Raise ContractViolation unless the condition holds."""
    if not condition:
        raise ContractViolation(what, expected=expected, seen=seen)


def expect_equal(seen: object, expected: object, what: str) -> None:
    """Raise ContractViolation unless both are equal."""
    verify(seen == expected, what, expected=expected, seen=seen)


def expect_within(seen: float, low: float, high: float, what: str) -> None:
    """Raise ContractViolation unless a number is within limits (inclusive)."""
    verify(low <= seen <= high, what, expected=f"{low:.6g} to {high:.6g}", seen=f"{seen:.6g}")


def expect_one_of(seen: object, known: Collection[object], what: str) -> None:
    """Raise ContractViolation unless a value is one of the known ones."""
    verify(seen in known, what, expected=" or ".join(map(str, known)), seen=seen)


_MAX_ATTEMPTS = 20  # per check with all its cases, if this machine is late
FEW = 3
"""Number of occurrences that exclude chance lateness of this machine."""
_MAX_WASTED = 20.0  # s per run, for attempts that came too late
_LOOK = 0.005  # s, interval at which this machine's lateness is measured
BUSY = 0.02
"""Lateness of this machine [s] up to which a finding that recurs `FEW` times counts."""
JUDGE_REPLY_TIMEOUT = (
    0.5  # s; far above the reaction time, so that a busy machine does not look like a missing reply
)
_DELIVERED = 1.5  # s, in addition, for a reply delayed by the machine or the line
GATEWAY_TIMEOUT = 1.5  # s, within which a gateway reports that a unit does not reply
_MAX_SHOWN = 300  # bytes
_AT_ONCE = 16  # addresses
_SILENCE = 0.002  # s; between frames
QUIET_TIME = 0.02  # s, in addition to the time of an exchange, within which a reply arrives
_T = TypeVar("_T")


class When(NamedTuple):
    """Interval in which something happened [s]."""

    earliest: float
    latest: float


@dataclass(frozen=True, slots=True)
class HeardMessage:
    """Message from the amplifier: number of its request (0: an event), type, words.

    frame: the wire's frame that contained it. Without a type, the bytes were not a valid frame.
    """

    at: float
    number: int
    type: int
    words: tuple[int, ...]
    frame: Any = None


@dataclass(frozen=True, slots=True)
class RequestOutcome:
    """Outcome of a request: error code (empty if it was carried out) and words of the reply.

    channel: named by a rejection; when: between sending and the reply [s]; values: decoded words.
    """

    code: str
    channel: int | None
    words: tuple[int, ...]
    when: When
    values: Values = field(default_factory=dict)

    def __getitem__(self, name: str) -> Any:
        """Return a value."""
        return self.values[name]


class JudgeClient(ABC):
    """One amplifier at an address of a line.

    - number: of the last request; session: begun last.
    - heard: messages that no request was waiting for, except Events; order: all messages as
      received.
    - known: the expected amplifier, once identified.
    - reply_words: longest reply to each message by message number, if known.
    - quiet: time within which a reply arrives [s]; timeout: how long a reply is awaited [s].
    - wire_time: time on the wire for a request and a reply, from their word counts [s]; transit:
      that of the longest reply; pace: fraction of wire_time that the line really takes, at most (a
      terminal has no bit times).
    - loss: why the line was lost; came: bytes received since the last request.
    - neighbours: other addresses that reply; free: the highest address without a reply. Both are
      set by `look_around`.
    - fastest: shortest exchange by message name [s]; reactions: times until a reply began [s].
    - attempts: repetitions of the current check because of lateness; wasted: their total time in
      the run [s].
    - lag: this machine's largest lateness in an attempt [s]; lateness: the largest lateness of this
      machine or a reply in the run [s].
    """

    kind: ClassVar[str]
    """Kind of wire: serial, rtu, tcp or can."""
    has_events: ClassVar[bool] = True
    """Whether the wire carries unsolicited messages."""
    has_broadcasts: ClassVar[bool] = True
    """Whether one request can reach all addresses."""
    addresses: ClassVar[int] = 247
    """The highest address."""
    transactions: ClassVar[int] = 1
    """Number of transactions, each with a reply, that the wire needs for a request that writes."""

    transmit: Callable[[bytes], None]
    """Sends bytes on the open line; raises LinkError."""
    name = ""
    """name for the trace of its bytes"""

    def __init__(self, address: int) -> None:
        self.address = address
        self.number = 0
        self.heard: list[HeardMessage] = []
        self.order: list[HeardMessage] = []
        self.known: object = None
        self.reply_words: dict[int, int] = {}
        self.wire_time: Callable[[int, int], float] = lambda words, reply: 0.0
        self.transit, self.pace = 0.0, 1.0
        self.timeout = JUDGE_REPLY_TIMEOUT
        self.came = b""
        self.neighbours: frozenset[int] = frozenset()
        self.free = self.attempts = 0
        self.fastest: dict[str, float] = {}
        self.reactions: dict[str, list[float]] = defaultdict(list)
        self.wasted = self.lag = self.lateness = 0.0
        self.quiet = QUIET_TIME
        self.session = 0
        self.loss: str | None = None
        self._others: set[int] = set()
        self._news = asyncio.Event()

    def received(self, data: bytes) -> None:
        """Take bytes from the port."""
        trace.frame(trace.Direction.IN, data, self.name, str)
        self.came = (self.came + self.hear(data))[-_MAX_SHOWN:]

    def write(self, data: bytes) -> None:
        """Send bytes; raises LinkError."""
        trace.frame(trace.Direction.OUT, data, self.name, str)
        self.transmit(data)

    @abstractmethod
    def hear(self, data: bytes) -> bytes:
        """Parse messages from bytes; returns the bytes that came from the amplifier."""

    @abstractmethod
    def question(self, address: int) -> bytes:
        """Return the frame of a read-only request to an address."""

    @abstractmethod
    async def hello(self) -> Values:
        """Read the identity; raises ContractViolation."""

    async def exchange(self, number: int, words: Sequence[int], **more: Any) -> RequestOutcome:
        """Send a message and await its reply; raises ContractViolation without a reply.

        more: keyword arguments of `request`.
        """
        data, sent = self.request(number, words, **more), threads.now()
        self.write(data)
        sequence = self.number
        heard = await self.replied(lambda each: each.number == sequence, message_name(number))
        outcome = RequestOutcome("", None, heard.words, When(sent, heard.at))
        if heard.type == NAK:
            outcome = self.refusal(sent, heard.at, number, heard.words)
        self.check_reply(heard, NAK if outcome.code else number, outcome.code)
        return outcome

    def check_reply(self, heard: HeardMessage, number: int, code: str) -> None:
        """Check the type of a reply, and the fields added by the wire; code: of a rejection."""
        expect_equal(heard.type, number, "type of a reply")

    async def part(self, number: int, words: Sequence[int]) -> None:
        """Send a message without a reply: a part of a set other than the last."""
        self.write(self.request(number, words))

    @abstractmethod
    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frames of a request; to: its address, 0 for broadcast, None for this
        amplifier.

        Also increments `number`, the request's number.
        """

    @abstractmethod
    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield damaged frames, each with a description, which must have no effect and no reply."""

    async def look_around(self) -> None:
        """Find the other amplifiers on the line by read-only requests, once.

        On wires with broadcasts all addresses are queried, otherwise only until one is free.
        Addresses are queried in batches, and individually within a batch that produced a reply.
        """
        if self.free:
            return
        addresses = [each for each in range(self.addresses, 0, -1) if each != self.address]
        for batch in in_batches(addresses, _AT_ONCE if self.has_broadcasts else 1):
            is_heard = await self._is_heard(batch)
            for each in batch if is_heard and self.is_shared else ():
                if await self._is_heard([each]) and not self.heard:  # several at this address
                    self._others.add(each)
            if not (self.has_broadcasts or is_heard):
                break
        await asyncio.sleep(self.quiet)  # a late reply arrives meanwhile
        self.heard.clear()
        self.free = next((each for each in addresses if each not in self._others), 0)
        verify(self.free > 0, "addresses without a reply", expected="one at least", seen="none")
        self.neighbours = self.neighbours or frozenset(self._others)

    async def _is_heard(self, addresses: Sequence[int]) -> bool:
        """Return whether there is any reply after querying addresses one after the other."""
        self.heard.clear()
        self.came = b""
        for each in addresses:
            self.write(self.question(each))
            await asyncio.sleep(_SILENCE + self.wire_time(0, 0))
        await asyncio.sleep(REACTION + self.transit if self.has_broadcasts else GATEWAY_TIMEOUT)
        return bool(self.heard or (self.came and self.is_shared))

    @property
    def is_shared(self) -> bool:
        """Return whether replies of several amplifiers can collide."""
        return self.kind in ("serial", "rtu")

    @property
    def slow_reply(self) -> str:
        """Return which message it always answers too late, and by when; empty if none."""
        for name, times in self.reactions.items():
            if len(times) >= FEW and (least := min(times)) > REACTION:
                return f"its replies to {name} begin after at least {1e3 * least:.3g} ms"
        return ""

    @property
    def is_used_up(self) -> bool:
        """Return whether the run's time for late attempts is used up."""
        return self.wasted >= _MAX_WASTED

    def was_late(self, since: float) -> bool:
        """Record an attempt that began at `since` and was late; returns whether to repeat it."""
        if self.slow_reply:
            return False
        self.attempts = min(self.attempts + 1, _MAX_ATTEMPTS)
        self.wasted += threads.now() - since
        return self.attempts < _MAX_ATTEMPTS and not self.is_used_up

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Measure this machine's lateness within the context."""

        async def look() -> None:
            while True:
                due = threads.now() + _LOOK
                await asyncio.sleep(_LOOK)
                self.lag = max(self.lag, late := threads.now() - due)
                self.lateness = max(self.lateness, late)

        self.attempts, self.lag = 0, 0.0
        looking = asyncio.create_task(look(), name="how late this machine is")
        try:
            yield
        finally:
            looking.cancel()

    def lost(self, cause: str) -> None:
        """Record why the line was lost."""
        self.loss = cause

    async def expect_silence(self, data: bytes, what: str, *before: bytes) -> None:
        """Send frames (data last) that must produce no message."""
        heard = await self.send(data, *before)
        verify(not heard, f"replies to {what}", expected="none", seen=heard)

    async def send(self, data: bytes, *before: bytes, count: int = 0) -> list[HeardMessage]:
        """Send frames (data last); return the messages received until a reply must have arrived.

        count: number of replies that must arrive, for which the wait is longer.
        """
        self.heard.clear()
        self.came = b""
        for each in before:
            self.write(each)
            await asyncio.sleep(self.quiet / 4)  # also ends a Modbus RTU frame
        self.write(data)
        replies = [await self.next(lambda each: True, self.timeout) for _ in range(count)]
        await asyncio.sleep(self.quiet)
        heard, self.heard = [*filter(None, replies), *self.heard], []
        return heard

    async def reply_to(self, data: bytes) -> HeardMessage | None:
        """Send frames and return the first message, however late; None without one."""
        self.write(data)
        return await self.next(lambda each: True, self.timeout)

    def take(self, message: HeardMessage, *, is_event: bool = False) -> None:
        """Keep a received message."""
        if not is_event:
            self.heard.append(message)
        self.order.append(message)
        self._news.set()

    async def next(
        self, is_meant: Callable[[HeardMessage], bool], timeout: float
    ) -> HeardMessage | None:
        """Return the first matching message; None if no message arrives in time [s]."""
        self.came = b""
        loop, due = asyncio.get_running_loop(), threads.now() + timeout
        timer = loop.call_at(due, self._news.set)
        try:
            while True:
                for message in self.heard:
                    if is_meant(message):
                        self.heard.remove(message)
                        return message
                if self.loss is not None:
                    raise LinkError(self.loss)
                if threads.now() >= due:
                    return None
                self._news.clear()
                await self._news.wait()
        finally:
            timer.cancel()

    async def replied(self, is_meant: Callable[[HeardMessage], bool], what: str) -> HeardMessage:
        """Return the reply to the last request.

        Raises ContractViolation without a reply; a late reply counts as lateness of this machine.
        """
        began = threads.now()
        found = await self.next(is_meant, self.timeout)
        if found is not None:
            return found
        others = f", but {len(self.came)} other bytes{self.remark()}" if self.came else ""
        is_sound = not others or any(each.at > began for each in self.order[-1:])
        if is_sound and await self.next(is_meant, _DELIVERED):
            self.lag, others = max(self.lag, self.timeout), ", but later"
        raise NoReply(what, f"no reply within {self.timeout:g} s{others}")

    def remark(self) -> str:
        """Describe what is wrong with bytes received instead of a reply, if known."""
        return ""

    def refusal(
        self, sent: float, came: float, number: int, words: Sequence[int]
    ) -> RequestOutcome:
        """Convert a Nak to an outcome; raises ContractViolation if it names another request."""
        nak = read_as("Nak", read_nak, words, is_strict=True)
        expect_equal(words[NAK_RECORD.places["request"]], number, "request that a Nak names")
        return RequestOutcome(nak.code, nak.channel, (), When(sent, came))


def in_batches(rows: Sequence[_T], size: int) -> list[Sequence[_T]]:
    """Split rows into batches; the last batch can be shorter."""
    return [rows[at : at + size] for at in range(0, len(rows), size)]


def altered(data: bytes, at: int) -> bytes:
    """Return bytes with one bit flipped."""
    changed = bytearray(data)
    changed[at] ^= 0x10
    return bytes(changed)


def read_as(what: str, read: Callable[..., _T], *arguments: object, **options: object) -> _T:
    """Return the value that `read` returns; raises ContractViolation if it cannot be parsed."""
    try:
        return read(*arguments, **options)
    except Refusal as error:
        raise ContractViolation(what, expected="as in the table", seen=error) from None


_LONG = 5.0  # s without a reading, after which the clock can have wrapped
_BESIDE = 0.0002  # s; levels in a status can be older than its clock by this
_ERROR = QUANTITIES["clock_error"]


class Dating:
    """Convert times [s] to the clock of an amplifier, which starts near this machine's time.

    pace: seconds of the clock per second of its crystal. error: largest contradiction between
    readings beyond the allowed drift, since it was reset to 0.
    """

    def __init__(self) -> None:
        self.pace, self.error = 1.0, 0.0
        self._last: tuple[int, float] | None = (
            None  # last clock reading and the end of its interval
        )
        self._time, self._ahead = 0.0, (0.0, 0.0)  # of the last reading; ahead of this machine's

    def shift(self, steps: int) -> None:
        """Advance the clock by steps of its high word."""
        if self._last is not None:
            self._last = (self._last[0] + steps * HIGH_STEPS) % SPAN, self._last[1]

    def expect_steady(self, otherwise: type[ContractViolation] = ContractViolation) -> None:
        """Raise ContractViolation (or `otherwise`) if readings contradict each other."""
        if self.error > 0:
            what = "contradiction between readings of its clock"
            raise otherwise(what, expected="0 ms", seen=f"{1e3 * self.error:.3g} ms")

    def between(self, earliest: float, latest: float) -> When:
        """Return an interval; raises ContractViolation for an empty one."""
        if earliest > latest:
            self.expect_steady()
        return When(min(earliest, latest), latest)

    def interval(self, when: When) -> When:
        """Convert an interval of this machine after the last reading."""
        if self._last is None:
            return when
        drift = DRIFT * max(when.latest - self._last[1], 0.0)
        low, high = self._ahead
        return self.between(
            max(when.earliest + low - drift, self._time), when.latest + high + drift
        )

    def dated(self, clock: int, when: When, stated: int) -> When:
        """Return when a status with this clock, read in an interval of this machine, was true.

        stated: `clock_error` of the amplifier.
        """
        if stated == CLOCK_UNKNOWN:
            return when
        last, self._last = self._last, (clock, when.latest)
        if last is None or when.latest - last[1] > _LONG:
            self._time = sum(when) / 2
            self._ahead = self._time - when.latest, self._time - when.earliest
            return when
        passed, slack = ahead(clock, last[0]) / self.pace, _ERROR.from_wire(stated)
        drift = DRIFT * abs(passed)
        self._time += passed
        first, latest = self._time - when.latest - slack, self._time - when.earliest + slack
        low, high = max(self._ahead[0] - drift, first), min(self._ahead[1] + drift, latest)
        self.error = max(self.error, low - high)
        self._ahead = (low, high) if low <= high else (first, latest)
        return When(self._time - _BESIDE, self._time)


@dataclass(frozen=True, slots=True)
class Send:
    """Request from values (with the held session unless another is given) or from raw words.

    layers: of a set, which is sent in parts. codes: allowed outcomes, "" meaning carried out.
    channels: those that a rejection can name.
    """

    name: str
    raw: Sequence[int] | None
    values: Values
    layers: tuple[LayerSet, ...]
    codes: tuple[str, ...]
    channels: tuple[int | None, ...]


Row: TypeAlias = "LayerSet | Send | float | Callable[[], Awaitable[object]] | Sequence[Row]"
"""A layer to play, a request, a pause [s] with a fed watchdog, an awaitable, or a sequence.

A sequence of rows starts at rest and armed, and is followed until all outputs have settled.
"""
RequestRows: TypeAlias = Sequence[Row]


def send(
    name: str,
    *,
    raw: Sequence[int] | None = None,
    code: str | tuple[str, ...] = "",
    channels: tuple[int | None, ...] = (None,),
    layers: tuple[LayerSet, ...] = (),
    **values: Any,
) -> Send:
    """Build a request that must be carried out, or rejected with a code."""
    return Send(name, raw, values, layers, (code,) if isinstance(code, str) else code, channels)


def play_now(*layers: LayerSet, now: int = 1, **values: Any) -> Send:
    """Build a set that plays immediately; values: token, session, code, as in `send`."""
    return send("Set", layers=layers, now=now, **values)


stage = partial(play_now, now=0)
"""Build a set that is staged."""

_WORD = 0xFFFF


def _unlimited(field: Field) -> Field:
    """Return a copy of a field without limits on its numbers, except for channels."""
    if isinstance(field, RowsOf):
        return replace(field, record=Record(*map(_unlimited, field.record.fields)))
    if isinstance(field, Number) and field.name != "channels":
        lowest = int(field.is_added)  # 0: not stated
        return replace(field, quantity=replace(field.quantity, minimum=lowest, maximum=_WORD))
    return field


_REPLY = MESSAGES["GetCaps"].reply
(_LIMITS,) = (field.record for field in _REPLY.fields if isinstance(field, RowsOf))
STATED = Record(*map(_unlimited, _REPLY.fields))
"""Reply to GetCaps; any word is accepted as a number, so that wrong ones can be reported."""


def _ranges(can: Values) -> Iterator[tuple[str, int, int, int]]:
    """Yield the name, value, minimum and maximum of each number."""
    rows = [(_REPLY, can), *((_LIMITS, one) for one in can["limits"])]
    for record, row in rows:
        for word in record.fields:
            if isinstance(word, Number) and row[word.name] is not None:
                name = word.name if record is _REPLY else "limits"
                yield name, word.quantity.minimum, row[word.name], word.quantity.maximum
    yield from capability_ranges(can)
    yield "features", 0, can["features"], (2 << max(FEATURES.values())) - 1
    for one in can["limits"]:
        low, high = one["frequency_min"], one["frequency_max"]
        yield "limits", can["frequency_min"], low, high
        yield "limits", low, high, can["frequency_max"]
        yield "limits", 1, one["level_max"], can["level_max"]


class Capabilities(dict[str, Any]):
    """Capabilities by name; wrong: the invalid ones, each with the required and the stated value.

    Raises UnusableCapability on access to an invalid one, so that checks without it can run.
    """

    def __init__(self, stated: Values) -> None:
        super().__init__(stated)
        self.wrong: dict[str, tuple[str, int]] = {}
        for name, low, seen, high in _ranges(stated):
            if not low <= seen <= high:
                self.wrong.setdefault(name, (f"{low} to {high}", seen))

    def __getitem__(self, name: str) -> Any:
        """Return a capability."""
        if name in self.wrong:
            must, seen = self.wrong[name]
            raise UnusableCapability(f"its {name} must be {must}, got {seen}")
        return super().__getitem__(name)


FULL = QUANTITIES["level"].per_unit


def layer(
    number: int,
    *commands: Command,
    ramp: int = 0,
    valid_for: int = 0,
    after: bool = False,
    renew: bool = False,
) -> LayerSet:
    """Build the content of a layer; ramp, valid_for in ms."""
    return LayerSet(number, ramp, valid_for, commands, after, renew)


class Judge(ExpectedAmplifier):
    """Expected state of an amplifier with these capabilities, starting from a status at rest.

    Raises ContractViolation and TooLate.
    """

    def __init__(self, can: Values, rest: Values, when: Interval) -> None:
        unclear = partial(require_in_time, False)
        super().__init__(self._wrong, self._wrong, unclear=unclear, may_fail=False)
        self.identified(can)
        self.check(rest, when)

    def _wrong(self, rule: str, time: float, what: str, *, must: object, seen: object) -> None:
        raise ContractViolation(what, expected=must, seen=seen)

    def achieved(self, one: LayerSet, shown: Values) -> LayerSet:
        """Return a layer as achieved according to GetAchieved.

        Raises ContractViolation if a value differs by more than half a step.
        """
        driven = tuple(tone for tone in one.commands if tone.is_driven)
        one = replace(one, commands=driven)
        if problem := achieved_problem(one, shown, self.can, is_exact=False):
            rule, what, must, seen = problem
            self.report(rule, 0.0, f"{what} in layer {one.layer}", must=must, seen=seen)
        return achieved_layer(one, shown, self.can)
