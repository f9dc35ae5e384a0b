"""The `era amp` commands: talk to one amplifier by hand."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drivers.errors import CommandError, CommandRefused, DriverError, FrameError, LinkError

if TYPE_CHECKING:
    from drivers.amplifier import Amplifier
    from drivers.protocol.messages import Achieved, Status

EXIT_STATUS: dict[type[BaseException], int] = {
    CommandError: 2,
    CommandRefused: 1,
    LinkError: 3,
    FrameError: 3,
}

_RAMP = 0.05  # s; neither start nor end of a drive clicks

app = typer.Typer(no_args_is_help=True)
amp = typer.Typer(no_args_is_help=True, help="Talk to one amplifier by hand.")
app.add_typer(amp, name="amp")


@app.callback()
def _group() -> None:
    """Keeps `amp` a group of its own, also where this app stands alone."""


Url = Annotated[
    str, typer.Argument(help="serial:///dev/ttyUSB0?baud=921600 or sim://RIG", show_default=False)
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


@amp.command()
def identify(url: Url, json_: Json = False) -> None:
    """Who the amplifier is and what it can play."""
    _show(_run(_identify(url)), as_json=json_)


@amp.command()
def status(url: Url, json_: Json = False) -> None:
    """How the amplifier is, and what went wrong with it."""
    _show(_run(_status(url)), as_json=json_)


@amp.command()
def drive(
    url: Url,
    channel: Annotated[int, typer.Option(help="Output of the amplifier, from 0.")] = 0,
    frequency: Annotated[float, typer.Option(help="Mechanical frequency in Hz.")] = 110.0,
    level: Annotated[float, typer.Option(help="0 to 1 of full stroke.")] = 0.2,
    duration: Annotated[float, typer.Option("--for", help="How long, in s.")] = 0.5,
    json_: Json = False,
) -> None:
    """Let one channel vibrate for a while; ends silent and disarmed, whatever happens."""
    _show(
        _run(_drive(url, channel=channel, frequency=frequency, level=level, duration=duration)),
        as_json=json_,
    )


@amp.command()
def stop(url: Url, json_: Json = False) -> None:
    """Quick stop: silent at once, and refusing to play until it is cleared."""
    _show(_run(_stop(url)), as_json=json_)


@amp.command()
def clear(url: Url, json_: Json = False) -> None:
    """Acknowledge a stop, or a fault whose cause is gone; the amplifier stays disarmed."""
    _show(_run(_clear(url)), as_json=json_)


def _run(result: Coroutine[Any, Any, dict[str, Any]]) -> dict[str, Any]:
    return asyncio.run(result)


def _show(result: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(result))
        return
    width = max(len(key) for key in result)
    for key, value in result.items():
        print(f"{key:{width}}  {value if isinstance(value, str) else json.dumps(value)}")


@asynccontextmanager
async def _opened(url: str) -> AsyncIterator["Amplifier"]:
    from drivers.amplifier import Amplifier
    from drivers.registry import open_backend

    amplifier = Amplifier(open_backend(url))
    await amplifier.open()
    try:
        yield amplifier
    finally:
        await amplifier.close()


async def _identify(url: str) -> dict[str, Any]:
    async with _opened(url) as amplifier:
        who, what = amplifier.identity, amplifier.capabilities
        return {
            "url": url,
            "vendor": who.vendor,
            "product": who.product,
            "serial_number": who.serial_number,
            "firmware": who.firmware,
            "protocol_version": who.protocol_version,
            "channels": what.channels,
            "frequency_min_hz": what.frequency_min,
            "frequency_max_hz": what.frequency_max,
            "frequency_step_hz": what.frequency_step,
            "level_max": what.level_max,
            "level_step": what.level_step,
            "phase_step_deg": what.phase_step,
            "ramp_max_s": what.ramp_max,
            "watchdog_min_s": what.watchdog_min,
            "watchdog_max_s": what.watchdog_max,
            "envelope_knots": what.envelope_knots,
        }


async def _status(url: str) -> dict[str, Any]:
    async with _opened(url) as amplifier:
        now = await amplifier.status()
        faults = await amplifier.faults()
        return {
            "url": url,
            **_status_row(now),
            "faults": [
                {"fault": record.fault.name, "channel": record.channel, "age_s": record.age}
                for record in faults
            ],
        }


async def _stop(url: str) -> dict[str, Any]:
    async with _opened(url) as amplifier:
        return {"url": url, **_status_row(await amplifier.stop())}


async def _clear(url: str) -> dict[str, Any]:
    async with _opened(url) as amplifier:
        return {"url": url, **_status_row(await amplifier.clear())}


async def _drive(
    url: str, *, channel: int, frequency: float, level: float, duration: float
) -> dict[str, Any]:
    from drivers.amplifier import WATCHDOG
    from drivers.command import CommandSet, DriveCommand
    from drivers.guard import FREQUENCY_CEILING, FREQUENCY_FLOOR, LEVEL_CEILING, Guard, GuardLimits
    from drivers.protocol.definition import PROTOCOL

    longest = PROTOCOL.quantities.valid_for.high
    if not 0 < duration <= longest:
        raise CommandError(f"--for is {duration:g} s; it must lie between 0 and {longest:g} s")
    ceiling = GuardLimits(FREQUENCY_FLOOR, FREQUENCY_CEILING, LEVEL_CEILING)
    async with _opened(url) as amplifier:
        guard = Guard(ceiling, amplifier.capabilities)
        wanted = DriveCommand(channel=channel, frequency=frequency, level=level)
        safe = guard.check(
            CommandSet(
                token=amplifier.next_token(),
                commands=(wanted,),
                ramp=min(_RAMP, amplifier.capabilities.ramp_max),
                valid_for=duration,
            )
        )
        watchdog = max(WATCHDOG, amplifier.capabilities.watchdog_min)
        try:
            await amplifier.arm(watchdog)
            achieved = await amplifier.apply(safe)
            await _keep_alive(amplifier, duration, beat=watchdog / 5)
        finally:
            # What cannot be told to the amplifier any more is left to its watchdog.
            with contextlib.suppress(DriverError):
                await amplifier.disarm(_RAMP)
        await asyncio.sleep(_RAMP)
        after = await amplifier.status()
    return {"url": url, **_achieved_row(achieved), "duration_s": duration, **_status_row(after)}


async def _keep_alive(amplifier: "Amplifier", duration: float, *, beat: float) -> None:
    """Feed the watchdog for a while [s], a heartbeat every `beat` [s]; raises CommandRefused.

    That is where the amplifier has stopped by itself meanwhile.
    """
    from drivers.protocol.messages import State

    loop = asyncio.get_running_loop()
    end = loop.time() + duration
    while (left := end - loop.time()) > 0:
        await asyncio.sleep(min(beat, left))
        status = await amplifier.heartbeat()
        if status.state is not State.OPERATION_ENABLED:
            raise CommandRefused(
                f"the amplifier ended the drive by itself: it is in {status.state.name}, fault "
                f"{status.fault.name}; see era amp status, and era amp clear once the cause is gone"
            )


def _achieved_row(achieved: "Achieved") -> dict[str, Any]:
    return {
        "achieved": [
            {
                "channel": command.channel,
                "frequency_hz": command.frequency,
                "level": command.level,
                "phase_deg": command.phase,
            }
            for command in achieved.commands
        ]
    }


def _status_row(status: "Status") -> dict[str, Any]:
    return {
        "state": status.state.name,
        "fault": status.fault.name,
        "token": status.token,
        "high_voltage": status.high_voltage,
        "temperature_c": status.temperature,
        "watchdog_left_s": status.watchdog_left,
        "levels": list(status.levels),
    }
