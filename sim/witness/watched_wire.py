"""One watched wire: its decoder, the amplifiers on it, and whether it is disturbed."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Protocol

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.can_decoder import CanDecoder
from sim.witness.capture import Direction
from sim.witness.decoded import Data, DecodedFrame
from sim.witness.modbus_decoder import ModbusDecoder
from sim.witness.serial_decoder import SerialDecoder

_RECOVERY = 0.5  # s; after a fault a wire counts as disturbed for so long
_COPIES = 64  # frames kept to recognise repeated ones


class Decoder(Protocol):
    """Decoder for one kind of wire."""

    def feed(self, direction: Direction, time: float, data: Data) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""


class WatchedWire:
    """A wire; sessions: by the addresses of the amplifiers; recent: last frames of the host."""

    def __init__(self, name: str, kind: str, sessions: Mapping[int, AmplifierSession]) -> None:
        self.name = name
        self.kind = kind
        self.sessions = sessions
        self.recent: deque[Data] = deque(maxlen=_COPIES)
        self._faults_until = self._disturbed_until = -math.inf
        self.reset()

    def reset(self) -> None:
        """Reset the decoder, as after opening."""
        self._begun: dict[Direction, float] = {}  # start of partial frames [s]
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
        """Decode bytes; returns frames, each with the time [s] of its first byte.

        Bytes that follow a frame cut by a fault are read as its rest, and are a disturbance too.
        """
        begun = self._begun.pop(direction, time)
        if begun < time and begun <= self._faults_until < time:
            self.disturb(time)
        found = self.decoder.feed(direction, time, data)
        if self.decoder.has_partial_frame(direction):
            self._begun[direction] = time if found else begun
        return [(time if number else begun, one) for number, one in enumerate(found)]

    def is_disturbed(self, time: float) -> bool:
        """Whether faults are injected at a time [s], or were shortly before."""
        return time <= self._disturbed_until

    def disturb(self, time: float) -> None:
        """Count as disturbed for a while from a time [s] on."""
        self._disturbed_until = max(self._disturbed_until, time + _RECOVERY)

    def set_disturbed(self, time: float, *, is_on: bool) -> None:
        """Note the start or the end of injected faults."""
        self._faults_until = math.inf if is_on else time
        self._disturbed_until = self._faults_until + _RECOVERY
