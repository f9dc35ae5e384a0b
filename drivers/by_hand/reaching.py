"""Amplifiers by URL: connect to one, discover all, and check those of a configuration.

Discovery lists the serial ports and CAN interfaces of this machine, and sends nothing before it
probes. The checks of a configuration open nothing.
Messages become rows for reading, with units in the names of keys.
"""

import asyncio
import math
import random
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from serial.tools.list_ports import comports

from drivers.errors import CommandError, DriverError, FrameError, LinkError, LinkTimeout
from drivers.host.amplifier import WATCHDOG, Amplifier
from drivers.host.bounds import FREQUENCY_FLOOR
from drivers.host.clock import REPORTS, reports_of
from drivers.opening import Lines
from drivers.protocol.definition import (
    FAULTS,
    FEATURES,
    HIGH_STEPS,
    HIGH_TIME,
    MAX_LOSS_DETECTION_TIME,
    MESSAGES,
    NO_CHANNEL,
    QUANTITIES,
    STATES,
    STATUS,
    STATUS_FLAGS,
    check_watchdog,
    loss_detection_time,
    name_of,
    shortest_watchdog,
)
from drivers.protocol.records import Number, Record, Rows, Values, bits_of
from drivers.urls import ADDRESS, BAUD, BUS_ERROR, CLOCK_ERRORS, RTU_BAUD, line_kind_of
from drivers.wires.can_frames import BITRATE
from drivers.wires.wire import WireAddress, address_of, reply_words, request_words
from registry import threads
from registry.limits import GuardLimits


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
    known = {bit: name for name, bit in names.items()}
    return [known.get(bit, f"{1 << bit:#06x}") for bit in bits_of(value)]


def capability_rows(capabilities: Values) -> dict[str, Any]:
    """Return capabilities in readable form; features: optional ones."""
    rows = in_units(MESSAGES["GetCaps"].reply, capabilities)
    rows["channel_limits"] = rows.pop("limits")
    return {**rows, "features": names_of_bits(FEATURES, capabilities["features"])}


def fault_rows(faults: Values) -> list[dict[str, Any]]:
    """Return latched and past faults in readable form, newest first."""
    return [
        {
            "fault": name_of(FAULTS, row["fault"]),
            "channel": None if row["channel"] == NO_CHANNEL else row["channel"],
            "age_s": QUANTITIES["age"].from_wire(row["age"]),
        }
        for row in faults["faults"]
    ]


def status_rows(status: Values) -> dict[str, Any]:
    """Return a status in readable form."""
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
"""Limits without a rig."""
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
    """Open the line of an amplifier and identify it; its playback continues."""
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
    """Return the limits due to the wire's speed; empty if it is unknown."""
    takes = amplifier.exchange_time("Set")
    if not takes:
        return {}
    return {
        "wire_round_trip_s": round(takes, 6),
        "sets_per_second_max": math.floor(1 / takes),
        "watchdog_shortest_s": round(shortest_watchdog(takes), 6),
    }


_NETWORK = Path("/sys/class/net")
_CAN_TYPE = "280"  # ARPHRD_CAN of Linux
_UNDESCRIBED = "n/a"  # by pyserial
_SPEEDS = (BAUD, 115_200)


@dataclass(frozen=True)
class Candidate:
    """A port or interface: the URLs to try, and the remedy if it is known to be unusable."""

    name: str
    description: str
    urls: tuple[str, ...]
    remedy: str | None = None


def candidates() -> list[Candidate]:
    """List the serial ports and CAN interfaces of this machine, usable or not."""
    return [*_serial_ports(), *_can_interfaces()]


def _serial_ports() -> Iterator[Candidate]:
    for port in sorted(comports()):
        path = port.device
        urls = tuple(f"serial://{path}?baud={speed}" for speed in _SPEEDS)
        urls += (f"modbus+rtu://{path}?baud={RTU_BAUD}#{ADDRESS}",)
        description = "serial port" if port.description == _UNDESCRIBED else port.description
        yield Candidate(path, description, urls)


def _can_interfaces() -> Iterator[Candidate]:
    if not _NETWORK.is_dir():
        return
    for interface in sorted(_NETWORK.iterdir()):
        kind = interface / "type"
        if not kind.is_file() or kind.read_text(encoding="ascii").strip() != _CAN_TYPE:
            continue
        name = interface.name
        is_up = (interface / "operstate").read_text(encoding="ascii").strip() != "down"
        urls = (f"can+socketcan://{name}#{ADDRESS}",)
        remedy = f"interface is down: sudo ip link set {name} up type can bitrate {BITRATE}"
        yield Candidate(name, "CAN interface", urls, remedy=None if is_up else remedy)


Found = Mapping[str, Values | DriverError]
"""Identity of each amplifier, or its problem, by URL."""


async def identify_all(urls: Iterable[str]) -> Found:
    """Identify the amplifiers at these URLs, one after the other."""
    found: dict[str, Values | DriverError] = {}
    for url in urls:
        try:
            async with identified(url) as amplifier:
                found[url] = amplifier.identity
        except DriverError as problem:
            found[url] = problem
    return found


async def discover(
    urls: Sequence[str], *, probes: bool
) -> tuple[dict[str, Any], dict[str, DriverError]]:
    """List ports, interfaces and the amplifiers on them; returns that, and problems by URL.

    urls: identified too; probes: every port is sent identify requests.
    """
    places = candidates()
    probed = [place.urls for place in places if probes and place.remedy is None]
    found = await identify_all(urls)
    # Of mute places each URL takes the time in which a board may start.
    for identified_there in await asyncio.gather(*map(identify_all, probed)):
        found = {**found, **identified_there}
    amplifiers = [
        {"url": url, **{name: identity[name] for name in ("vendor", "product", "serial_number")}}
        for url, identity in found.items()
        if not isinstance(identity, DriverError)
    ]
    rows = [_row(place, found) for place in places]
    problems = {url: who for url in urls if isinstance(who := found[url], DriverError)}
    return {"places": rows, "amplifiers": amplifiers}, problems


def _row(place: Candidate, found: Found) -> dict[str, Any]:
    replies = {url: found[url] for url in place.urls if url in found}
    unusable = (
        str(reply)
        for reply in replies.values()
        # Others were sent a request, and did not reply to it.
        if isinstance(reply, DriverError) and not isinstance(reply, LinkTimeout | FrameError)
    )
    return {
        "place": place.name,
        "description": place.description,
        "urls": list(place.urls),
        "answers": [url for url, who in replies.items() if not isinstance(who, DriverError)],
        "remedy": place.remedy or next(unusable, None),
    }


_CEILING = QUANTITIES["frequency"].high


def check_links(
    urls: Mapping[str, str], *, channels: Mapping[str, int], limits: GuardLimits
) -> tuple[dict[str, str], list[str]]:
    """Return errors by amplifier name, and warnings.

    urls by name; channels: number of wired channels by name, missing if none; limits: of the
    rig.
    """
    errors: dict[str, str] = {}
    addresses: dict[str, WireAddress] = {}
    round_trips: dict[str, float] = {}
    by_place: dict[tuple[str, int], str] = {}
    lines: dict[str, WireAddress] = {}
    for name, url in urls.items():
        try:
            address = address_of(url)
            words = request_words("Set"), reply_words("Set")
            round_trips[name] = address.make_wire().exchange_time(*words)
            check_watchdog(WATCHDOG, round_trips[name])
            address.check_agrees(lines.setdefault(address.line, address).settings)
        except (CommandError, LinkError) as error:
            errors[name] = str(error)
            continue
        other = by_place.setdefault((address.line, address.number), name)
        if other != name:
            errors[name] = f"URL must be unique, got {url!r}, already used by amplifier {other}"
            continue
        addresses[name] = address
    used = {name: address for name, address in addresses.items() if channels.get(name)}
    warnings = [
        *_ceiling_warnings(limits),
        *_late_loss_warnings(used, round_trips),
    ]
    return errors, warnings


def _ceiling_warnings(limits: GuardLimits) -> list[str]:
    """Warn of limits beyond the fixed range of playback."""
    low, high = limits.frequency_min, limits.frequency_max
    if low >= FREQUENCY_FLOOR and high <= _CEILING:
        return []
    return [
        f"limits.frequency should be within {FREQUENCY_FLOOR:g} to {_CEILING:g} Hz, got {low:g} to "
        f"{high:g} Hz; frequencies outside are never played"
    ]


def _late_loss_warnings(
    addresses: Mapping[str, WireAddress], round_trips: Mapping[str, float]
) -> list[str]:
    """Warn of lines on which a loss may be detected later than MAX_LOSS_DETECTION_TIME.

    round_trips [s]: of a set to each.
    """
    lines: dict[str, list[str]] = {}
    for name, address in addresses.items():
        lines.setdefault(address.line, []).append(name)
    limit = MAX_LOSS_DETECTION_TIME
    warnings = []
    for names in lines.values():
        took = loss_detection_time(map(round_trips.__getitem__, names))
        if took > limit:
            warnings.append(
                f"{', '.join(names)}: loss of the amplifiers may be detected only after "
                f"{took * 1e3:.0f} ms, later than {limit * 1e3:.0f} ms; the watchdog stops them "
                "regardless: use a faster line, or one line per amplifier, if that is too late"
            )
    return warnings


_ONE_BUS = "one bus for all amplifiers"
_REMEDIES = {
    **dict.fromkeys(("usb-full-speed", "ftdi-low-latency"), f"a high-speed adapter, or {_ONE_BUS}"),
    "ftdi": "the latency timer of the FTDI chip at 1 ms, or a high-speed adapter",
    "can-usb": "an adapter of high speed",
    "ethernet": _ONE_BUS,
}
"""Better alternatives to separate lines of a kind."""
_CLOCKS = "clocks of a smaller clock_error"


@dataclass(frozen=True)
class Arrangement:
    """Amplifiers with ERAs, by name; lines: their lines; errors: RMS errors of their clocks [s].

    remedy: how to synchronise them better; empty if that is impossible.
    """

    lines: str
    errors: Mapping[str, float]
    remedy: str


def arrangement_of(
    urls: Mapping[str, str], *, channels: Mapping[str, int], stated: Mapping[str, float]
) -> Arrangement | None:
    """Return the arrangement of the amplifiers with ERAs; None for a single one.

    urls, channels: see `check_links`; stated: specified error of each clock [s], infinite if it
    cannot be steered. Invalid URLs have no arrangement.
    """
    addresses: dict[str, WireAddress] = {}
    for name, url in urls.items():
        try:
            if channels.get(name):
                addresses[name] = address_of(url)
        except (CommandError, LinkError):
            return None
    if len(addresses) < 2:
        return None
    kinds = {name: line_kind_of(urls[name]) for name in addresses}
    is_one = len({address.line for address in addresses.values()}) == 1
    lines = f"{'one line' if is_one else 'separate lines'} ({', '.join(sorted({*kinds.values()}))})"
    is_bus = is_one and "ethernet" not in kinds.values()  # behind which each has its connection
    highest = BUS_ERROR if is_bus else math.inf
    by_line = {name: min(CLOCK_ERRORS[kind], highest) for name, kind in kinds.items()}
    by_clock = {name: stated[name] / math.sqrt(3) for name in kinds}
    errors = {name: math.hypot(by_clock[name], by_line[name]) for name in kinds}
    worst = max(errors, key=errors.__getitem__)
    remedy = "" if is_bus else _REMEDIES.get(kinds[worst], "")
    return Arrangement(lines, errors, _CLOCKS if by_clock[worst] > by_line[worst] else remedy)
