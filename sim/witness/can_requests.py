"""Requests to a CAN node from their frames, by docs/reference/wire-can.md.

A set is a request with the commands and slots of its sequence number, in any order, and decoded
with the last of them.
"""

import struct
from dataclasses import replace

from sim.witness import quantities as q
from sim.witness.can_text import CanFrame
from sim.witness.decoded import INCOMPLETE_SET, SETS, ChannelCommand, Message, Request, RequestKind
from sim.witness.quantities import OutOfRange

ACTIONS = (
    *(RequestKind.STATUS, RequestKind.APPLY, RequestKind.STAGE, RequestKind.COMMIT),
    *(RequestKind.ARM, RequestKind.DISARM, RequestKind.STOP, RequestKind.CLEAR),
)
WITH_COMMANDS = (RequestKind.APPLY, RequestKind.STAGE)
FILLING = b"\xff" * 8
PER_NODE = 4
_COLLECTED_FOR = 0.1  # s


class CanRequests:
    """Requests to one amplifier; numbers: the nodes that it takes."""

    def __init__(self, number: int, numbers: range) -> None:
        self.number = number
        self.numbers = numbers
        self._begin_set(0, 0.0)

    def _begin_set(self, sequence: int, time: float) -> None:
        """Collect a set; 0 for none."""
        self._sequence, self._since = sequence, time
        self._order: CanFrame | None = None
        self._commands: dict[int, bytes] = {}
        self._slots: dict[int, tuple[int, int]] = {}

    def owns(self, frame: CanFrame) -> bool:
        """Whether a frame holds a request, commands or slots for this amplifier."""
        function, number = frame.identifier & 0x780, frame.identifier & 0x7F
        if frame.identifier in (0x480 + self.number, 0x680 + self.number):
            return True
        return function in (0x200, 0x300, 0x400, 0x500) and number in self.numbers

    def take(self, time: float, frame: CanFrame) -> list[Message | None]:
        """Decode such a frame; returns a request with its last frame, and sets given up before."""
        seen: list[Message | None] = []
        if time - self._since >= _COLLECTED_FOR:
            seen += self.end_set()
        if frame.identifier == 0x480 + self.number:
            action, sequence = frame.data[6] & 7, frame.data[7]
            if sequence == 0:
                return [*seen, self._request(frame, "sequence number 0")]
            if ACTIONS[action] not in WITH_COMMANDS:
                if _is_newer(sequence, self._sequence):
                    seen += self.end_set()
                return [*seen, self._request(frame)]
            if self._belongs(sequence, time, seen):
                self._order = frame
            self._take_blocks(frame.data[8:], time, seen)
        elif frame.identifier == 0x680 + self.number:
            if self._belongs(frame.data[7], time, seen):
                word, group = int.from_bytes(frame.data[:6], "little"), frame.data[6] & 3
                for place in range(PER_NODE):
                    pair = word >> 12 * place & 0xFFF
                    self._slots[PER_NODE * group + place] = pair & 0x3F, pair >> 6
        elif frame.is_fd:
            self._take_blocks(frame.data, time, seen)
        elif self._belongs(frame.data[7], time, seen):
            group = (frame.identifier & 0x7F) - self.number
            self._commands[PER_NODE * group + (frame.identifier >> 8) - 2] = frame.data
        if self._order is not None and not self._missing():
            seen.append(self._request(self._order))
            self._begin_set(0, time)
        return seen

    def _belongs(self, sequence: int, time: float, seen: list[Message | None]) -> bool:
        """Whether a frame belongs to the collected set, or begins one; appends a set given up."""
        if sequence and _is_newer(sequence, self._sequence):
            seen += self.end_set()
            self._begin_set(sequence, time)
        return sequence != 0 and sequence == self._sequence

    def end_set(self, reply: int | None = None) -> list[Message | None]:
        """End the collection; the set, if its request has come. reply: only that of its number."""
        order, missing = self._order, self._missing()
        if reply not in (None, self._sequence):
            return []
        self._begin_set(0, 0.0)
        if order is None:
            return []
        request = self._request(order, missing)
        return [request if reply else replace(request, key=None)]

    def _take_blocks(self, data: bytes, time: float, seen: list[Message | None]) -> None:
        """Store consecutive commands; fillers are skipped."""
        for at in range(0, len(data) - 7, 8):
            block = data[at : at + 8]
            if block != FILLING and self._belongs(block[7], time, seen):
                self._commands[block[6] >> 4] = block

    def _missing(self) -> str:
        """What the set lacks, or ""."""
        count = self._order.data[6] >> 3 if self._order else 0
        if len(self._commands) != count:
            return f"{INCOMPLETE_SET}: {len(self._commands)} of {count} commands"
        for channel, block in self._commands.items():
            if block[6] & 4 and channel not in self._slots:
                return f"{INCOMPLETE_SET}: no slots for channel {channel}"
        return ""

    def _request(self, frame: CanFrame, problem: str = "") -> Request:
        """Decode a request; of a set without a problem, with its commands."""
        token, ramp, time, what, sequence = struct.unpack_from("<HHHBB", frame.data)
        kind = ACTIONS[what & 7]
        key = (self.number, sequence, kind)
        has_commands = kind in WITH_COMMANDS and not problem
        try:
            return q.request_of(
                kind,
                self.number,
                key,
                token=token if kind in SETS else None,
                ramp=ramp,
                valid_for=time if has_commands else 0,
                watchdog=time if kind is RequestKind.ARM else None,
                commands=self._channel_commands() if has_commands else {},
                problem=problem,
            )
        except OutOfRange as wrong:
            return Request(kind, self.number, key, problem=str(wrong))

    def _channel_commands(self) -> dict[int, ChannelCommand]:
        commands = {}
        for channel, block in self._commands.items():
            frequency, level, phase, flags, _ = struct.unpack("<HHhBB", block)
            if flags >> 4 != channel or flags & 8:
                raise OutOfRange(f"command for channel {flags >> 4} in the frame of {channel}")
            onset, ending = self._slots[channel] if flags & 4 else (0, 0)
            commands[channel] = q.command_of(
                frequency, level, phase, flags, onset=onset, ending=ending
            )
        return commands


def _is_newer(sequence: int, other: int) -> bool:
    """Whether a sequence number is newer than another; 0 is older than all."""
    return not other or 1 <= (sequence - other) % 255 <= 127
