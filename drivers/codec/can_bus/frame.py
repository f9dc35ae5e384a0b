"""CAN frames, and the fields of their eight bytes.

The layouts are from protocol.yaml; every number is little-endian. `requests`, `replies` and
`objects` interpret the numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drivers.codec.can_bus.canopen import BLOCK as BLOCK
from drivers.codec.can_bus.canopen import CanFrame as CanFrame
from drivers.protocol.definition import PROTOCOL

CANOPEN: Mapping[str, Any] = PROTOCOL.canopen


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a block: first bit, counted from the lowest of byte 0, and number of bits."""

    name: str
    first: int
    bits: int
    signed: bool = False


class BlockLayout:
    """Layout of the fields in a block of eight bytes."""

    def __init__(self, name: str) -> None:
        self.name = name
        signed = {"phase", "temperature"}
        self.fields: Mapping[str, Field] = {
            field: Field(field, first, bits, signed=field in signed)
            for field, (first, bits) in CANOPEN["frames"][name].items()
        }
        used = 0
        for field in self.fields.values():
            used |= ((1 << field.bits) - 1) << field.first
        self._unused = ~used

    def pack(self, **values: int) -> bytes:
        """Pack a block; fields not given are 0. ValueError for a value that does not fit."""
        block = 0
        for name, value in values.items():
            field = self.fields[name]
            low = -(1 << field.bits - 1) if field.signed else 0
            if not low <= value < low + (1 << field.bits):
                raise ValueError(f"{name} {value} does not fit into {field.bits} bits")
            block |= (value & (1 << field.bits) - 1) << field.first
        return block.to_bytes(BLOCK, "little")

    def unpack(self, block: bytes, *, is_reply: bool = False) -> dict[str, int] | None:
        """Unpack a block; None for another length, or for a request with unused bits set."""
        whole = int.from_bytes(block, "little")
        if len(block) != BLOCK or (whole & self._unused and not is_reply):
            return None
        values = {}
        for name, field in self.fields.items():
            value = whole >> field.first & (1 << field.bits) - 1
            if field.signed and value >> field.bits - 1:
                value -= 1 << field.bits
            values[name] = value
        return values


LAYOUTS: Mapping[str, BlockLayout] = {name: BlockLayout(name) for name in CANOPEN["frames"]}
"""Layouts by name."""


def cob_id(kind: str, node: int = 0) -> int:
    """Return the COB-ID of a kind of frame (a key of `cob_ids`) of a node."""
    return int(CANOPEN["cob_ids"][kind]) + node


def command_id(node: int, channel: int) -> int:
    """Return the COB-ID of the RPDO with the command of a channel."""
    each = int(CANOPEN["channels_per_node"])
    return cob_id("command", node + channel // each) + 0x100 * (channel % each)


_FUNCTION = 0x780  # bits of a COB-ID besides the node
_SYNC = 0x080  # of other devices; that of the emergency of node 0, which does not exist
_KINDS: Mapping[int, str] = {
    **{base: kind for kind, base in CANOPEN["cob_ids"].items()},
    **{cob_id("command") + 0x100 * index: "command" for index in range(4)},
}


def meaning(frame: CanFrame) -> str:
    """Describe a frame: its kind, its node, and the fields of its blocks."""
    kind = _KINDS.get(frame.id & _FUNCTION, "unknown")
    if frame.id == _SYNC:
        return "sync"
    layout = LAYOUTS.get(kind)
    blocks = [frame.data[at : at + BLOCK] for at in range(0, len(frame.data), BLOCK)]
    fields = [layout.unpack(block) for block in blocks] if layout is not None else []
    return " ".join([kind, f"node {frame.id & ~_FUNCTION}", *map(str, fields)])
