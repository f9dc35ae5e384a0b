"""One wire: what takes its bytes apart, the amplifiers on it, and whether it is in trouble."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Protocol

from sim.witness.can_decoder import CanDecoder
from sim.witness.modbus_decoder import ModbusDecoder
from sim.witness.seen import Data, Decoded, Toward
from sim.witness.serial_decoder import SerialDecoder
from sim.witness.side import Side

_RECOVERY = 0.5  # s; after a fault of a wire nobody can say at once what is owed
_COPIES = 64  # frames among which one that comes again during a fault is looked for


class Decoder(Protocol):
    """What takes the bytes of a kind of wire apart."""

    def feed(self, toward: Toward, time: float, data: Data) -> list[Decoded]:
        """What these bytes complete."""

    def is_amid(self, toward: Toward) -> bool:
        """Whether the last bytes that went this way have begun what others may complete."""


class Wire:
    """A wire by its name; sides: by the addresses of the amplifiers.

    recent: the last frames toward the amplifiers.
    """

    def __init__(self, name: str, kind: str, sides: Mapping[int, Side]) -> None:
        self.name = name
        self.kind = kind
        self.sides = sides
        self.recent: deque[Data] = deque(maxlen=_COPIES)
        self._troubled_until = -math.inf
        self.begin()

    def begin(self) -> None:
        """As after it was opened."""
        self._begun: dict[Toward, float] = {}  # when [s] what is not complete yet has begun
        self.decoder: Decoder
        match self.kind:
            case "serial":
                self.decoder = SerialDecoder()
            case "modbus-tcp" | "modbus-rtu":
                self.decoder = ModbusDecoder(over_tcp=self.kind == "modbus-tcp")
            case _:
                channels = {
                    address: max(side.plan.channels, default=0) + 1
                    for address, side in self.sides.items()
                }
                self.decoder = CanDecoder(self.kind, channels)

    def feed(self, toward: Toward, time: float, data: Data) -> list[tuple[float, Decoded]]:
        """What these bytes complete, each with when [s] the first of its bytes have passed."""
        begun = self._begun.pop(toward, time)
        found = self.decoder.feed(toward, time, data)
        if self.decoder.is_amid(toward):
            self._begun[toward] = time if found else begun
        return [(time if number else begun, one) for number, one in enumerate(found)]

    def is_troubled(self, time: float) -> bool:
        """Whether faults are put on it at a time [s], or were shortly before."""
        return time <= self._troubled_until

    def trouble(self, time: float, *, is_on: bool) -> None:
        """Faults are put on it from now on, or no more."""
        self._troubled_until = math.inf if is_on else time + _RECOVERY
