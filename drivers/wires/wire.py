"""A kind of wire without I/O: requests of a host as bytes, and received bytes as arrivals.

A wire carries one request at a time and matches what arrives with it: a reply to an earlier request
counts as unexpected, damaged bytes as invalid. `WireAddress` is an amplifier's URL on a kind of
wire, `PortAbove` a port that changes or delays the bytes of another one.

Wires are found by URL scheme: built-in wires, and entry points of installed packages. Entry points
are in the group `era_haptics.wires`, named by scheme; each is a class
derived from `WireAddress`, and made with the URL.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Protocol, TypeAlias

from drivers.errors import CommandError, LinkError, WireCounters
from drivers.ports import Port, open_port
from drivers.protocol.definition import (
    EVENT,
    EVENT_RECORD,
    MAX_WORDS,
    NAK,
    NAK_RECORD,
    NO_CHANNEL,
    QUANTITIES,
    REFUSALS,
    REQUESTS,
    Message,
)
from drivers.protocol.records import (
    TEXT_MAX,
    Bits,
    Number,
    Numbers,
    Record,
    Refusal,
    Rest,
    Rows,
    Text,
    Values,
)
from drivers.urls import UNKNOWN_KIND, Endpoint, kind_of_device, stated_kind
from registry.plugins import PluginRegistry

WIDEST = QUANTITIES["channel_count"].maximum, QUANTITIES["layer_count"].maximum
"""Channels and layers of the largest amplifier there can be."""
_CODES = {number: name for name, number in REFUSALS.items()}


@dataclass(frozen=True, slots=True)
class Reply:
    """The values of the reply to the request on the wire."""

    values: Values


@dataclass(frozen=True, slots=True)
class Nak:
    """The amplifier refused the request."""

    code: str
    """Name of the refusal."""
    channel: int | None
    """The channel at fault; None if the refusal names no channel."""


@dataclass(frozen=True, slots=True)
class BrokenReply:
    """The reply to the request is not one of the protocol, and the reason."""

    reason: str


@dataclass(frozen=True, slots=True)
class Event:
    """A change that the amplifier at an address reports without a request."""

    address: int
    values: Values


@dataclass(frozen=True, slots=True)
class OtherHost:
    """A request of another host to the amplifier at an address was heard."""

    address: int


@dataclass(frozen=True, slots=True)
class DuplicateAddress:
    """Several amplifiers have the same address, since two replies to one request differ."""

    address: int


@dataclass(frozen=True, slots=True)
class Continuation:
    """The request continues with these bytes, as the read behind a write on Modbus."""

    data: bytes
    is_present: bool = False
    """Whether the reply shows the moment at which these bytes arrive."""


@dataclass(frozen=True, slots=True)
class WrittenPart:
    """The part of a set that was sent last has arrived, as the echo of a write shows on Modbus."""


Arrival: TypeAlias = (
    Reply | Nak | BrokenReply | Event | OtherHost | DuplicateAddress | Continuation | WrittenPart
)


def read_event(
    address: int, kind: int, words: Sequence[int], counters: WireCounters
) -> list[Arrival]:
    """Read and count a message that came without a request; returns [] if it is no event."""
    try:
        if kind != EVENT:
            raise Refusal(f"type must be {EVENT}, got {kind}")
        values = EVENT_RECORD.unpack(words, is_strict=False)
    except Refusal:
        counters.invalid_frames += 1
        return []
    counters.events += 1
    return [Event(address, values)]


def read_nak(words: Sequence[int], *, is_strict: bool = False) -> Nak:
    """Read the words of a Nak; raises Refusal. is_strict: whether nothing may follow them."""
    values = NAK_RECORD.unpack(words, is_strict=is_strict)
    channel = None if values["channel"] == NO_CHANNEL else values["channel"]
    return Nak(_CODES.get(values["code"], f"code {values['code']}"), channel)


def read_reply(request: Message, kind: int, words: Sequence[int]) -> Nak | Reply | BrokenReply:
    """Read the message, by type and words, that replies to a request; what follows is ignored."""
    try:
        if kind == NAK:
            return read_nak(words)
        if kind != request.number:
            raise Refusal(f"type of the reply must be {request.number}, got {kind}")
        return Reply(request.reply.unpack(words, is_strict=False))
    except Refusal as refusal:
        return BrokenReply(str(refusal))


@cache
def request_words(name: str) -> int:
    """Return the largest number of words of a request."""
    return _words(REQUESTS[name].request, {})


@cache
def reply_words(name: str, channels: int = WIDEST[0], layers: int = WIDEST[1]) -> int:
    """Return the largest number of words of a reply; channels, layers: of the amplifier."""
    if name in ("Hello", "GetCaps"):
        channels, layers = WIDEST
    rows = {"channels": channels, "layers": layers}
    if name in ("GetAchieved", "GetMeasured"):
        rows["count"] = channels
    return _words(REQUESTS[name].reply, rows)


def _words(record: Record, rows: Mapping[str, int]) -> int:
    """Return the largest number of words of a record; rows: how many, by the field of the count."""
    words = 0
    for field in record.fields:
        match field:
            case Rows(count=str(counted), record=row):
                words += rows.get(counted, MAX_WORDS) * _words(row, rows)
            case Numbers(count=counted):
                words += rows.get(counted, MAX_WORDS)
            case Rest():
                words += MAX_WORDS
            case Text():
                words += 1 + TEXT_MAX // 2
            case Number() | Bits():
                words += field.words
    return min(words, MAX_WORDS)


class Wire(Protocol):
    """The host's side of a kind of wire."""

    counters: WireCounters
    delay: float
    """Maximum delay of a frame beyond its bits [s]; `NETWORK_DELAY` over a network."""
    is_kept: bool = False
    """Whether a frame is repeated until another node accepts it, which a CAN bus does."""
    takes: float = 0.0
    """Transmission time of the last request [s]; 0 over a network."""
    blocked: str = "the port takes no bytes: check flow control and the adapter"
    """Meaning of a blocked port, and what to check."""
    confirms_parts: bool = False
    """Whether each part of a set has a response, after which the next part is sent."""
    busy: float = 0.0
    """How long the last request and its reply occupy a line [s]; 0 if they do not share one."""

    def request(self, address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
        """Return the bytes of a request, which counts as sent; address 0: a broadcast.

        has_reply: whether to await a reply; broadcasts and earlier parts of a set get no reply.
        """

    def received(self, data: bytes) -> list[Arrival]:
        """Return the arrivals that these bytes complete."""

    def withdraw(self) -> None:
        """Give up the request on the wire, so that its reply will count as unexpected."""

    def follow(self, before: "Wire") -> None:
        """Continue the numbers of requests of the same line as it was open before.

        It is called before any request. By default a wire starts with numbers of its own, which
        amplifiers accept.
        """
        return

    def transit(self, words: int) -> float:
        """Return how long a request with this number of words takes to arrive [s]."""

    def exchange_time(self, words: int, reply: int) -> float:
        """Return the duration [s] of a request and a reply with these word counts; 0: unknown."""
        return self.transit(words) + self.transit(reply)


@dataclass(frozen=True, slots=True)
class Scheme:
    """A scheme of URLs: the facts that checks, the help and pages have of it."""

    line_kind: str
    """Kind of its lines, a key of `CLOCK_ERRORS`; empty if the name of the serial port decides."""
    example: str
    """A URL, for the help of `era amp`."""
    help: str
    """The line of the example."""
    number: str
    """Place and range of an amplifier's number, as the table of docs/reference/urls.md has them."""
    forms: Mapping[str, str]
    """Options with their defaults as that table has them, by scheme and place."""


class WireAddress(ABC):
    """The place of an amplifier on one kind of wire, made from its URL; raises CommandError."""

    SCHEMES: ClassVar[Mapping[str, Scheme]] = {}
    """Schemes of its URLs, without those of plug-ins. `make pages` registers them."""
    place: Endpoint = Endpoint()
    """The serial device or network port of the line; empty for other lines."""
    line: str
    """Name of the port, connection or bus; amplifiers with the same name share it."""
    settings: Mapping[str, object]
    """Settings in which all amplifiers of a line must agree, by name."""
    number: int
    """Address, unit or node of the amplifier on its line."""
    boot_time: float = 0.0
    """How long a board behind the port may take to boot after the port is opened [s]."""

    @abstractmethod
    def __init__(self, url: str) -> None:
        """Parse a URL."""

    @staticmethod
    def with_address(url: str, address: int) -> str:
        """Return a URL with another address, unit or node; CommandError for a wire without any."""
        raise CommandError(f"amplifiers at {url} have no address that can be set")

    @abstractmethod
    def make_wire(self) -> Wire:
        """Make the host's side of the wire, without I/O."""

    def check_agrees(self, settings: Mapping[str, object]) -> None:
        """Raise LinkError unless its settings match the other amplifiers on its line."""
        for setting, value in settings.items():
            if (got := self.settings.get(setting)) != value:
                raise LinkError(
                    f"{self.line}: {setting} must be {value} as for the other amplifiers on it, "
                    f"got {got}"
                )

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port of the line, for this program alone if the system can; raises LinkError.

        By default it is the serial device or TCP port `place`. on_data: is called with received
        bytes, as `Wire.received` takes them; on_loss: is called once with the cause of a loss.
        """
        return await open_port(self.place, on_data, on_loss)


class PortAbove:
    """A port on top of another one; passes on everything it does not change; see `Port`."""

    below: Port
    """The other port, which is set once it is open."""

    @property
    def is_blocked(self) -> bool:
        """Whether it has not taken all bytes yet."""
        return self.below.is_blocked

    def poll(self) -> None:
        """Deliver bytes that have arrived and were not read yet."""
        self.below.poll()

    def close(self) -> None:
        """Close it; no callback is called afterwards."""
        self.below.close()

    async def wait_closed(self) -> None:
        """Wait until it is closed."""
        await self.below.wait_closed()


# begin: written by docs/generators/urls_page.py classes

_CLASSES: Mapping[str, str] = {
    "can+python-can": "drivers.wires.can_interfaces:PythonCanAddress",
    "can+slcan": "drivers.wires.can_text:SlcanAddress",
    "can+socketcan": "drivers.wires.can_interfaces:PythonCanAddress",
    "can+socketcand": "drivers.wires.can_text:SocketcandAddress",
    "modbus+rtu": "drivers.wires.modbus:ModbusAddress",
    "modbus+tcp": "drivers.wires.modbus:ModbusAddress",
    "serial": "drivers.wires.serial_line:SerialAddress",
    "serial+tcp": "drivers.wires.serial_line:SerialAddress",
    # In a package that imports this one; imported only if it is used.
    "sim": "sim.memory_line:SimulatedAddress",
}
"""Classes of the built-in schemes, imported when they are used."""

# end

_WIRES: PluginRegistry[Callable[[str], WireAddress]] = PluginRegistry(
    "wire",
    "era_haptics.wires",
    WireAddress,
    error=CommandError,
    own=_CLASSES,
    ending="://",
    example="serial:///dev/ttyUSB0?baud=921600",
)


def schemes() -> tuple[str, ...]:
    """URL schemes of amplifiers, plug-ins last."""
    return _WIRES.names()


def address_of(url: str) -> WireAddress:
    """Parse the URL of an amplifier; CommandError for an unknown or invalid one."""
    return _WIRES.make(url)


def with_address(url: str, address: int) -> str:
    """Return the URL with another address, unit or node; CommandError for a wire without any."""
    return address_of(url).with_address(url, address)


def line_kind_of(url: str) -> str:
    """Return the kind of line of an amplifier's URL, as stated in it, or else the usual one.

    Raises CommandError.
    """
    kind = stated_kind(url)
    if kind:
        return kind
    address = address_of(url)
    scheme = address.SCHEMES.get(url.partition("://")[0].lower())
    if scheme is None:  # of a plug-in
        return UNKNOWN_KIND
    return scheme.line_kind or kind_of_device(address.place.device)
