"""One watched wire: its decoder, the amplifiers on it, and whether it is disturbed."""

import math
from collections import deque
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Protocol

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.can_decoder import CanDecoder
from sim.witness.capture import Direction
from sim.witness.decoded import DecodedFrame
from sim.witness.modbus_decoder import ModbusDecoder
from sim.witness.serial_decoder import SerialDecoder
from sim.witness.unanswered import Sent

_RECOVERY = 0.5  # s; after a fault a wire counts as disturbed for so long
_COPIES = 64  # frames kept to recognise repeated ones


class Decoder(Protocol):
    """Decoder for one kind of wire."""

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""


@dataclass
class Pending:
    """A request whose reply is missing; times [s].

    since: from which on the amplifier has to respond, infinite while it is the host's turn;
    begin, executed_by: between which it is carried out, None for until its reply.
    """

    session: AmplifierSession
    sent: Sent
    since: float
    begin: float
    executed_by: float | None = None
    is_overdue: bool = False


class WatchedWire:
    """A wire; sessions: by the addresses of the amplifiers; recent: last frames of the host.

    answered: keys of the requests that had their replies last; abandoned: of a host that has
    closed the wire since; preempted_by: number of the last request that silences, before which
    others may lose their replies;
    damaged_at: when a frame of the host was damaged last [s].
    """

    def __init__(self, name: str, kind: str, sessions: Mapping[int, AmplifierSession]) -> None:
        self.name = name
        self.kind = kind
        self.sessions = sessions
        self.recent: deque[bytes] = deque(maxlen=_COPIES)
        self.pending: dict[Hashable, Pending] = {}
        self.abandoned: set[Hashable] = set()
        self.answered: deque[Hashable] = deque(maxlen=_COPIES)
        self.preempted_by = 0
        self.damaged_at = -math.inf
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
                self.decoder = CanDecoder(self.kind)

    def feed(
        self, direction: Direction, time: float, data: bytes
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

    def begun(self, direction: Direction) -> float:
        """Return since when part of a frame is there [s]; -inf for none."""
        return self._begun.get(direction, -math.inf)

    def forget_pending(self) -> None:
        """Abandon the pending requests; their replies may still arrive."""
        if self.pending:
            self.abandoned = set(self.pending)
        self.pending.clear()

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
