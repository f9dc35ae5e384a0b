"""The electronic data sheet (CiA 306) of an amplifier with protocol 4."""

from collections.abc import Mapping, Sequence

from drivers.protocol.definition import MESSAGES
from drivers.wires.can_frames import CANOPEN, cob_id
from word_names import word_names

_TYPES = {"u8": 0x5, "u16": 0x6, "u32": 0x7, "text": 0x9}
_VAR, _ARRAY, _RECORD = 7, 8, 9
_BAUD_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_TEXTS = ("vendor", "product", "serial_number", "firmware")
_MANDATORY, _OWN = (0x1000, 0x1001, 0x1018), 0x2000


def eds_text(*, channels: int = 4, layers: int = 8) -> str:
    """Return the data sheet of an amplifier with these numbers of channels and layers."""
    counts = {"channels": channels, "layers": layers}
    numbers = {
        "vendor_id": f"0x{CANOPEN['vendor_id']:X}",
        "product_code": f"0x{CANOPEN['product_code']:X}",
        "revision": f"0x{CANOPEN['revision']:X}",
        "serial_number": None,
    }
    emergency = f"$NODEID+0x{cob_id('emergency'):X}"
    objects = {
        0x1000: _alone(0x1000, "device_type", "u32", "const", f"0x{CANOPEN['device_type']:X}"),
        0x1001: _alone(0x1001, "error_register", "u8", "ro"),
        0x1014: _alone(0x1014, "emergency_cob_id", "u32", "const", emergency),
        0x1017: _alone(0x1017, "heartbeat", "u16", "rw", f"{CANOPEN['heartbeat_ms']}"),
        0x1018: _several(0x1018, "identity", [(name, "u32", numbers[name]) for name in numbers]),
        0x2000: _several(
            *(0x2000, "texts"),
            [*((name, "text", None) for name in _TEXTS), ("versions", "u16", None)],
        ),
        0x2001: _words(0x2001, "capabilities", "GetCaps", counts, "const"),
        0x2002: _words(0x2002, "status", "GetStatus", counts, "ro"),
    }
    lines = [*_head(channels)]
    kinds = {
        "MandatoryObjects": [index for index in objects if index in _MANDATORY],
        "OptionalObjects": [i for i in objects if i not in _MANDATORY and i < _OWN],
        "ManufacturerObjects": [index for index in objects if index >= _OWN],
    }
    for title, indices in kinds.items():
        listed = {f"{n}": f"0x{index:04X}" for n, index in enumerate(indices, start=1)}
        lines += _section(title, {"SupportedObjects": len(indices), **listed})
        for index in indices:
            lines += objects[index]
    return "\n".join(lines)


def _head(channels: int) -> list[str]:
    file = {
        **{"FileName": "amplifier.eds", "FileVersion": 1, "FileRevision": 1, "EDSVersion": "4.0"},
        "Description": "Amplifier of electrostatic resonant actuators",
    }
    info: dict[str, object] = {
        **{"VendorName": "era-haptics", "VendorNumber": CANOPEN["vendor_id"]},
        "ProductName": f"ERA amplifier, {channels} channels",
        **{"ProductNumber": CANOPEN["product_code"], "RevisionNumber": CANOPEN["revision"]},
        **{f"BaudRate_{rate}": int(rate in (125, 250, 500, 1000)) for rate in _BAUD_RATES},
        **{"SimpleBootUpMaster": 0, "SimpleBootUpSlave": 1, "Granularity": 0},
        **{"DynamicChannelsSupported": 0, "GroupMessaging": 0},
        **{"NrOfRXPDO": 0, "NrOfTXPDO": 0, "LSS_Supported": 0},
    }
    dummies = {f"Dummy{number:04d}": 0 for number in range(1, 8)}
    return [
        *_section("FileInfo", file),
        *_section("DeviceInfo", info),
        *_section("DummyUsage", dummies),
    ]


def _words(
    index: int, name: str, message: str, counts: Mapping[str, int], access: str
) -> list[str]:
    names = word_names(MESSAGES[message].reply, counts)
    return _several(index, name, [(each, "u16", None) for each in names], access)


def _several(
    index: int, name: str, entries: Sequence[tuple[str, str, str | None]], access: str = "const"
) -> list[str]:
    """Return an object with entries (name, type, default)."""
    kind = _ARRAY if len({each[1] for each in entries}) == 1 else _RECORD
    head = {"ParameterName": name, "ObjectType": f"0x{kind:X}", "SubNumber": len(entries) + 1}
    lines = [
        *_section(f"{index:04X}", head),
        *_section(f"{index:04X}sub0", _value("count", "u8", "const", f"{len(entries)}")),
    ]
    for number, (title, type_, default) in enumerate(entries, start=1):
        lines += _section(f"{index:04X}sub{number:X}", _value(title, type_, access, default))
    return lines


def _alone(index: int, name: str, type_: str, access: str, default: str | None = None) -> list[str]:
    return _section(f"{index:04X}", _value(name, type_, access, default))


def _value(name: str, type_: str, access: str, default: str | None) -> dict[str, object]:
    return {
        **{"ParameterName": name, "ObjectType": f"0x{_VAR:X}"},
        **{"DataType": f"0x{_TYPES[type_]:04X}", "AccessType": access},
        **({} if default is None else {"DefaultValue": default}),
        "PDOMapping": 0,
    }


def _section(title: str, values: Mapping[str, object]) -> list[str]:
    return [f"[{title}]", *(f"{name}={value}" for name, value in values.items()), ""]
