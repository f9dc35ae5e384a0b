"""The DBC file of an amplifier and its host, for bus monitors, from protocol.yaml.

ASCII only, the common denominator of DBC readers.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from drivers.codec.can_bus.frame import CANOPEN, LAYOUTS, Field, cob_id, command_id
from drivers.codec.can_bus.requests import host_number
from drivers.protocol.definition import PROTOCOL, WireQuantity

_HOST, _AMPLIFIER, _BYTES = "Host", "Amplifier", 8
_QUANTITIES: Mapping[str, WireQuantity] = vars(PROTOCOL.quantities)
_ALIASES = {
    "time": "valid_for",
    "token": "active_token",
    "onset": "envelope_slot",
    "ending": "envelope_slot",
}
_VALUES: Mapping[str, Mapping[str, int]] = {
    "action": CANOPEN["actions"],
    "state": PROTOCOL.states,
    "fault": PROTOCOL.faults,
    "result": {"DONE": 0, **PROTOCOL.naks, "INCOMPLETE_SET": CANOPEN["incomplete_set"]},
    "nmt_state": CANOPEN["nmt_states"],
    "nmt_command": CANOPEN["nmt"],
}


@dataclass(frozen=True)
class _Message:
    """A frame with its fields."""

    id: int
    name: str
    sender: str
    fields: tuple[Field, ...]
    length: int = _BYTES


def dbc_text(*, node: int = 1, channels: int = 4) -> str:
    """Return the frames between the host and one amplifier with a number of channels."""
    messages = list(_messages(node, channels))
    lines = ['VERSION "1"', "", "NS_ :", "", "BS_:", "", f"BU_: {_HOST} {_AMPLIFIER}", ""]
    for message in messages:
        receiver = _AMPLIFIER if message.sender == _HOST else _HOST
        lines.append(f"BO_ {message.id} {message.name}: {message.length} {message.sender}")
        lines += [_signal(field, receiver) for field in message.fields]
        lines.append("")
    for message in messages:
        for field in message.fields:
            if field.name in _VALUES:
                named = " ".join(f'{code} "{name}"' for name, code in _VALUES[field.name].items())
                lines.append(f"VAL_ {message.id} {field.name} {named} ;")
    return "\n".join([*lines, ""])


def _messages(node: int, channels: int) -> Iterator[_Message]:
    groups = range(-(-channels // CANOPEN["channels_per_node"]))
    nmt = (Field("nmt_command", 0, 8), Field("node", 8, 8))
    yield _Message(cob_id("nmt"), "Nmt", _HOST, nmt, length=2)
    yield _block(cob_id("emergency", node), "Emergency", _AMPLIFIER, "emergency")
    yield _block(cob_id("order"), "Broadcast", _HOST, "order")
    yield _block(cob_id("order", node), "Order", _HOST, "order")
    for channel in range(channels):
        yield _block(command_id(node, channel), f"Command_{channel}", _HOST, "command")
    yield _block(cob_id("slots", node), "Slots", _HOST, "slots")
    yield _block(cob_id("answer", node), "Answer", _AMPLIFIER, "answer")
    yield _block(cob_id("condition", node), "Condition", _AMPLIFIER, "condition")
    for group in groups:
        yield _block(cob_id("levels", node + group), f"Levels_{group}", _AMPLIFIER, "levels")
    beat = (Field("nmt_state", 0, 8),)
    yield _Message(cob_id("heartbeat", node), "Heartbeat", _AMPLIFIER, beat, length=1)
    host = cob_id("heartbeat", host_number(node))
    yield _Message(host, "HostHeartbeat", _HOST, beat, length=1)


def _block(id: int, name: str, sender: str, layout: str) -> _Message:
    return _Message(id, name, sender, tuple(LAYOUTS[layout].fields.values()))


def _signal(field: Field, receiver: str) -> str:
    sign = "-" if field.signed else "+"
    quantity = _quantity(field)
    scale, low, high, unit = "1", "0", f"{(1 << field.bits) - 1}", ""
    if quantity is not None:
        scale, unit = f"{quantity.step:.10g}", quantity.unit.replace("°", "deg ")
        low, high = f"{quantity.low:g}", f"{quantity.high:.10g}"
    return (
        f" SG_ {field.name} : {field.first}|{field.bits}@1{sign} ({scale},0) [{low}|{high}] "
        f'"{unit}" {receiver}'
    )


def _quantity(field: Field) -> WireQuantity | None:
    """Return the quantity of a field, if any."""
    name = field.name.rstrip("0123456789").rstrip("_")
    if name == "channel":  # 255 is none
        return None
    return _QUANTITIES.get(_ALIASES.get(name, name))
