"""The object dictionary of an amplifier, and its objects as messages; no I/O."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.codec.can_bus.frame import BLOCK, CANOPEN, LAYOUTS
from drivers.codec.payload import Cursor, pack, read_text, versions_of
from drivers.command import DriveCommand
from drivers.errors import FrameError
from drivers.guard import require_safe
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    Achieved,
    Capabilities,
    ChannelLimits,
    Fault,
    FaultList,
    FaultRecord,
    Feature,
    Identity,
    LoadEnvelope,
    Measured,
    Measurement,
    NakCode,
)

_Q = PROTOCOL.quantities
_QUANTITIES: Mapping[str, WireQuantity] = vars(_Q)
_OBJECTS: Mapping[str, Mapping[str, Any]] = CANOPEN["objects"]
_NAKS = {code: NakCode[name] for name, code in CANOPEN["aborts"].items()}
_LIMITS: Mapping[str, WireQuantity] = {  # of a channel
    "frequency_min": _Q.frequency,
    "frequency_max": _Q.frequency,
    "level_max": _Q.level,
}
_MEASURED: Mapping[str, WireQuantity] = {  # of a channel
    "voltage": _Q.channel_voltage,
    "current": _Q.channel_current,
}
_WIDTHS = {"u8": 1, "u16": 2, "u32": 4, "i16": 2}
TEXTS = ("vendor", "product", "serial_number", "firmware")


@dataclass(frozen=True, slots=True)
class Entry:
    """One subindex with an integer of type u8, u16 or i16; quantity: None for a plain integer."""

    index: int
    subindex: int
    name: str
    type: str
    quantity: WireQuantity | None


def index_of(name: str) -> int:
    """Return the index of an object of protocol.yaml."""
    return int(_OBJECTS[name]["index"])


def _capability_entries() -> Iterator[Entry]:
    types = _OBJECTS["capabilities"]["types"]
    for subindex, (name, kind) in enumerate(types.items(), start=1):
        quantity = _QUANTITIES.get(kind)
        wire = kind if quantity is None else quantity.wire
        yield Entry(index_of("capabilities"), subindex, name, wire, quantity)


CAPABILITY_ENTRIES = tuple(_capability_entries())
"""Entries of the capabilities, in order, named as their fields."""


def limit_entries(channel: int) -> tuple[Entry, ...]:
    """Return the entries of the limits of a channel, named as their fields."""
    return _channel_entries(channel, _LIMITS)


def measured_entries(channel: int) -> tuple[Entry, ...]:
    """Return the entries of the measurements of a channel, named as their fields."""
    return _channel_entries(channel, _MEASURED)


def _channel_entries(channel: int, quantities: Mapping[str, WireQuantity]) -> tuple[Entry, ...]:
    return tuple(
        Entry(index_of(f"channel_{name}"), channel + 1, name, quantity.wire, quantity)
        for name, quantity in quantities.items()
    )


def read_integer(entry: Entry, data: bytes) -> int:
    """Decode the integer of an entry; FrameError for a wrong length or value."""
    if len(data) != _WIDTHS[entry.type]:
        raise FrameError(f"{entry.name} must have {_WIDTHS[entry.type]} bytes, got {len(data)}")
    value = int.from_bytes(data, "little", signed=entry.type.startswith("i"))
    if entry.quantity is not None and not entry.quantity.holds(value):
        raise FrameError(
            f"{entry.name} must be {entry.quantity.minimum} to {entry.quantity.maximum}, got "
            f"{value}"
        )
    return value


def unpack_identity(texts: Mapping[str, bytes], versions: bytes) -> Identity:
    """Decode an identity from the subindices of its object; FrameError for an invalid one."""
    read = {name: read_text(texts[name].rstrip(b"\0"), name) for name in TEXTS}
    entry = Entry(index_of("texts"), len(TEXTS) + 1, "versions", "u16", _Q.versions)
    return Identity(**read, versions=versions_of(read_integer(entry, versions)))


def unpack_capabilities(
    values: Mapping[str, int], limits: Sequence[Mapping[str, int]]
) -> Capabilities:
    """Decode capabilities from the integers of their entries by name, limits channel by channel."""
    fields: dict[str, Any] = {}
    for entry in CAPABILITY_ENTRIES:
        value, quantity = values[entry.name], entry.quantity
        if quantity is not None and quantity.per_unit > 1:
            fields[entry.name] = quantity.from_wire(value)
        else:
            fields[entry.name] = value
    fields["features"] = Feature(fields["features"])
    fields["channel_limits"] = tuple(
        ChannelLimits(**{name: quantity.from_wire(one[name]) for name, quantity in _LIMITS.items()})
        for one in limits
    )
    return Capabilities(**fields)


def unpack_measured(channels: Sequence[Mapping[str, int]]) -> Measured:
    """Decode measurements from the integers of their entries by name, channel by channel."""
    return Measured(
        tuple(
            Measurement(
                **{name: quantity.from_wire(one[name]) for name, quantity in _MEASURED.items()}
            )
            for one in channels
        )
    )


def unpack_faults(data: bytes) -> FaultList:
    """Decode faults: fault, channel and age each, newest first; raises FrameError."""
    cursor = Cursor(data)
    record = 2 + _WIDTHS[_Q.age.wire]
    return FaultList(
        tuple(
            FaultRecord(
                fault=cursor.one_of(Fault),
                channel=cursor.optional_channel(),
                age=cursor.number(_Q.age),
            )
            for _ in range(-(-len(data) // record))
        )
    )


def unpack_achieved(data: bytes) -> Achieved:
    """Decode an achieved set; raises FrameError."""
    cursor = Cursor(data)
    token = cursor.integer(_Q.token)
    count = cursor.integer(_Q.channel_count)
    commands = []
    each = BLOCK + 2
    for start in range(3, 3 + each * count, each):
        values = LAYOUTS["command"].unpack(data[start : start + BLOCK])
        slots = data[start + BLOCK : start + each]
        if values is None or len(slots) < 2:
            raise FrameError(f"invalid achieved set: {data.hex(' ')}")
        checked = (
            (_Q.level, values["level"]),
            (_Q.phase, values["phase"]),
            (_Q.envelope_slot, slots[0]),
            (_Q.envelope_slot, slots[1]),
        )
        if not all(quantity.holds(value) for quantity, value in checked):
            raise FrameError(f"achieved set out of range: {data.hex(' ')}")
        commands.append(
            DriveCommand(
                channel=values["channel"],
                frequency=_Q.frequency.from_wire(values["frequency"]),
                level=_Q.level.from_wire(values["level"]),
                phase=_Q.phase.from_wire(values["phase"]),
                keep_phase=bool(values["keep_phase"]),
                onset=slots[0],
                ending=slots[1],
                skip_ending=bool(values["skip_ending"]),
            )
        )
    return Achieved(token, tuple(commands))


def pack_envelope(request: LoadEnvelope) -> bytes:
    """Encode an envelope; TypeError for one that has not passed a guard."""
    require_safe(request)
    envelope = request.envelope
    head = pack((_Q.envelope_step, envelope.step), (_Q.envelope_knots, len(envelope.knots)))
    return head + b"".join(
        pack((_Q.level, knot.level), (_Q.phase, knot.phase)) for knot in envelope.knots
    )


def nak_of_abort(abort: int) -> NakCode | None:
    """Return the refusal of an SDO abort code; None for one of CANopen itself."""
    return _NAKS.get(abort)
