"""Command sets over CAN: a request frame and the command frames with its sequence number.

A set is complete when the announced number of commands, and the envelope slots that they refer to,
have come with the sequence number of the request, in any order.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from drivers.command import CommandSet, DriveCommand
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Achieved, NakCode

INCOMPLETE_SET = 15  # result code; the others are those of refusals
NO_CHANNEL = 255
_SEQUENCES = 255  # 1 to 255
_Q = PROTOCOL.quantities


class Action(IntEnum):
    """Action of a request."""

    STATUS = 0
    APPLY = 1
    STAGE = 2
    COMMIT = 3
    ARM = 4
    DISARM = 5
    STOP = 6
    CLEAR = 7


SETS = (Action.APPLY, Action.STAGE)
"""Actions that need the frames of a set."""


@dataclass(frozen=True, slots=True)
class RequestFrame:
    """A request frame as received."""

    token: int
    ramp: int
    time: int
    action: Action
    count: int
    sequence: int
    fd: bool


class _Command(NamedTuple):
    """A command frame of a channel, integers as on the wire."""

    frequency: int
    level: int
    phase: int
    flags: int
    sequence: int


class RefusedRequest(Exception):
    """An invalid request."""

    def __init__(self, code: int, channel: int = NO_CHANNEL) -> None:
        super().__init__(code, channel)
        self.code = code
        self.channel = channel


def is_newer(sequence: int, other: int) -> bool:
    """Whether a sequence number is newer than another, by less than half of all."""
    return 1 <= (sequence - other) % _SEQUENCES <= _SEQUENCES // 2


class SetBuffer:
    """Frames of one set, for an amplifier with the given number of channels.

    request: its request frame, if it has come. Frames of a newer sequence number replace all.
    """

    def __init__(self, channels: int) -> None:
        self._channels = channels
        self.clear()

    @property
    def sequence(self) -> int | None:
        """Sequence number of the set, None without frames."""
        return self._sequence

    @property
    def is_complete(self) -> bool:
        """Whether all frames of the set have come."""
        return (
            self.request is not None
            and len(self._commands) == self.request.count
            and all(
                channel in self._slots
                for channel, command in self._commands.items()
                if command.flags & 4
            )
        )

    def clear(self) -> None:
        """Discard all frames."""
        self._sequence: int | None = None
        self.request: RequestFrame | None = None
        self._commands: dict[int, _Command] = {}
        self._slots: dict[int, int] = {}  # by channel: both slots

    def clear_before(self, sequence: int) -> None:
        """Discard all frames if a sequence number is newer."""
        if self._sequence is not None and is_newer(sequence, self._sequence):
            self.clear()

    def take_request(self, request: RequestFrame) -> None:
        """Buffer the request frame of a set."""
        if self._admits(request.sequence):
            self.request = request

    def take(self, channel: int, block: bytes) -> None:
        """Buffer a command of the channel of its identifier."""
        command = _Command(*struct.unpack("<HHhBB", block))
        if self._admits(command.sequence):
            self._commands[channel] = command

    def take_blocks(self, data: bytes) -> None:
        """Buffer the commands of a CAN FD frame; eight bytes FF are fillers."""
        for begin in range(0, len(data) - 7, 8):
            block = data[begin : begin + 8]
            if block != b"\xff" * 8:
                self.take(block[6] >> 4, block)

    def take_slots(self, data: bytes) -> None:
        """Buffer the envelope slots of four channels."""
        if self._admits(data[7]):
            word = int.from_bytes(data[:6], "little")
            for place in range(4):
                self._slots[4 * (data[6] & 3) + place] = word >> 12 * place & 0xFFF

    def command_set(self, request: RequestFrame) -> CommandSet:
        """The set, if it is complete; raises RefusedRequest."""
        if not (_Q.ramp.holds(request.ramp) and _Q.valid_for.holds(request.time)):
            raise RefusedRequest(NakCode.BAD_VALUE)
        commands = tuple(
            self._drive_command(channel, command)
            for channel, command in sorted(self._commands.items())
        )
        return CommandSet(request.token, commands, request.ramp / 1000, request.time / 1000)

    def _admits(self, sequence: int) -> bool:
        """Whether a frame with this number belongs to the set; a newer one begins another."""
        if sequence == 0:
            return False
        self.clear_before(sequence)
        if self._sequence is None:
            self._sequence = sequence
        return sequence == self._sequence

    def _drive_command(self, channel: int, command: _Command) -> DriveCommand:
        if command.flags >> 4 != channel or channel >= self._channels:
            raise RefusedRequest(NakCode.BAD_CHANNEL, command.flags >> 4)
        if command.flags & 0b1000 or not (
            _Q.level.holds(command.level) and _Q.phase.holds(command.phase)
        ):
            raise RefusedRequest(NakCode.BAD_VALUE, channel)
        slots = self._slots[channel] if command.flags & 4 else 0
        return DriveCommand(
            channel=channel,
            frequency=command.frequency / 20,
            level=command.level / 10_000,
            phase=command.phase / 100,
            keep_phase=bool(command.flags & 1),
            onset=slots & 0x3F,
            ending=slots >> 6,
            skip_ending=bool(command.flags & 2),
        )


def integers_of(command: DriveCommand) -> tuple[object, ...]:
    """The integers of a command on the wire."""
    return (
        command.channel,
        _Q.frequency.to_wire(command.frequency),
        _Q.level.to_wire(command.level),
        _Q.phase.to_wire(command.phase),
        command.keep_phase,
        command.onset,
        command.ending,
        command.skip_ending,
    )


def achieved_domain(achieved: Achieved) -> bytes:
    """The object `achieved`: the set as played."""
    data = struct.pack("<HB", achieved.token, len(achieved.commands))
    for command in achieved.commands:
        flags = command.keep_phase | command.skip_ending << 1 | command.channel << 4
        flags |= bool(command.onset or command.ending) << 2
        data += struct.pack(
            "<HHhBxBB",
            _Q.frequency.to_wire(command.frequency),
            _Q.level.to_wire(command.level),
            _Q.phase.to_wire(command.phase),
            flags,
            command.onset,
            command.ending,
        )
    return data
