"""Decoder for CAN, from docs/reference/wire-can.md: requests, replies, sets, heartbeats, EMCY.

Of NMT only boot-up is decoded, of SDO what `can_transfers` lists.
"""

import struct
from collections.abc import Mapping

from sim.witness import quantities as q
from sim.witness.can_requests import ACTIONS, FILLING, PER_NODE, WITH_COMMANDS, CanRequests
from sim.witness.can_text import CanFrame, SlcanText, SocketcandText
from sim.witness.can_transfers import CanTransfers
from sim.witness.capture import Direction
from sim.witness.decoded import (
    SETS,
    BootUp,
    Damaged,
    DecodedFrame,
    Message,
    Reply,
    Request,
    RequestKind,
    StateEvent,
)
from sim.witness.quantities import INVALID, OutOfRange


class CanDecoder:
    """Decodes the text of an adapter; nodes: number of channels by node."""

    def __init__(self, kind: str, nodes: Mapping[int, int]) -> None:
        reader = SlcanText if kind == "slcan" else SocketcandText
        self._text = {
            "amplifier": reader("amplifier"),
            "host": reader("host"),
        }
        self._nodes = {node: _Node(node, channels) for node, channels in nodes.items()}

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        seen: list[DecodedFrame] = []
        for text in self._text[direction].feed(data):
            if text.is_damaged:
                seen.append((text.raw, Damaged("a malformed frame line")))
            elif text.frame is not None:
                seen += [(text.raw, message) for message in self.take(direction, time, text.frame)]
        return seen

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""
        return self._text[direction].has_partial_frame

    def take(self, direction: Direction, time: float, frame: CanFrame) -> list[Message | None]:
        """Decode one frame at a time [s]; a message for each amplifier and set that it concerns."""
        try:
            if direction == "amplifier":
                return self._decode_request(time, frame)
            return self._decode_reply(frame)
        except INVALID as problem:
            node = frame.identifier & 0x7F
            if direction == "amplifier":
                return [Request(RequestKind.READ, node, problem=str(problem))]
            return [Damaged(f"an invalid frame: {problem}")]

    def _decode_request(self, time: float, frame: CanFrame) -> list[Message | None]:
        function, number = frame.identifier & 0x780, frame.identifier & 0x7F
        if frame.identifier == 0:
            return [None]
        if function == 0x700:
            return [Request(RequestKind.PING, 128 - number)]
        if frame.identifier == 0x480:
            return [_broadcast(frame)]
        for node in self._nodes.values():
            if node.requests.owns(frame):
                return node.requests.take(time, frame) or [None]
        if function == 0x600 and number in self._nodes:
            self._nodes[number].transfers.requested(time, frame)
            index = int.from_bytes(frame.data[1:3], "little")
            identifies = frame.data[0] == 0x40 and index in (0x1018, 0x2000)
            if frame.data[0] & 0xE3 == 0xC1:  # the end of a block: only envelopes are written so
                return [Request(RequestKind.ENVELOPE, number)]
            return [Request(RequestKind.HELLO if identifies else RequestKind.READ, number)]
        return [None]

    def _decode_reply(self, frame: CanFrame) -> list[Message | None]:
        function, number = frame.identifier & 0x780, frame.identifier & 0x7F
        if function == 0x700 and frame.data == b"\0" and number in self._nodes:
            return [BootUp(number)]
        if function == 0x080 and number in self._nodes:
            state = frame.data[3] & 0xF
            return [StateEvent(number, state, frame.data[3] >> 4)]
        if function == 0x580 and number in self._nodes:
            return [self._nodes[number].transfers.answered(frame)]
        for node in self._nodes.values():
            if frame.identifier == 0x180 + node.number:
                return [*node.requests.end_set(frame.data[0]), node.reply(frame)]
            if frame.identifier == 0x280 + node.number:
                node.status = frame.data
                return [None]
            if function == 0x380 and number in node.numbers:
                node.levels[number - node.number] = frame.data
                return [None]
        return [None]


class _Node:
    """Requests to one amplifier, and frames from it whose message is incomplete."""

    def __init__(self, number: int, channels: int) -> None:
        self.number = number
        self.numbers = range(number, number + max(1, -(-channels // PER_NODE)))
        self.requests = CanRequests(number, self.numbers)
        self.transfers = CanTransfers(number)
        self.status: bytes | None = None
        self.levels: dict[int, bytes] = {}

    def reply(self, frame: CanFrame) -> Message:
        """Decode a reply with the status and levels sent before it, or an event."""
        sequence, what, both, _, token, left = struct.unpack_from("<BBBBHH", frame.data)
        state, fault = q.STATE.whole(both & 0xF), q.FAULT.whole(both >> 4)
        if sequence == 0:
            return StateEvent(self.number, state, fault)
        if frame.is_fd:
            self._take_reply(frame.data[8:])
        status, levels = self.status, self.levels
        self.status, self.levels = None, {}
        result = what >> 4
        high_voltage = temperature = reported = None
        if status is not None and status[0] == sequence:
            _, flag, temperature, _, count = struct.unpack_from("<BBhHB", status)
            high_voltage = bool(flag & 1)
            reported = _levels(levels, count & 0x1F, sequence)
        kind = ACTIONS[what & 7]
        is_whole = reported is not None or result or kind in SETS
        return Reply(
            self.number,
            (self.number, sequence, kind),
            refusal=result,
            problem="" if is_whole else "status or levels are missing",
            is_exact=bool(what & 8) if kind in WITH_COMMANDS else None,
            status=q.status_of(
                state,
                fault,
                token,
                left=left,
                high_voltage=high_voltage,
                temperature=temperature,
                levels=reported,
            ),
        )

    def _take_reply(self, data: bytes) -> None:
        blocks = [data[at : at + 8] for at in range(0, len(data) - 7, 8)]
        blocks = [block for block in blocks if block != FILLING]
        if blocks:
            self.status = blocks[0]
            self.levels = dict(enumerate(blocks[1:]))


def _broadcast(frame: CanFrame) -> Request:
    token, ramp, _, what, _ = struct.unpack_from("<HHHBB", frame.data)
    kind = ACTIONS[what & 7]
    if kind is RequestKind.COMMIT:
        return q.request_of(kind, 0, None, token=token)
    if kind is RequestKind.STOP:
        return q.request_of(kind, 0, None, ramp=ramp)
    raise OutOfRange(f"{kind.value} as a broadcast")


def _levels(blocks: dict[int, bytes], count: int, sequence: int) -> list[int] | None:
    """Levels of `count` channels; None where a block is missing."""
    levels: list[int] = []
    for group in range(-(-count // PER_NODE)):
        block = blocks.get(group)
        if block is None or block[7] != sequence:
            return None
        word = int.from_bytes(block[:7], "little")
        levels += [word >> 14 * place & 0x3FFF for place in range(PER_NODE)]
    return levels[:count]
