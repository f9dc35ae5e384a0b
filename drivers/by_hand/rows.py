"""Messages as rows for reading: values in their units, with units in the names of keys."""

import math
from collections.abc import Mapping
from typing import Any

from drivers.host.amplifier import Amplifier
from drivers.host.statuses import REPORTS, reports_of
from drivers.host.stops import StopOutcome
from drivers.protocol.definition import (
    CLOCK_UNKNOWN,
    FAULTS,
    FEATURES,
    HIGH_STEPS,
    HIGH_TIME,
    MESSAGES,
    NO_CHANNEL,
    QUANTITIES,
    STATES,
    STATUS,
    STATUS_FLAGS,
    name_of,
    shortest_watchdog,
)
from drivers.protocol.records import Number, Record, Rows, Values, bits_of

_OTHERWISE_SHOWN = ("state", "fault", "flags", "latch", "clock")
"""Numbers of a status that are not shown as they are."""


def in_units(record: Record, values: Values) -> dict[str, Any]:
    """Return the numbers of a record and its rows in their units."""
    rows: dict[str, Any] = {}
    for field in record.fields:
        if isinstance(field, Number):
            rows[field.key] = field.in_unit(values)
        elif isinstance(field, Rows):
            rows[field.name] = [in_units(field.record, row) for row in values[field.name]]
    return rows


def names_of_bits(names: Mapping[str, int], value: int) -> list[str]:
    """Return the names of the set bits; for an unknown bit its value."""
    name_by_bit = {bit: name for name, bit in names.items()}
    return [name_by_bit.get(bit, f"{1 << bit:#06x}") for bit in bits_of(value)]


def capability_rows(capabilities: Values) -> dict[str, Any]:
    """Return capabilities in readable form; features: optional ones."""
    rows = in_units(MESSAGES["GetCaps"].reply, capabilities)
    rows["channel_limits"] = rows.pop("limits")
    if capabilities["clock_error"] == CLOCK_UNKNOWN:
        rows["clock_error_s"] = None
    rows["features"] = names_of_bits(FEATURES, capabilities["features"])
    return rows


def fault_rows(faults: Values) -> list[dict[str, Any]]:
    """Return latched and past faults in readable form, newest first."""
    rows = []
    for fault in faults["faults"]:
        channel = fault["channel"]
        rows.append(
            {
                "fault": name_of(FAULTS, fault["fault"]),
                "channel": None if channel == NO_CHANNEL else channel,
                "age_s": QUANTITIES["age"].from_wire(fault["age"]),
            }
        )
    return rows


def status_rows(status: Values) -> dict[str, Any]:
    """Return a status in readable form."""
    flags = names_of_bits(STATUS_FLAGS, status["flags"])
    rows: dict[str, Any] = {
        "state": name_of(STATES, status["state"]),
        "fault": name_of(FAULTS, status["fault"]),
    }
    for name in STATUS_FLAGS:
        rows[name] = name in flags
    for key, value in in_units(STATUS, status).items():
        if key not in _OTHERWISE_SHOWN:
            rows[key] = value
    rows["clock_s"] = status["clock"] * HIGH_TIME / HIGH_STEPS
    rows["levels"] = [QUANTITIES["level"].from_wire(level) for level in status["levels"]]
    rows["layer_tokens"] = status["tokens"]
    unknown_flags = [flag for flag in flags if flag not in STATUS_FLAGS]
    if unknown_flags:
        rows["other_flags"] = unknown_flags
    rows["reports"] = []
    for kind in reports_of(status):
        cause, remedy = REPORTS[kind]
        rows["reports"].append({"kind": kind, "cause": cause, "remedy": remedy})
    return rows


def wire_rows(amplifier: Amplifier) -> dict[str, Any]:
    """Return the limits due to the wire's speed; empty if it is unknown."""
    set_time = amplifier.exchange_time("Set")
    if not set_time:
        return {}
    return {
        "wire_round_trip_s": round(set_time, 6),
        "sets_per_second_max": math.floor(1 / set_time),
        "watchdog_shortest_s": round(shortest_watchdog(set_time), 6),
    }


def silence_rows(outcome: StopOutcome, now: float) -> dict[str, Any]:
    """Return the API fields `silence`, `may_play_for_s` and `cause` of a stop; now [s]."""
    left = outcome.may_play_until - now
    if outcome.is_confirmed:
        silence = "confirmed_silent"
    elif left > 0:
        silence = "may_play"
    else:
        silence = "watchdog_elapsed"
    may_play_for = None
    if not outcome.is_confirmed and left < math.inf:
        may_play_for = round(max(left, 0.0), 3)
    return {"silence": silence, "may_play_for_s": may_play_for, "cause": outcome.cause}
