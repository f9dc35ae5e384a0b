"""A kind of wire without I/O: requests of a host as bytes, and received bytes as what came.

A wire carries one request at a time. What arrives is matched by it: a reply to an earlier request
is counted as unexpected, and damaged bytes as invalid.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from drivers.protocol.records import Values
from drivers.protocol.table import NAK_RECORD, NO_CHANNEL, REFUSALS
from drivers.statistics import WireCounters

NETWORK_DELAY = 1.0
"""Time [s] after which a port gives up a connection that has not taken what was sent.

What a broken network delivers later than that is not accounted for.
"""
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
class Broken:
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
class Several:
    """Several amplifiers have an address: two replies to one request differ."""

    address: int


@dataclass(frozen=True, slots=True)
class More:
    """The request goes on with these bytes, as on Modbus."""

    data: bytes


Arrival: TypeAlias = Reply | Nak | Broken | Event | OtherHost | Several | More


def read_nak(words: Sequence[int]) -> Nak:
    """Read the words of a Nak; raises Refusal."""
    values = NAK_RECORD.unpack(words, is_strict=False)
    channel = None if values["channel"] == NO_CHANNEL else values["channel"]
    return Nak(_CODES.get(values["code"], f"code {values['code']}"), channel)


class Wire(Protocol):
    """The host's side of a kind of wire."""

    counters: WireCounters
    delay: float
    """By which a frame may arrive later than its bits take [s]: `NETWORK_DELAY` over a network."""

    def request(self, address: int, name: str, values: Values) -> bytes:
        """Return the bytes of a request, which is on the wire from now on; address 0: of all."""

    def received(self, data: bytes) -> list[Arrival]:
        """Return what these bytes complete."""

    def withdraw(self) -> None:
        """Take the request off the wire: its reply will be unexpected."""

    def transit(self, words: int) -> float:
        """Return how long a request of so many words takes to arrive [s]."""

    def round_trip(self, name: str, length: int) -> float:
        """Return how long a request of this many bytes and its longest reply take [s]."""
