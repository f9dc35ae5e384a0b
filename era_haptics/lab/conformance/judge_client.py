"""Client of a single amplifier for checks: one message at a time, no retries, no recovery.

There is one subclass per kind of wire, which builds and parses frames. Messages that no request was
waiting for are kept for the checks.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from drivers import trace
from drivers.errors import LinkError
from drivers.protocol.definition import NAK, NAK_RECORD, REACTION, REQUEST_NAMES
from drivers.protocol.records import Values
from drivers.wires.wire import read_nak
from era_haptics.lab.conformance.lateness import ON_THE_WAY, Lateness
from era_haptics.lab.conformance.outcomes import (
    LateReply,
    NoReply,
    expect_equal,
    read_as,
    verify,
)
from era_haptics.lab.expectations.tolerances import Interval
from registry import threads

JUDGE_REPLY_TIMEOUT = 0.5
"""Time [s] to await a reply: far above the reaction time, so that a busy machine does not look like
a missing reply."""
_DELIVERY_TIMEOUT = 1.5  # s, in addition, for a reply delayed by the machine or the line
GATEWAY_TIMEOUT = 1.5
"""Time [s] within which a gateway reports that a unit does not reply."""
QUIET_TIME = 0.02
"""Time [s] within which a reply arrives, in addition to the time of an exchange."""
_MAX_BYTES = 300  # that are kept for a report
_BATCH = 16  # addresses that are queried together
_PAUSE = 0.002  # s; between frames
_T = TypeVar("_T")


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
    when: Interval
    values: Values = field(default_factory=dict)

    def __getitem__(self, name: str) -> Any:
        """Return a value."""
        return self.values[name]


class JudgeClient(ABC):
    """One amplifier at an address of a line."""

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
    """Name in the trace of its bytes."""

    def __init__(self, address: int) -> None:
        self.address = address
        self.number = 0
        """Number of the last request."""
        self.session = 0
        """Session begun last."""
        self.inbox: list[HeardMessage] = []
        """Messages that no request was waiting for, except Events."""
        self.history: list[HeardMessage] = []
        """All messages, in the order of their arrival."""
        self.reply_words: dict[int, int] = {}
        """Length of the longest reply to each message by message number, if known."""
        self.quiet = QUIET_TIME
        """Time within which a reply arrives [s]."""
        self.timeout = JUDGE_REPLY_TIMEOUT
        """Time for which a reply is awaited [s]."""
        self.wire_time: Callable[[int, int], float] = lambda words, reply_words: 0.0
        """Time on the wire for a request and a reply, from their word counts [s]."""
        self.transit = 0.0
        """Time on the wire of the longest reply [s]."""
        self.loss: str | None = None
        """Why the line was lost; None while it is open."""
        self.last_bytes = b""
        """Bytes received since the last request."""
        self.neighbors: frozenset[int] = frozenset()
        """Other addresses that reply; set by `look_around`."""
        self.free_address = 0
        """Highest address without a reply; 0 before `look_around`."""
        self.lateness = Lateness()
        """Lateness of this machine and of replies."""
        self._heard_addresses: set[int] = set()
        self._news = asyncio.Event()

    def received(self, data: bytes) -> None:
        """Take bytes from the port."""
        trace.frame(trace.Direction.IN, data, self.name, str)
        own_bytes = self.hear(data)
        self.last_bytes = (self.last_bytes + own_bytes)[-_MAX_BYTES:]

    def write(self, data: bytes) -> None:
        """Send bytes; raises LinkError."""
        trace.frame(trace.Direction.OUT, data, self.name, str)
        self.transmit(data)

    def lost(self, cause: str) -> None:
        """Record why the line was lost."""
        self.loss = cause

    @abstractmethod
    def hear(self, data: bytes) -> bytes:
        """Parse messages from bytes; return the bytes that came from the amplifier."""

    @abstractmethod
    def question(self, address: int) -> bytes:
        """Return the frame of a read-only request to an address."""

    @abstractmethod
    async def hello(self) -> Values:
        """Read the identity; raises ContractViolation."""

    @abstractmethod
    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frames of a request; to: its address, 0 for broadcast, None for this
        amplifier.

        Also increments `number`, the request's number.
        """

    @abstractmethod
    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield damaged frames with descriptions; they must have no effect and no reply."""

    # Requests and replies

    async def exchange(self, number: int, words: Sequence[int], **options: Any) -> RequestOutcome:
        """Send a message and await its reply; raises ContractViolation without a reply.

        options: keyword arguments of `request`.
        """
        data = self.request(number, words, **options)
        sent_at = threads.now()
        self.write(data)
        sequence = self.number
        message = await self.replied(
            lambda message: message.number == sequence, message_name(number)
        )
        when = Interval(sent_at, message.at)
        if message.type == NAK:
            outcome = self.rejection(when, number, message.words)
        else:
            outcome = RequestOutcome("", None, message.words, when)
        self.check_reply(message, NAK if outcome.code else number, outcome.code)
        return outcome

    def check_reply(self, message: HeardMessage, number: int, code: str) -> None:
        """Check the type of a reply, and the fields added by the wire; code: of a rejection."""
        expect_equal(message.type, number, "type of a reply")

    async def part(self, number: int, words: Sequence[int]) -> None:
        """Send a message without a reply: a part of a set other than the last."""
        self.write(self.request(number, words))

    def rejection(self, when: Interval, number: int, words: Sequence[int]) -> RequestOutcome:
        """Convert a Nak to an outcome; raises ContractViolation if it names another request."""
        nak = read_as("Nak", read_nak, words, is_strict=True)
        expect_equal(words[NAK_RECORD.places["request"]], number, "request that a Nak names")
        return RequestOutcome(nak.code, nak.channel, (), when)

    async def expect_silence(self, data: bytes, description: str, *earlier: bytes) -> None:
        """Send frames (data last) that must produce no message."""
        messages = await self.send(data, *earlier)
        verify(not messages, f"replies to {description}", expected="none", actual=messages)

    async def send(self, data: bytes, *earlier: bytes, count: int = 0) -> list[HeardMessage]:
        """Send frames (data last); return the messages received until a reply must have arrived.

        count: number of replies to wait for, beyond the usual time.
        """
        self.inbox.clear()
        self.last_bytes = b""
        for frame in earlier:
            self.write(frame)
            await asyncio.sleep(self.quiet / 4)  # also ends a Modbus RTU frame
        self.write(data)
        messages = []
        for _ in range(count):
            message = await self.next_message(lambda message: True, self.timeout)
            if message is not None:
                messages.append(message)
        await asyncio.sleep(self.quiet)
        messages += self.inbox
        self.inbox = []
        return messages

    async def reply_to(self, data: bytes) -> HeardMessage | None:
        """Send frames and return the first message, however late; None without one."""
        self.write(data)
        return await self.next_message(lambda message: True, self.timeout)

    def take(self, message: HeardMessage, *, is_event: bool = False) -> None:
        """Keep a received message."""
        if not is_event:
            self.inbox.append(message)
        self.history.append(message)
        self._news.set()

    async def next_message(
        self, is_meant: Callable[[HeardMessage], bool], timeout: float
    ) -> HeardMessage | None:
        """Return the first matching message; None if no message arrives in time [s]."""
        self.last_bytes = b""
        due = threads.now() + timeout
        timer = asyncio.get_running_loop().call_at(due, self._news.set)
        try:
            while True:
                for message in self.inbox:
                    if is_meant(message):
                        self.inbox.remove(message)
                        return message
                if self.loss is not None:
                    raise LinkError(self.loss)
                if threads.now() >= due:
                    return None
                self._news.clear()
                await self._news.wait()
        finally:
            timer.cancel()

    async def replied(self, is_meant: Callable[[HeardMessage], bool], request: str) -> HeardMessage:
        """Return the reply to the last request.

        Raises ContractViolation without a reply; a late reply counts as a delay.
        """
        started_at = threads.now()
        message = await self.next_message(is_meant, self.timeout)
        if message is not None:
            return message
        failure, remark = NoReply, ""
        if self.last_bytes:
            remark = f", but {len(self.last_bytes)} other bytes{self.remark()}"
        has_new_message = any(message.at > started_at for message in self.history[-1:])
        is_sound = not remark or has_new_message
        if is_sound and await self.next_message(is_meant, _DELIVERY_TIMEOUT):
            self.lateness.note_delay(self.timeout)
            failure = LateReply
            remark = f", but later: a delay of {ON_THE_WAY}, or of the amplifier"
        raise failure(request, f"no reply within {self.timeout:g} s{remark}")

    def remark(self) -> str:
        """Describe the error in bytes received instead of a reply, if known."""
        return ""

    # Other amplifiers on the line

    async def look_around(self) -> None:
        """Find the other amplifiers on the line by read-only requests, once.

        On wires with broadcasts all addresses are queried, otherwise only until one is free.
        Addresses are queried in batches, and individually within a batch that produced a reply.
        """
        if self.free_address:
            return
        addresses = [number for number in range(self.addresses, 0, -1) if number != self.address]
        for batch in in_batches(addresses, _BATCH if self.has_broadcasts else 1):
            has_reply = await self._has_reply(batch)
            if has_reply and self.is_shared:
                await self._query_individually(batch)
            if not self.has_broadcasts and not has_reply:
                break
        await asyncio.sleep(self.quiet)  # a late reply arrives meanwhile
        self.inbox.clear()
        free_addresses = [number for number in addresses if number not in self._heard_addresses]
        is_one_free = len(free_addresses) > 0
        verify(is_one_free, "addresses without a reply", expected="one at least", actual="none")
        self.free_address = free_addresses[0]
        self.neighbors = self.neighbors or frozenset(self._heard_addresses)

    async def _query_individually(self, addresses: Sequence[int]) -> None:
        for address in addresses:
            has_reply = await self._has_reply([address])
            if has_reply and not self.inbox:  # the replies of several amplifiers have collided
                self._heard_addresses.add(address)

    async def _has_reply(self, addresses: Sequence[int]) -> bool:
        """Return whether there is any reply after querying addresses one after the other."""
        self.inbox.clear()
        self.last_bytes = b""
        for address in addresses:
            self.write(self.question(address))
            await asyncio.sleep(_PAUSE + self.wire_time(0, 0))
        await asyncio.sleep(REACTION + self.transit if self.has_broadcasts else GATEWAY_TIMEOUT)
        has_bytes = self.is_shared and len(self.last_bytes) > 0
        return bool(self.inbox) or has_bytes

    @property
    def is_shared(self) -> bool:
        """Return whether replies of several amplifiers can collide."""
        return self.kind in ("serial", "rtu")


def message_name(number: int) -> str:
    """Return a message's name with its number, or the number if it has no name."""
    name = REQUEST_NAMES.get(number)
    return f"{name} (message {number})" if name else f"message {number}"


def in_batches(rows: Sequence[_T], size: int) -> list[Sequence[_T]]:
    """Split rows into batches; the last batch can be shorter."""
    return [rows[start : start + size] for start in range(0, len(rows), size)]


def with_flipped_bit(data: bytes, position: int) -> bytes:
    """Return bytes with one bit flipped in the byte at a position."""
    changed = bytearray(data)
    changed[position] ^= 0x10
    return bytes(changed)
