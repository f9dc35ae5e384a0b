"""The amplifier at a URL, for one action; what its wire carries; values of messages as rows.

Rows are in units, with the unit in the name of each key.
"""

import asyncio
import math
import random
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

from drivers.host.amplifier import Amplifier
from drivers.host.bounds import FREQUENCY_FLOOR
from drivers.host.clock import REPORTS, reports_of
from drivers.opening import Lines
from drivers.protocol.definition import (
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
from registry import threads
from registry.limits import GuardLimits


def in_units(record: Record, values: Values) -> dict[str, Any]:
    """Return the numbers of a record, and those of its rows, in their units."""
    rows: dict[str, Any] = {}
    for field in record.fields:
        if isinstance(field, Number):
            rows[field.key] = field.in_unit(values)
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
    numbers = {
        key: value
        for key, value in in_units(STATUS, status).items()
        if key not in ("state", "fault", "flags", "latch", "clock")
    }
    return {
        "state": name_of(STATES, status["state"]),
        "fault": name_of(FAULTS, status["fault"]),
        **{name: name in flags for name in STATUS_FLAGS},
        **numbers,
        "clock_s": status["clock"] * HIGH_TIME / HIGH_STEPS,
        "levels": [QUANTITIES["level"].from_wire(each) for each in status["levels"]],
        "layer_tokens": status["tokens"],
        **({"other_flags": others} if others else {}),
        "reports": [
            dict(zip(("kind", "cause", "remedy"), (kind, *REPORTS[kind]), strict=True))
            for kind in reports_of(status)
        ],
    }


CEILINGS = GuardLimits(FREQUENCY_FLOOR, QUANTITIES["frequency"].high, 1.0)
"""Limits where no rig states any."""
_SESSION = QUANTITIES["session"]


@asynccontextmanager
async def reached(
    url: str,
    *,
    limits: GuardLimits = CEILINGS,
    serial_number: str | None = None,
    is_output: bool | None = None,
) -> AsyncIterator[Amplifier]:
    """Open the line of an amplifier while the context lasts; nothing is sent."""
    lines = Lines()
    try:
        yield await lines.amplifier(
            url, limits, name=url, serial_number=serial_number, is_output=is_output
        )
    finally:
        await lines.close()


@asynccontextmanager
async def identified(url: str, *, serial_number: str | None = None) -> AsyncIterator[Amplifier]:
    """Open the line of an amplifier and identify it; what it plays goes on."""
    async with reached(url, serial_number=serial_number) as amplifier:
        await amplifier.identify()
        yield amplifier


async def keep_alive(amplifier: Amplifier, duration: float, interval: float) -> None:
    """Feed the watchdog for a time, at an interval [s]."""
    end = threads.now() + duration
    while (left := end - threads.now()) > 0:
        await asyncio.sleep(min(interval, left))
        await amplifier.ping()


def random_session() -> int:
    """Draw the number of a session, so that it is not taken for another host's."""
    return random.randint(_SESSION.minimum, _SESSION.maximum)  # noqa: S311  no secret


def wire_rows(amplifier: Amplifier) -> dict[str, Any]:
    """Return limits by the wire's speed; empty where that is unknown."""
    takes = amplifier.exchange_time("Set")
    if not takes:
        return {}
    return {
        "wire_round_trip_s": round(takes, 6),
        "sets_per_second_max": math.floor(1 / takes),
        "watchdog_shortest_s": round(shortest_watchdog(takes), 6),
    }
