"""Actions of `era amp` on one amplifier; each returns the rows of its result."""

import asyncio
import contextlib
import math
import shlex
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict
from typing import Any

from drivers import clock
from drivers.amplifier import WATCHDOG, Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.conformance import LEVEL, Check, CheckResult, raw_line
from drivers.conformance.report import ConformanceReport
from drivers.conformance.series import not_started, run_checks
from drivers.errors import CommandError, CommandRefused, DriverError, LinkError
from drivers.guard import FREQUENCY_CEILING, FREQUENCY_FLOOR, LEVEL_CEILING, Guard, GuardLimits
from drivers.link.link import REPLY_TIMEOUT
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.keep_alive import keep_alive
from drivers.operation.silence import stop_and_confirm, stop_outcome
from drivers.operation.watchdog import check_watchdog, shortest_watchdog
from drivers.protocol.classes import amplifier_class
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import AmplifierState, Feature, SensorUnit, Status
from drivers.registry import open_backend
from drivers.urls.address import with_address

_TAKING_ADDRESS = 0.1  # s; until an amplifier replies at its new address
_STOP_TIMEOUT = 2.0  # s; for boards that restart when their port is opened
_PATIENT_TIMEOUT = 0.2  # s; of replies under test, whose time is measured
_RAMP = 0.05  # s; neither start nor end of a drive clicks
_SENSOR_UNITS = {
    SensorUnit.ACCELERATION: "m/s²",
    SensorUnit.VELOCITY: "m/s",
    SensorUnit.DISPLACEMENT: "m",
    SensorUnit.FORCE: "N",
    SensorUnit.VOLTAGE: "V",
}
_UNITS = {
    **dict.fromkeys(("frequency_min", "frequency_max", "frequency_step"), "_hz"),
    **dict.fromkeys(("ramp_max", "watchdog_min", "watchdog_max"), "_s"),
    **dict.fromkeys(("envelope_step_min", "envelope_step_max"), "_s"),
    "phase_step": "_deg",
}
"""Units of capabilities, as ends of their keys."""


async def identify(url: str) -> dict[str, Any]:
    """Read identity, capabilities and wire times."""
    async with _opened(url) as amplifier:
        capabilities = asdict(amplifier.capabilities)
        features = capabilities.pop("features")
        limits = [
            {f"{name}{_UNITS.get(name, '')}": value for name, value in one.items()}
            for one in capabilities.pop("channel_limits")
        ]
        return {
            "url": url,
            **asdict(amplifier.identity),
            "class": amplifier_class(amplifier.capabilities).value,
            **{f"{name}{_UNITS.get(name, '')}": value for name, value in capabilities.items()},
            "channel_limits": limits,
            "features": _feature_names(features),
            **_wire_rows(amplifier),
        }


async def status(url: str) -> dict[str, Any]:
    """Read status, faults and link timing."""
    async with _opened(url) as amplifier:
        now = await amplifier.status()
        faults = await amplifier.faults()
        measured = await amplifier.measured()
        return {
            "url": url,
            **_status_rows(now),
            "measured": [{"voltage_v": one.voltage, "current_a": one.current} for one in measured],
            "faults": [
                {"fault": record.fault.name, "channel": record.channel, "age_s": record.age}
                for record in faults
            ],
            "last_round_trip_s": amplifier.statistics.last_round_trip,
            **_wire_rows(amplifier),
        }


async def sensors(url: str) -> dict[str, Any]:
    """Read what the sensors measure, and where."""
    async with _opened(url) as amplifier:
        found = await amplifier.sensors()
    return {
        "url": url,
        "sensors": [
            {
                "sensor": number,
                "measures": one.unit.name.lower(),
                "unit": _SENSOR_UNITS.get(one.unit),
                "channel": one.channel,
                "x_m": one.x,
                "y_m": one.y,
                "range": one.range,
                "frequency_max_hz": one.frequency_max,
                "sample_rate_hz": one.sample_rate,
                "count_step": one.count_step,
            }
            for number, one in enumerate(found)
        ],
    }


async def measure(url: str, frequencies: Sequence[float], window: float) -> dict[str, Any]:
    """Measure tones [Hz] at every sensor over a window [s]; what plays goes on."""
    async with _opened(url) as amplifier:
        if Feature.SENSORS not in amplifier.capabilities.features:
            raise CommandError("the amplifier has no sensors")
        described = await amplifier.sensors()
        reading = await amplifier.measure(frequencies, window)
    return {
        "url": url,
        "state": reading.state.name,
        "token": reading.token,
        "window_s": window,
        "sensors": [
            {
                "sensor": number,
                "unit": _SENSOR_UNITS.get(described[number].unit),
                "overload": one.is_overloaded,
                "tones": [
                    {"frequency_hz": at, "amplitude": tone.amplitude, "phase_deg": tone.phase}
                    for at, tone in zip(frequencies, one.tones, strict=True)
                ],
            }
            for number, one in enumerate(reading.sensors)
        ],
    }


async def stop(url: str) -> dict[str, Any]:
    """Stop all channels; the amplifier is identified after the first Stop."""
    amplifier = Amplifier(open_backend(url))
    rows: dict[str, Any] = {}
    try:
        try:
            await amplifier.connect()
        except LinkError as error:
            outcome = stop_outcome(
                None,
                latch_before=None,
                last_fed_at=None,
                watchdog=None,
                now=clock.now(),
                cause=str(error),
            )
        else:
            outcome = await stop_and_confirm(amplifier, timeout=_STOP_TIMEOUT)
            with contextlib.suppress(DriverError):
                rows = _status_rows(await amplifier.status())
    finally:
        await amplifier.close()
    return {"url": url, **outcome.to_json(clock.now()), **rows}


async def set_address(url: str, address: int, serial_number: str | None) -> dict[str, Any]:
    """Give the amplifier at a URL, or that of a serial number, another address on its line."""
    moved = with_address(url, address)
    if serial_number is None:
        async with _opened(url) as amplifier:
            serial_number = amplifier.identity.serial_number
            if Feature.ADDRESS not in amplifier.capabilities.features:
                raise CommandError("the address of this amplifier cannot be set over its wire")
            if (await amplifier.status()).state is not AmplifierState.SWITCH_ON_DISABLED:
                raise CommandRefused("an address is set while disarmed; disarm the amplifier first")
            await amplifier.set_address(address, serial_number)
    else:
        amplifier = Amplifier(open_backend(url))
        try:
            await amplifier.connect()
            await amplifier.set_address(address, serial_number)
        finally:
            await amplifier.close()
    await asyncio.sleep(_TAKING_ADDRESS)
    async with _opened(moved, serial_number=serial_number):
        return {"url": moved, "serial_number": serial_number}


async def clear(url: str) -> dict[str, Any]:
    """Acknowledge a stop or a fault."""
    async with _opened(url) as amplifier:
        return {"url": url, **_status_rows(await amplifier.clear())}


async def drive(
    url: str, *, channel: int, frequency: float, level: float, duration: float
) -> dict[str, Any]:
    """Drive one channel for a time [s]; ends silent and disarmed."""
    max_duration = PROTOCOL.quantities.valid_for.high
    if not 0 < duration <= max_duration:
        raise CommandError(
            f"--for must be above 0 and at most {max_duration:g} s, got {duration:g} s"
        )
    ceiling = GuardLimits(FREQUENCY_FLOOR, FREQUENCY_CEILING, LEVEL_CEILING)
    async with _opened(url, take_over=True) as amplifier:
        guard = Guard(ceiling, amplifier.capabilities)
        command = DriveCommand(channel=channel, frequency=frequency, level=level)
        requested = CommandSet(
            token=amplifier.next_token(),
            commands=(command,),
            ramp=min(_RAMP, amplifier.capabilities.ramp_max),
            valid_for=duration,
        )
        try:
            safe = guard.check(requested)
        except CommandRefused as refused:
            raise CommandError(str(refused)) from refused  # bad input, not a refusal
        watchdog = max(WATCHDOG, amplifier.capabilities.watchdog_min)
        check_watchdog(watchdog, amplifier.round_trip())
        try:
            checked = CheckedAmplifier(amplifier)
            await _arm(checked, watchdog, url)
            achieved = await checked.apply(safe)
            await keep_alive(checked, duration, interval=watchdog / 5)
        finally:
            # An amplifier that cannot be reached is stopped by its watchdog.
            with contextlib.suppress(DriverError):
                await amplifier.disarm(_RAMP)
        await asyncio.sleep(_RAMP)
        after = await amplifier.status()
    played = [
        {
            "channel": command.channel,
            "frequency_hz": command.frequency,
            "level": command.level,
            "phase_deg": command.phase,
        }
        for command in achieved.commands
    ]
    return {"url": url, "achieved": played, "duration_s": duration, **_status_rows(after)}


async def conform(
    url: str,
    checks: tuple[Check, ...],
    on_result: Callable[[CheckResult], None],
    *,
    level: float = LEVEL,
    before: ConformanceReport | None = None,
) -> ConformanceReport:
    """Run checks in turn on one amplifier; on_result: called with each result.

    level: see `run_check`; before: report of earlier checks, which this one continues:
    then a link that cannot be opened any more makes these checks inconclusive instead of a
    LinkError.
    """
    raw = raw_line(url)
    try:
        async with _opened(url, reply_timeout=_PATIENT_TIMEOUT) as amplifier:
            results = await run_checks(
                checks,
                amplifier,
                raw,
                url=url,
                level=level,
                on_result=on_result,
            )
            driven = min(level, amplifier.capabilities.level_max)
            stated = amplifier_class(amplifier.capabilities).value
    except LinkError as loss:
        if before is None:
            raise
        results = tuple(not_started(check, raw, str(loss)) for check in checks)
        for result in results:
            on_result(result)
        stated, driven = before.amplifier_class, 0.0
    if not any(result.check.drives for result in results):
        driven = 0.0
    report = ConformanceReport(url, stated, results, driven)
    return before.followed_by(report) if before else report


@asynccontextmanager
async def _opened(
    url: str,
    *,
    take_over: bool = False,
    reply_timeout: float = REPLY_TIMEOUT,
    serial_number: str | None = None,
) -> AsyncIterator[Amplifier]:
    amplifier = Amplifier(
        open_backend(url), reply_timeout=reply_timeout, serial_number=serial_number
    )
    await amplifier.open(take_over=take_over)
    try:
        yield amplifier
    finally:
        await amplifier.close()


async def _arm(checked: CheckedAmplifier, watchdog: float, url: str) -> None:
    """Arm with a watchdog [s]; a refusal after a stop or fault names the remedy."""
    try:
        await checked.arm(watchdog)
    except CommandRefused as refused:
        now = await checked.amplifier.status()
        if now.state not in (
            AmplifierState.QUICK_STOP_ACTIVE,
            AmplifierState.FAULT_REACTION_ACTIVE,
            AmplifierState.FAULT,
        ):
            raise
        raise CommandRefused(
            f"the amplifier does not arm: state {now.state.name}, fault {now.fault.name}; once the "
            f"cause is gone: era amp clear {shlex.quote(url)}"
        ) from refused


def _wire_rows(amplifier: Amplifier) -> dict[str, Any]:
    """Limits by the wire's speed; empty where that is unknown."""
    round_trip = amplifier.round_trip()
    if not round_trip:
        return {}
    return {
        "wire_round_trip_s": round(round_trip, 6),
        "sets_per_second_max": int(1 / round_trip),
        "watchdog_shortest_s": round(shortest_watchdog(round_trip), 6),
    }


def _feature_names(features: Feature) -> list[str]:
    """Names of features in the order of their bits; an unknown one is its bit."""
    names = {1 << bit: name for name, bit in PROTOCOL.features.items()}
    return [names.get(bit, f"{bit:#06x}") for bit in (1 << n for n in range(16)) if features & bit]


def _status_rows(status: Status) -> dict[str, Any]:
    return {
        "state": status.state.name,
        "fault": status.fault.name,
        "interlock_open": status.interlock_open,
        "token": status.token,
        "high_voltage": status.high_voltage,
        "high_voltage_v": status.voltage,
        "temperature_c": None if math.isnan(status.temperature) else status.temperature,
        "watchdog_left_s": status.watchdog_left,
        "levels": list(status.levels),
        **({"other_flags": status.other_flags} if status.other_flags else {}),
    }
