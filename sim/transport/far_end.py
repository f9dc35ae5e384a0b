"""The far end of a wire, without I/O: bytes of the host in, bytes of the amplifiers out.

Each kind of wire derives a class from `FarEnd` and carries out requests by `carry_out`;
`sim.transport.serving` puts a far end on a pseudo-terminal or a TCP port.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeAlias

from drivers.protocol.definition import HELLO, NAK, REQUESTS, decode_request, nak_of
from drivers.protocol.records import Refusal
from drivers.protocol.sets import is_earlier_part
from drivers.urls import ADDRESS_MAX
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.amplifier_device import AmplifierDevice

AmplifierPort: TypeAlias = SimulatedAmplifier | AmplifierDevice
"""An amplifier as far ends serve it: alone, or on a bench with faults."""
SendBytes: TypeAlias = Callable[[bytes], None]
"""A far end's function to send bytes to the host; no bytes end the connection."""


class FarEnd(ABC):
    """The amplifiers' side of a wire, without I/O; by default nothing is due by itself."""

    @property
    def next_event(self) -> float:
        """Time [s] of the next tick; infinite: never."""
        return math.inf

    @abstractmethod
    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""

    def tick(self, now: float) -> None:  # noqa: B027
        """Process everything due by a time [s]."""

    def close(self) -> None:  # noqa: B027
        """Send nothing more."""


def carry_out(
    amplifier: AmplifierPort,
    kind: int,
    words: Sequence[int],
    now: float,
    *,
    is_for_all: bool = False,
    address_max: int = ADDRESS_MAX,
) -> tuple[int, Sequence[int]]:
    """Carry out a request, by type and words, at a time [s]; returns type and words of its reply.

    A refusal is a Nak. No words: the request has no reply, like a part of a set other than the
    last. is_for_all: whether the request is for all amplifiers, which do not reply; address_max: of
    the wire.
    """
    if kind == HELLO:
        return HELLO, REQUESTS["Hello"].reply.pack(amplifier.identity)
    try:
        name, values = decode_request(kind, words)
        if is_for_all and not REQUESTS[name].is_broadcast:
            raise Refusal(f"{name} must be for one amplifier")
        if name == "SetAddress" and values["address"] > address_max:
            raise Refusal(f"address must be 1 to {address_max}, got {values['address']}")
        reply = amplifier.handle(name, values, now)
    except Refusal as refusal:
        return NAK, () if is_earlier_part(kind, words) else nak_of(refusal, kind)
    if is_for_all:
        amplifier.withdraw_status()
    return kind, REQUESTS[name].reply.pack(reply) if reply else ()
