"""A host below the host: one raw message at a time, and the findings that end a check.

A client of a kind of wire makes frames and reads them. It repeats nothing and gives nothing up by
itself; it keeps messages that no request was waiting for, so that checks see them. A check finds a
violation of the contract, that it does not apply, or that this machine was too late.

`Dating` gives times by the amplifier's own clock, however late this machine was: a reading that
shows u seconds came between s and r, so the clock is ahead of that of this machine by u - r to
u - s. What is common to all these intervals is short.

`Capabilities` are what the amplifier states, `Row` what a check sends, and `Judge` the amplifier as
it must be.
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
    """What ends the steps of a check; by itself: nothing is wrong.

    seen, expected: of a violation; sent: the last set before it, in words and hexadecimal; came:
    the last bytes of the amplifier.
    """

    seen = expected = sent = came = ""


class ContractViolation(CheckOutcome):
    """The amplifier does other than the contract: what must be what, and what was seen."""

    def __init__(self, what: str, *, expected: object, seen: object) -> None:
        must, got = (
            "none" if isinstance(each, Sized) and not each else str(each)
            for each in (expected, seen)
        )
        self.expected, self.seen = must, f"{what}: {got}"
        super().__init__(f"{what} must be {must}, got {got}")


class NoReply(ContractViolation):
    """It did not reply in time: to what, and what came instead."""

    def __init__(self, what: str, seen: str) -> None:
        super().__init__(what, expected="a reply", seen=seen)
        self.args = (self.seen,)


class AlreadyArmed(ContractViolation):
    """It is armed, perhaps by another host: nothing is driven."""


class UntimedClock(ContractViolation):
    """Its clock does not go on with time: nothing that plays can be judged."""


class NotApplicable(CheckOutcome):
    """The amplifier, or its wire, does not have what is checked, as the contract allows."""


class UnusableCapability(CheckOutcome):
    """A capability that the check needs is not as it must be, which its own check reports."""


class TooLate(CheckOutcome):
    """This machine was too late for what the check needs: it must be made again."""


def message_name(number: int) -> str:
    """Return the name of a message with its number, or the number of one without a name."""
    name = REQUEST_NAMES.get(number)
    return f"{name} (message {number})" if name else f"message {number}"


def require(is_possible: bool, why: str) -> None:
    """Raise NotApplicable, with the reason, unless the check can be made."""
    if not is_possible:
        raise NotApplicable(why)


def require_in_time(is_in_time: bool, why: str) -> None:
    """Raise TooLate, with the reason, unless this machine was in time."""
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
    """Raise ContractViolation unless a number is within limits."""
    verify(low <= seen <= high, what, expected=f"{low:.6g} to {high:.6g}", seen=f"{seen:.6g}")


def expect_one_of(seen: object, known: Collection[object], what: str) -> None:
    """Raise ContractViolation unless something is known."""
    verify(seen in known, what, expected=" or ".join(map(str, known)), seen=seen)


_MAX_ATTEMPTS = 20  # of a check with all its cases, for which this machine was late
FEW = 3
"""Times that this machine does not make wrong by chance."""
_MAX_WASTED = 20.0  # s; of a run, for attempts that came too late
_LOOK = 0.005  # s; between looks whether this machine is late
BUSY = 0.02
"""Lateness of this machine [s] with which what is found counts once it is found a few times."""
JUDGE_REPLY_TIMEOUT = 0.5  # s; far above the reaction, so that a busy machine is no mute amplifier
_DELIVERED = 1.5  # s; beyond that, for a reply which the machine or line delivers late
GATEWAY_TIMEOUT = 1.5  # s; in which a gateway says that a unit does not reply
_MAX_SHOWN = 300  # bytes
_AT_ONCE = 16  # addresses
_SILENCE = 0.002  # s; between frames
QUIET_TIME = 0.02  # s; beyond the time of an exchange, in which what is replied to has its reply
_T = TypeVar("_T")


class When(NamedTuple):
    """An interval in which something happened [s]."""

    earliest: float
    latest: float


@dataclass(frozen=True, slots=True)
class HeardMessage:
    """A message of the amplifier: number of its request (0: an event), type, words.

    frame: that it came in, as its wire has it. Without a type these are bytes that are no frame.
    """

    at: float
    number: int
    type: int
    words: tuple[int, ...]
    frame: Any = None


@dataclass(frozen=True, slots=True)
class RequestOutcome:
    """What became of a request: code of a refusal, empty where it was carried out; its words.

    channel: that a refusal names; when: between sending and the reply [s]; values: of the words.
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

    number: of the last request. heard: messages that no request was waiting for, but Events; order:
    all, as they came. known: the amplifier as it is judged, once it was identified.
    reply_words: the longest reply to each message by its number, where it is known. quiet: time [s]
    in which a reply comes; timeout: for which one is awaited. wire_time: on the wire [s], of a
    request and a reply by their words; transit: of the longest reply; pace: how much of that it
    really takes, at most, as on a terminal without bits. session: that was begun last.
    loss: why the line was lost. came: bytes of the amplifier since the last request.

    neighbours, free: other addresses that reply, and the highest at which nothing does, once it has
    looked around. fastest, reactions: the shortest exchange by the name of its message [s], and the
    times until a reply began. attempts: of this check that came too late; wasted: the time [s] of
    all of the run. lag: by how much this machine was late in an attempt, at most; lateness: by how
    much this machine or a reply was, of all.
    """

    kind: ClassVar[str]
    """Kind of wire: serial, rtu, tcp or can."""
    has_events: ClassVar[bool] = True
    """Whether the wire carries messages that were not asked for."""
    has_broadcasts: ClassVar[bool] = True
    """Whether one request can reach all addresses."""
    addresses: ClassVar[int] = 247
    """The highest address."""
    transactions: ClassVar[int] = 1
    """What the wire makes of a request that changes something, each with a reply."""

    transmit: Callable[[bytes], None]
    """Sends bytes on its line, once that is open; raises LinkError."""
    name = ""
    """Under which its bytes are traced."""

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
        """Take messages from bytes; returns those bytes that are the amplifier's."""

    @abstractmethod
    def question(self, address: int) -> bytes:
        """Return the frame of a request that only reads, to an address."""

    @abstractmethod
    async def hello(self) -> Values:
        """Read the identity; raises ContractViolation."""

    async def exchange(self, number: int, words: Sequence[int], **more: Any) -> RequestOutcome:
        """Send a message and await its reply; raises ContractViolation where none comes.

        more: of the request.
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
        """Require the type of a reply, and what else belongs to it; code: of a refusal."""
        expect_equal(heard.type, number, "type of a reply")

    async def part(self, number: int, words: Sequence[int]) -> None:
        """Send a message that has no reply: a part of a set but the last."""
        self.write(self.request(number, words))

    @abstractmethod
    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frames of a request; to: its address, 0 for all, None for this amplifier.

        Its number is that of the request from then on.
        """

    @abstractmethod
    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield what is wrong, and frames that must have no effect and no reply, made in turn."""

    async def look_around(self) -> None:
        """Learn who else is on the line, by what only reads; once.

        Every address is asked where a broadcast would reach it, else until one is free. Many are
        asked at once, and each of them alone where anything is heard.
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
        await asyncio.sleep(self.quiet)  # in which a late one is heard
        self.heard.clear()
        self.free = next((each for each in addresses if each not in self._others), 0)
        verify(self.free > 0, "addresses without a reply", expected="one at least", seen="none")
        self.neighbours = self.neighbours or frozenset(self._others)

    async def _is_heard(self, addresses: Sequence[int]) -> bool:
        """Whether anything is heard once addresses were asked, one after the other."""
        self.heard.clear()
        self.came = b""
        for each in addresses:
            self.write(self.question(each))
            await asyncio.sleep(_SILENCE + self.wire_time(0, 0))
        await asyncio.sleep(REACTION + self.transit if self.has_broadcasts else GATEWAY_TIMEOUT)
        return bool(self.heard or (self.came and self.is_shared))

    @property
    def is_shared(self) -> bool:
        """Whether replies of several amplifiers may collide."""
        return self.kind in ("serial", "rtu")

    @property
    def slow_reply(self) -> str:
        """Which message it always replies to later than it may, and by when; empty if none."""
        for name, times in self.reactions.items():
            if len(times) >= FEW and (least := min(times)) > REACTION:
                return f"its replies to {name} begin after {1e3 * least:.3g} ms at least"
        return ""

    @property
    def is_used_up(self) -> bool:
        """Whether the time of the run for attempts that came too late is used up."""
        return self.wasted >= _MAX_WASTED

    def was_late(self, since: float) -> bool:
        """Note an attempt from a time on that came too late; returns whether to make it again."""
        if self.slow_reply:
            return False
        self.attempts = min(self.attempts + 1, _MAX_ATTEMPTS)
        self.wasted += threads.now() - since
        return self.attempts < _MAX_ATTEMPTS and not self.is_used_up

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Measure by how much this machine is late while the context lasts."""

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
        """Note why the line was lost."""
        self.loss = cause

    async def expect_silence(self, data: bytes, what: str, *before: bytes) -> None:
        """Send frames, data the last of them, to which nothing must be heard."""
        heard = await self.send(data, *before)
        verify(not heard, f"replies to {what}", expected="none", seen=heard)

    async def send(self, data: bytes, *before: bytes, count: int = 0) -> list[HeardMessage]:
        """Send frames, data the last; return what is heard until a reply must have come.

        count: of replies that must come, which are awaited longer.
        """
        self.heard.clear()
        self.came = b""
        for each in before:
            self.write(each)
            await asyncio.sleep(self.quiet / 4)  # also what ends a frame of Modbus RTU
        self.write(data)
        replies = [await self.next(lambda each: True, self.timeout) for _ in range(count)]
        await asyncio.sleep(self.quiet)
        heard, self.heard = [*filter(None, replies), *self.heard], []
        return heard

    async def reply_to(self, data: bytes) -> HeardMessage | None:
        """Send frames, and return what is heard first, None if nothing is, however late."""
        self.write(data)
        return await self.next(lambda each: True, self.timeout)

    def take(self, message: HeardMessage, *, is_event: bool = False) -> None:
        """Keep a message that was heard."""
        if not is_event:
            self.heard.append(message)
        self.order.append(message)
        self._news.set()

    async def next(
        self, is_meant: Callable[[HeardMessage], bool], timeout: float
    ) -> HeardMessage | None:
        """Return the first message that is meant, None if it does not come in time [s]."""
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
        """Return the reply to what was sent.

        Raises ContractViolation where none comes; one that is late counts as a machine that is.
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
        """Return what is wrong with the bytes that came in place of a reply, if that is known."""
        return ""

    def refusal(
        self, sent: float, came: float, number: int, words: Sequence[int]
    ) -> RequestOutcome:
        """Make the answer of a Nak; ContractViolation where it names another request."""
        nak = read_as("Nak", read_nak, words, is_strict=True)
        expect_equal(words[NAK_RECORD.places["request"]], number, "request that a Nak names")
        return RequestOutcome(nak.code, nak.channel, (), When(sent, came))


def in_batches(rows: Sequence[_T], size: int) -> list[Sequence[_T]]:
    """Cut rows into batches of a size, the last of which may be smaller."""
    return [rows[at : at + size] for at in range(0, len(rows), size)]


def altered(data: bytes, at: int) -> bytes:
    """Return bytes with one bit of one of them wrong."""
    changed = bytearray(data)
    changed[at] ^= 0x10
    return bytes(changed)


def read_as(what: str, read: Callable[..., _T], *arguments: object, **options: object) -> _T:
    """Return what is read; ContractViolation where it cannot be read."""
    try:
        return read(*arguments, **options)
    except Refusal as error:
        raise ContractViolation(what, expected="as in the table", seen=error) from None


_LONG = 5.0  # s; without a reading, after which it may have gone round
_BESIDE = 0.0002  # s; by which levels may be older than the clock beside them
_ERROR = QUANTITIES["clock_error"]


class Dating:
    """Times [s] by the clock of one amplifier, which began near those of this machine.

    pace: seconds of the clock in one of its crystal. error: by how much readings contradict each
    other beyond what the clock may drift, since that was set to 0.
    """

    def __init__(self) -> None:
        self.pace, self.error = 1.0, 0.0
        self._last: tuple[int, float] | None = None  # the clock, and until when it was read
        self._time, self._ahead = 0.0, (0.0, 0.0)  # of the last reading; of this machine's

    def shift(self, steps: int) -> None:
        """Move the clock on by steps of its high word."""
        if self._last is not None:
            self._last = (self._last[0] + steps * HIGH_STEPS) % SPAN, self._last[1]

    def expect_steady(self, otherwise: type[ContractViolation] = ContractViolation) -> None:
        """Raise ContractViolation, or another one, where readings contradict each other."""
        if self.error > 0:
            what = "by how much readings of its clock contradict each other"
            raise otherwise(what, expected="0 ms", seen=f"{1e3 * self.error:.3g} ms")

    def between(self, earliest: float, latest: float) -> When:
        """Return an interval; raises ContractViolation for an empty one."""
        if earliest > latest:
            self.expect_steady()
        return When(min(earliest, latest), latest)

    def interval(self, when: When) -> When:
        """Return what is between two times of this machine, behind the last reading."""
        if self._last is None:
            return when
        drift = DRIFT * max(when.latest - self._last[1], 0.0)
        low, high = self._ahead
        return self.between(
            max(when.earliest + low - drift, self._time), when.latest + high + drift
        )

    def dated(self, clock: int, when: When, stated: int) -> When:
        """Return when a status was true that shows the clock and was read in an interval.

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
    """A request by its values, the session that is held unless one is given, or by raw words.

    layers: of a set, which is sent in its parts. codes: one of which must be the answer, an empty
    one: carried out. channels: one of which a refusal must name.
    """

    name: str
    raw: Sequence[int] | None
    values: Values
    layers: tuple[LayerSet, ...]
    codes: tuple[str, ...]
    channels: tuple[int | None, ...]


Row: TypeAlias = "LayerSet | Send | float | Callable[[], Awaitable[object]] | Sequence[Row]"
"""A layer that plays, a request, a pause [s] in which the watchdog is fed, what is awaited, or a
course: rows that begin at rest, armed, and are followed until all is settled."""
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
    """Make a request that must be carried out, or refused with a code."""
    return Send(name, raw, values, layers, (code,) if isinstance(code, str) else code, channels)


def play_now(*layers: LayerSet, now: int = 1, **values: Any) -> Send:
    """Make a set that plays at once; values: token, session, code, as of `send`."""
    return send("Set", layers=layers, now=now, **values)


stage = partial(play_now, now=0)
"""Makes a set that is staged."""

_WORD = 0xFFFF


def _unlimited(field: Field) -> Field:
    """Return a field whose numbers, but that of channels, may be any."""
    if isinstance(field, RowsOf):
        return replace(field, record=Record(*map(_unlimited, field.record.fields)))
    if isinstance(field, Number) and field.name != "channels":
        lowest = int(field.is_added)  # 0: not stated
        return replace(field, quantity=replace(field.quantity, minimum=lowest, maximum=_WORD))
    return field


_REPLY = MESSAGES["GetCaps"].reply
(_LIMITS,) = (field.record for field in _REPLY.fields if isinstance(field, RowsOf))
STATED = Record(*map(_unlimited, _REPLY.fields))
"""The reply to GetCaps; a number may be any word, of which those that are wrong are found."""


def _ranges(can: Values) -> Iterator[tuple[str, int, int, int]]:
    """Yield each number with its name, between the least and the most that it may be."""
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
    """Capabilities by name; wrong: what each must be that cannot be so, and what is stated.

    Raises UnusableCapability for one of those, so that what does not ask for it goes on.
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
    """Make what one layer is to play; ramp, valid_for in ms."""
    return LayerSet(number, ramp, valid_for, commands, after, renew)


class Judge(ExpectedAmplifier):
    """An amplifier with these capabilities since a status at rest.

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
        """Return a layer as it plays by a GetAchieved.

        Raises ContractViolation for a difference of more than half a step.
        """
        driven = tuple(tone for tone in one.commands if tone.is_driven)
        one = replace(one, commands=driven)
        if problem := achieved_problem(one, shown, self.can, is_exact=False):
            rule, what, must, seen = problem
            self.report(rule, 0.0, f"{what} in layer {one.layer}", must=must, seen=seen)
        return achieved_layer(one, shown, self.can)
