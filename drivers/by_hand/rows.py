"""Values of messages as rows of a result: in units, with the unit in the name of each key."""

from collections.abc import Mapping
from typing import Any

from drivers.host.comparison import name_of
from drivers.protocol.records import Number, Record, Rows, Values, bits_of
from drivers.protocol.table import (
    FAULTS,
    FEATURES,
    MESSAGES,
    NO_CHANNEL,
    QUANTITIES,
    STATES,
    STATUS_FLAGS,
)

_ENDS: Mapping[str, str] = {
    **{"Hz": "_hz", "s": "_s", "degrees": "_deg", "m": "_m", "V": "_v", "A": "_a"},
    "full levels/s": "_per_s",
}


def in_units(record: Record, values: Values) -> dict[str, Any]:
    """Return the numbers of a record, and those of its rows, in their units."""
    rows: dict[str, Any] = {}
    for field in record.fields:
        if isinstance(field, Number):
            quantity = field.quantity
            value = values[field.name]
            in_unit = value if quantity.per_unit == 1 else quantity.from_wire(value)
            rows[f"{field.name}{_ENDS.get(quantity.unit, '')}"] = in_unit
        elif isinstance(field, Rows):
            rows[field.name] = [in_units(field.record, row) for row in values[field.name]]
    return rows


def names_of_bits(names: Mapping[str, int], value: int) -> list[str]:
    """Return the names of the bits that are set; of an unknown one its value."""
    known = {bit: name for name, bit in names.items()}
    return [known.get(bit, f"{1 << bit:#06x}") for bit in bits_of(value)]


def capability_rows(capabilities: Values) -> dict[str, Any]:
    """Return capabilities for reading; features: what is there besides the contract."""
    rows = in_units(MESSAGES["GetCaps"].reply, capabilities)
    rows["channel_limits"] = rows.pop("limits")
    return {**rows, "features": names_of_bits(FEATURES, capabilities["features"])}


def fault_rows(faults: Values) -> list[dict[str, Any]]:
    """Return latched and past faults for reading, newest first."""
    return [
        {
            "fault": name_of(FAULTS, row["fault"]),
            "channel": None if row["channel"] == NO_CHANNEL else row["channel"],
            "age_s": QUANTITIES["age"].from_wire(row["age"]),
        }
        for row in faults["faults"]
    ]


def status_rows(status: Values) -> dict[str, Any]:
    """Return a status for reading."""
    flags = names_of_bits(STATUS_FLAGS, status["flags"])
    others = [name for name in flags if name not in STATUS_FLAGS]
    level = QUANTITIES["level"]
    return {
        "state": name_of(STATES, status["state"]),
        "fault": name_of(FAULTS, status["fault"]),
        **{name: name in flags for name in STATUS_FLAGS},
        "token": status["token"],
        "high_voltage_v": QUANTITIES["voltage"].from_wire(status["voltage"]),
        "temperature_c": QUANTITIES["temperature"].from_wire(status["temperature"]),
        "watchdog_left_s": QUANTITIES["watchdog_left"].from_wire(status["watchdog_left"]),
        "levels": [level.from_wire(each) for each in status["levels"]],
        "layer_tokens": status["tokens"],
        **({"other_flags": others} if others else {}),
    }
