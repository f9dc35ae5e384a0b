"""A kind of wire without I/O: requests of a host as bytes, and received bytes as arrivals.

A wire carries one request at a time and matches what arrives with it: a reply to an earlier request
counts as unexpected, damaged bytes as invalid. `WireAddress` is an amplifier's URL on a kind of
wire, `PortAbove` a port that changes or delays the bytes of another one.

Wires are found by the scheme of a URL: those of this project, and entry points of installed
packages. Entry points are of the group `era_haptics.wires`, named by scheme; each is a class
derived from `WireAddress`, and made with the URL.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol, TypeAlias

from drivers.errors import CommandError, LinkError, WireCounters
from drivers.ports import Port
from drivers.protocol.definition import (
    EVENT,
    EVENT_RECORD,
    IDENTITY,
    MAX_WORDS,
    MESSAGES,
    NAK_RECORD,
    NO_CHANNEL,
    QUANTITIES,
    REFUSALS,
)
from drivers.protocol.records import (
    TEXT_MAX,
    Bits,
    Number,
    Numbers,
    Real,
    Record,
    Refusal,
    Rest,
    Rows,
    Text,
    Values,
)
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
    """The amplifier refused the request: name of the code, and the channel at fault."""

    code: str
    channel: int | None


@dataclass(frozen=True, slots=True)
class BrokenReply:
    """The reply to the request is none of the protocol: why."""

    reason: str


@dataclass(frozen=True, slots=True)
class Event:
    """A change that an amplifier tells unasked: its address, the values of the Event."""

    address: int
    values: Values


@dataclass(frozen=True, slots=True)
class OtherHost:
    """Another host drives the amplifier at an address: its request was heard."""

    address: int


@dataclass(frozen=True, slots=True)
class DuplicateAddress:
    """Several amplifiers have an address: two replies to one request differ."""

    address: int


@dataclass(frozen=True, slots=True)
class Continuation:
    """The request goes on with these bytes, as on Modbus.

    is_present: its reply is of the moment at which they arrive.
    """

    data: bytes
    is_present: bool = False


@dataclass(frozen=True, slots=True)
class WrittenPart:
    """The part of a set on the wire, which has no reply, was written, as on Modbus."""


Arrival: TypeAlias = (
    Reply | Nak | BrokenReply | Event | OtherHost | DuplicateAddress | Continuation | WrittenPart
)


def read_event(
    address: int, kind: int, words: Sequence[int], counters: WireCounters
) -> list[Arrival]:
    """Read an unasked message of an amplifier, and count it; nothing where it is no event."""
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
    """Read the words of a Nak; is_strict: nothing may follow them. Raises Refusal."""
    values = NAK_RECORD.unpack(words, is_strict=is_strict)
    channel = None if values["channel"] == NO_CHANNEL else values["channel"]
    return Nak(_CODES.get(values["code"], f"code {values['code']}"), channel)


@cache
def request_words(name: str) -> int:
    """Return the most words of a request."""
    return 0 if name == "Hello" else _words(MESSAGES[name].request, {})


@cache
def reply_words(name: str, channels: int = WIDEST[0], layers: int = WIDEST[1]) -> int:
    """Return the most words of a reply of an amplifier with so many channels and layers."""
    if name in ("Hello", "GetCaps"):
        channels, layers = WIDEST
    rows = {"channels": channels, "layers": layers}
    if name in ("GetAchieved", "GetMeasured"):
        rows["count"] = channels
    return _words(IDENTITY if name == "Hello" else MESSAGES[name].reply, rows)


def _words(record: Record, rows: Mapping[str, int]) -> int:
    """Return the most words of a record; rows: how many there are, by the name of their count."""
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
            case Number() | Bits() | Real():
                words += field.words
    return min(words, MAX_WORDS)


class Wire(Protocol):
    """The host's side of a kind of wire."""

    counters: WireCounters
    delay: float
    """By which a frame may arrive later than its bits take [s]: `NETWORK_DELAY` over a network."""
    is_kept: bool = False
    """Whether a frame is sent again until another node takes it, as by an adapter on a CAN bus."""
    takes: float = 0.0
    """How long what was sent last takes to arrive [s]; 0 over a network."""
    blocked: str = "the port takes no bytes: check flow control and the adapter"
    """What a port that is blocked means, and what to check."""
    confirms_parts: bool = False
    """Whether each part of a set has a response, the next one being sent behind it."""
    busy: float = 0.0
    """For how long what was sent last and its reply take a line in turn [s]; 0 on others."""

    def request(self, address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
        """Return the bytes of a request, which is on the wire from now on; address 0: of all.

        has_reply: whether one is awaited: of no request of all, nor of an earlier part of a set.
        """

    def received(self, data: bytes) -> list[Arrival]:
        """Return what these bytes complete."""

    def withdraw(self) -> None:
        """Take the request off the wire: its reply will be unexpected."""

    def follow(self, before: "Wire") -> None:
        """Number requests on from those of the line as it was open before; before any request.

        By default by numbers of its own, which amplifiers take.
        """
        return

    def transit(self, words: int) -> float:
        """Return how long a request of so many words takes to arrive [s]."""

    def exchange_time(self, words: int, reply: int) -> float:
        """Return how long a request and a reply of so many words take [s]; 0 if unknown."""
        return self.transit(words) + self.transit(reply)


class WireAddress(ABC):
    """An amplifier on one kind of wire, made of its URL; CommandError for one that is invalid.

    line: name of the port, connection or bus, which amplifiers of one name share; settings: what
    they must agree in, by name; number: of the amplifier there.
    """

    line: str
    settings: Mapping[str, object]
    number: int
    boot_time: float = 0.0
    """How long what is behind the port may take to start once that is opened [s]."""

    @abstractmethod
    def __init__(self, url: str) -> None:
        """Parse a URL."""

    @abstractmethod
    def make_wire(self) -> Wire:
        """Make the host's side of the wire, without I/O."""

    def check_agrees(self, settings: Mapping[str, object]) -> None:
        """Raise LinkError unless its settings are those of the others on its line."""
        for setting, value in settings.items():
            if (got := self.settings.get(setting)) != value:
                raise LinkError(
                    f"{self.line}: {setting} must be {value} as for the other amplifiers on it, "
                    f"got {got}"
                )

    @abstractmethod
    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port of the line, for this program alone if the system can; raises LinkError.

        on_data: called with what is received, as the wire takes it; on_loss: called once, with the
        cause.
        """


class PortAbove:
    """What a port on another one, below, leaves as it is; see `Port`."""

    below: Port
    """Set once it is open."""

    @property
    def is_blocked(self) -> bool:
        """Whether it has not taken all bytes yet."""
        return self.below.is_blocked

    def poll(self) -> None:
        """Hand over what has come and was not read yet."""
        self.below.poll()

    def close(self) -> None:
        """Close it; no callback is called afterwards."""
        self.below.close()

    async def wait_closed(self) -> None:
        """Wait until it is closed."""
        await self.below.wait_closed()


_WIRES: PluginRegistry[Callable[[str], WireAddress]] = PluginRegistry(
    "wire",
    "era_haptics.wires",
    WireAddress,
    error=CommandError,
    own={
        "can+python-can": "drivers.wires.can_bus:PythonCanAddress",
        "can+slcan": "drivers.wires.can_bus:SlcanAddress",
        "can+socketcan": "drivers.wires.can_bus:PythonCanAddress",
        "can+socketcand": "drivers.wires.can_bus:SocketcandAddress",
        "modbus+rtu": "drivers.wires.modbus:ModbusAddress",
        "modbus+tcp": "drivers.wires.modbus:ModbusAddress",
        "serial": "drivers.wires.serial_line:SerialAddress",
        "serial+tcp": "drivers.wires.serial_line:SerialAddress",
        "sim": "sim.memory_line:SimulatedAddress",
    },
    ending="://",
    example="serial:///dev/ttyUSB0?baud=921600",
)


def address_of(url: str) -> WireAddress:
    """Parse the URL of an amplifier; CommandError for an unknown or invalid one."""
    return _WIRES.make(url)
