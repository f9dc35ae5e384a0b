"""The electronic data sheet (CiA 306) of an amplifier, from protocol.yaml."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from drivers.codec.can_bus.frame import CANOPEN, cob_id, command_id
from drivers.codec.can_bus.objects import index_of
from drivers.protocol.definition import PROTOCOL, WireQuantity

_TYPES = {"u8": 0x5, "u16": 0x6, "u32": 0x7, "u64": 0x1B, "i16": 0x3, "text": 0x9, "domain": 0xF}
_MANDATORY = (0x1000, 0x1001, 0x1018)
_VAR, _ARRAY, _RECORD = 7, 8, 9
_EVENT_DRIVEN = 255
_ORDER_PDO, _SLOTS_PDO = 0x10, 0x11  # RPDO 17 and 18 and so on
_BAUD_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)


@dataclass(frozen=True)
class Entry:
    """One subindex of an object: type u8..u64, i16, text or domain; access ro, wo, rw or const.

    alone: the only subindex; quantity: of its integer, if any.
    """

    index: int
    subindex: int
    name: str
    type: str
    access: str
    alone: bool
    mappable: bool
    quantity: WireQuantity | None


def entries(channels: int) -> Iterator[Entry]:
    """Yield every subindex except the counts, for a number of channels."""
    for name, declared in CANOPEN["objects"].items():
        per = declared.get("per")
        if "types" in declared:
            listed = list(enumerate(declared["types"].items(), start=1))
        elif per is None:
            listed = [(0, (name, declared["type"]))]
        else:
            first = 1 if isinstance(per, int) else 0
            listed = [
                (number + 1, (f"{name} {number + first}", declared["type"]))
                for number in range(_count(per, channels))
            ]
        for subindex, (title, kind) in listed:
            quantity = vars(PROTOCOL.quantities).get(kind)
            wire = kind if quantity is None else quantity.wire
            access, mappable = declared["access"], bool(declared.get("pdo"))
            yield Entry(
                declared["index"], subindex, title, wire, access, not subindex, mappable, quantity
            )


def _count(per: str | int, channels: int) -> int:
    if per in ("channel", "sensor"):  # a sensor at each channel's actuator
        return channels
    return -(-channels // CANOPEN["channels_per_node"]) if per == "four_channels" else int(per)


def eds_text(channels: int = 4) -> str:
    """Return the data sheet of an amplifier with a number of channels."""
    objects: dict[int, list[str]] = {}
    for index, group in _by_index(entries(channels)).items():
        objects[index] = _object(index, group)
    objects |= _pdos(channels)
    ordered = sorted(objects)
    lists = {
        "MandatoryObjects": [index for index in ordered if index in _MANDATORY],
        "OptionalObjects": [i for i in ordered if i not in _MANDATORY and not _is_own(i)],
        "ManufacturerObjects": [index for index in ordered if _is_own(index)],
    }
    lines = [*_head(channels)]
    for title, indices in lists.items():
        lines += _section(title, {"SupportedObjects": len(indices), **_numbered(indices)})
        for index in indices:
            lines += objects[index]
    return "\n".join(lines)


def _head(channels: int) -> list[str]:
    rates = {f"BaudRate_{rate}": int(rate in (125, 250, 500, 1000)) for rate in _BAUD_RATES}
    pdos = channels + 1 + -(-channels // CANOPEN["channels_per_node"])
    info: dict[str, object] = {
        "VendorName": "era-haptics",
        "VendorNumber": CANOPEN["vendor_id"],
        "ProductName": f"ERA amplifier, {channels} channels",
        "ProductNumber": CANOPEN["product_code"],
        "RevisionNumber": CANOPEN["revision"],
        **rates,
        "SimpleBootUpMaster": 0,
        "SimpleBootUpSlave": 1,
        "Granularity": 0,
        "DynamicChannelsSupported": 0,
        "GroupMessaging": 0,
        "NrOfRXPDO": pdos,
        "NrOfTXPDO": pdos - channels + 1,
        "LSS_Supported": 0,
    }
    file = {
        "FileName": "era-amplifier.eds",
        "FileVersion": 1,
        "FileRevision": 1,
        "EDSVersion": "4.0",
        "Description": "Amplifier of electrostatic resonant actuators",
    }
    dummies = {f"Dummy{number:04d}": 0 for number in range(1, 8)}
    return [
        *_section("FileInfo", file),
        *_section("DeviceInfo", info),
        *_section("DummyUsage", dummies),
    ]


def _by_index(listed: Iterable[Entry]) -> dict[int, list[Entry]]:
    groups: dict[int, list[Entry]] = {}
    for entry in listed:
        groups.setdefault(entry.index, []).append(entry)
    return groups


def _object(index: int, group: list[Entry]) -> list[str]:
    names = {index_of(name): name for name in CANOPEN["objects"]}
    if group[0].alone:
        return _section(f"{index:04X}", _variable(group[0]))
    is_array = len({entry.type for entry in group}) == 1
    lines = _head_of(index, names[index], count=len(group), kind=_ARRAY if is_array else _RECORD)
    for entry in group:
        lines += _section(f"{index:04X}sub{entry.subindex:X}", _variable(entry))
    return lines


def _variable(entry: Entry) -> dict[str, object]:
    values: dict[str, object] = {
        "ParameterName": entry.name,
        "ObjectType": f"0x{_VAR:X}",
        "DataType": f"0x{_TYPES[entry.type]:04X}",
        "AccessType": entry.access,
        "PDOMapping": int(entry.mappable),
    }
    if entry.quantity is not None:
        low, high = entry.quantity.minimum, entry.quantity.maximum
        values |= {"LowLimit": _limit(low), "HighLimit": _limit(high)}
    default = _defaults().get((entry.index, entry.subindex))
    if default is not None:
        values["DefaultValue"] = default
    return values


def _limit(value: int) -> str:
    return f"0x{value & 0xFFFF:04X}" if value < 0 else f"0x{value:X}"


def _defaults() -> Mapping[tuple[int, int], str]:
    return {
        (index_of("device_type"), 0): f"0x{CANOPEN['device_type']:X}",
        (index_of("emergency_cob_id"), 0): f"$NODEID+0x{cob_id('emergency'):X}",
        (index_of("heartbeat_consumer"), 1): "0x0",
        (index_of("heartbeat_producer"), 0): f"{CANOPEN['heartbeat_ms']}",
        (index_of("identity"), 1): f"0x{CANOPEN['vendor_id']:X}",
        (index_of("identity"), 2): f"0x{CANOPEN['product_code']:X}",
        (index_of("identity"), 3): f"0x{CANOPEN['revision']:X}",
    }


def _pdos(channels: int) -> dict[int, list[str]]:
    groups = range(-(-channels // CANOPEN["channels_per_node"]))
    command, order, slots = (index_of(name) for name in ("command", "order", "slots"))
    received = [
        *((channel, command_id(0, channel), command, channel + 1) for channel in range(channels)),
        (_ORDER_PDO, cob_id("order"), order, 0),
        *((_SLOTS_PDO + group, cob_id("slots"), slots, group + 1) for group in groups),
    ]
    sent = [
        (cob_id("answer"), index_of("answer"), 0),
        (cob_id("condition"), index_of("condition"), 0),
        *((cob_id("levels", group), index_of("levels"), group + 1) for group in groups),
    ]
    objects: dict[int, list[str]] = {}
    for number, identifier, index, subindex in received:
        objects[0x1400 + number] = _parameter(0x1400 + number, "RPDO", identifier)
        objects[0x1600 + number] = _mapping(0x1600 + number, "RPDO", index, subindex)
    for number, (identifier, index, subindex) in enumerate(sent):
        objects[0x1800 + number] = _parameter(0x1800 + number, "TPDO", identifier)
        objects[0x1A00 + number] = _mapping(0x1A00 + number, "TPDO", index, subindex)
    return objects


def _parameter(index: int, what: str, identifier: int) -> list[str]:
    return [
        *_head_of(index, f"{what} communication parameter", count=2, kind=_RECORD),
        *_constant(index, 1, "COB-ID", "u32", f"$NODEID+0x{identifier:X}"),
        *_constant(index, 2, "transmission type", "u8", f"{_EVENT_DRIVEN}"),
    ]


def _mapping(index: int, what: str, mapped: int, subindex: int) -> list[str]:
    value = f"0x{mapped << 16 | subindex << 8 | 64:08X}"
    return [
        *_head_of(index, f"{what} mapping", count=1, kind=_RECORD),
        *_constant(index, 1, "mapped object", "u32", value),
    ]


def _head_of(index: int, name: str, *, count: int, kind: int) -> list[str]:
    head: dict[str, object] = {
        "ParameterName": name,
        "ObjectType": f"0x{kind:X}",
        "SubNumber": count + 1,
    }
    return [
        *_section(f"{index:04X}", head),
        *_constant(index, 0, "highest subindex", "u8", f"{count}"),
    ]


def _constant(index: int, subindex: int, name: str, kind: str, value: str) -> list[str]:
    fields: dict[str, object] = {
        "ParameterName": name,
        "ObjectType": f"0x{_VAR:X}",
        "DataType": f"0x{_TYPES[kind]:04X}",
        "AccessType": "const",
        "DefaultValue": value,
        "PDOMapping": 0,
    }
    return _section(f"{index:04X}sub{subindex:X}", fields)


def _is_own(index: int) -> bool:
    return 0x2000 <= index < 0x6000


def _numbered(indices: Iterable[int]) -> dict[str, object]:
    return {f"{number}": f"0x{index:04X}" for number, index in enumerate(indices, start=1)}


def _section(title: str, values: Mapping[str, object]) -> list[str]:
    return [f"[{title}]", *(f"{name}={value}" for name, value in values.items()), ""]
