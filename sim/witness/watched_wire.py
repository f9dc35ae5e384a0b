"""One wire: what takes its bytes apart, the amplifiers on it, and whether it is in trouble."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Protocol

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.can_decoder import CanDecoder
from sim.witness.decoded import Data, DecodedFrame, Direction
from sim.witness.modbus_decoder import ModbusDecoder
from sim.witness.serial_decoder import SerialDecoder

_RECOVERY = 0.5  # s; after a fault of a wire nobody can say at once what is owed
_COPIES = 64  # frames among which one that comes again during a fault is looked for


class Decoder(Protocol):
    """What takes the bytes of a kind of wire apart."""

    def feed(self, direction: Direction, time: float, data: Data) -> list[DecodedFrame]:
        """What these bytes complete."""

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes that went this way have begun what others may complete."""


class WatchedWire:
    """A wire by its name; sides: by the addresses of the amplifiers.

    recent: the last frames toward the amplifiers.
    """

    def __init__(self, name: str, kind: str, sessions: Mapping[int, AmplifierSession]) -> None:
        self.name = name
        self.kind = kind
        self.sessions = sessions
        self.recent: deque[Data] = deque(maxlen=_COPIES)
        self._disturbed_until = -math.inf
        self.begin()

    def begin(self) -> None:
        """As after it was opened."""
        self._begun: dict[Direction, float] = {}  # when [s] what is not complete yet has begun
        self.decoder: Decoder
        match self.kind:
            case "serial":
                self.decoder = SerialDecoder()
            case "modbus-tcp" | "modbus-rtu":
                self.decoder = ModbusDecoder(over_tcp=self.kind == "modbus-tcp")
            case _:
                channels = {
                    address: max(session.config.channels, default=0) + 1
                    for address, session in self.sessions.items()
                }
                self.decoder = CanDecoder(self.kind, channels)

    def feed(
        self, direction: Direction, time: float, data: Data
    ) -> list[tuple[float, DecodedFrame]]:
        """What these bytes complete, each with when [s] the first of its bytes have passed."""
        begun = self._begun.pop(direction, time)
        found = self.decoder.feed(direction, time, data)
        if self.decoder.has_partial_frame(direction):
            self._begun[direction] = time if found else begun
        return [(time if number else begun, one) for number, one in enumerate(found)]

    def is_disturbed(self, time: float) -> bool:
        """Whether faults are put on it at a time [s], or were shortly before."""
        return time <= self._disturbed_until

    def set_disturbed(self, time: float, *, is_on: bool) -> None:
        """Faults are put on it from now on, or no more."""
        self._disturbed_until = math.inf if is_on else time + _RECOVERY
