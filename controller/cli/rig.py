"""`era rig check`: whether a rig is wired and built as its file says."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.counting import counted
from model.errors import InputError

if TYPE_CHECKING:
    from model.diagnosis.observation import Observation
    from model.rig.rig import Rig

rig_app = typer.Typer(no_args_is_help=True, help="A rig and what it really is.")

NOT_WELL = 1
_REPLY_TIMEOUT = 0.5  # s; nobody feels a check that is late, and silence is the watchdog's task
_LEVEL_MAX = 0.2  # a check is no demonstration


@rig_app.callback()
def _group() -> None:
    """Keeps `check` a command of its own while it is the only one."""


@rig_app.command()
def check(
    rig_file: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file, e.g. RIG.yaml.")],
    sensors: Annotated[
        Path | None,
        typer.Option(metavar="SOCKET", help="Control socket of an `era sim` with this plate."),
    ] = None,
    measured: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Responses of each channel: .csv or .uff."),
    ] = None,
    without_phases: Annotated[
        bool,
        typer.Option("--without-phases", help="The file's phases are not those of the drive."),
    ] = False,
    url: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=URL", help="Where an amplifier is, if not where the rig says."),
    ] = None,
    frequencies: Annotated[
        str | None,
        typer.Option(metavar="LO:HI:STEP", help="Twelve over the rig's range unless given."),
    ] = None,
    grid: Annotated[str, typer.Option(metavar="NxM", help="Sensors on the plate.")] = "4x3",
    noise: Annotated[
        float, typer.Option(metavar="M/S2/RTHZ", help="Of the simulated sensors.")
    ] = 0.005,
    level: Annotated[float, typer.Option(help="Of every tone, 0 to 0.2 of full stroke.")] = 0.05,
    settle: Annotated[float, typer.Option(metavar="S", help="Before each is measured.")] = 0.8,
    listen: Annotated[float, typer.Option(metavar="S", help="While it is measured.")] = 0.2,
    mesh: Annotated[str | None, typer.Option(metavar="NxM", help="In place of the rig's.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, nothing else.")] = False,
) -> None:
    """Say whether a rig is what its file says. Exit status 1 if it is not.

    Drives each channel, or reads what it did.
    """
    import time

    from model.diagnosis import diagnosis_report
    from model.diagnosis.verdict import diagnose
    from model.rig.file import load_rig

    if (sensors is None) == (measured is None):
        raise InputError(
            "what do sensors say? Give one of --sensors SOCKET (the control socket of an `era sim` "
            "with this plate, whose channels are then driven) and --measured FILE"
        )
    rig = load_rig(rig_file, mesh=mesh)
    started = time.perf_counter()
    if measured is not None:
        observation = _from_file(rig, measured, has_phases=not without_phases)
    else:
        assert sensors is not None  # noqa: S101  one of both is given
        observation = _live(
            rig,
            sensors,
            urls=url or [],
            frequencies=_frequencies(rig, frequencies),
            grid=grid,
            noise=noise,
            level=level,
            settle=settle,
            listen=listen,
            quiet=as_json,
        )
    verdict = diagnose(rig, observation)
    elapsed = time.perf_counter() - started
    if as_json:
        print(json.dumps({**diagnosis_report.as_json(verdict), "elapsed_s": elapsed}))
    else:
        low, high = verdict.frequencies.min(), verdict.frequencies.max()
        print(
            f"{rig_file}: {counted(verdict.sensor_count, 'sensor')}, "
            f"{counted(len(verdict.frequencies), 'frequency', plural='frequencies')} "
            f"from {low:g} to {high:g} Hz, {elapsed:.1f} s"
        )
        print()
        print(
            "\n".join(
                [
                    *diagnosis_report.channel_table(verdict),
                    "",
                    *diagnosis_report.verdict_rows(verdict),
                ]
            )
        )
    if not verdict.is_well:
        raise typer.Exit(NOT_WELL)


def _from_file(rig: "Rig", path: Path, *, has_phases: bool) -> "Observation":
    from model.calibration.responses import responses_of
    from model.calibration.responses_file import read_functions
    from model.diagnosis.observation import observation_of

    return observation_of(responses_of(read_functions(path), rig), has_phases=has_phases)


def _frequencies(rig: "Rig", text: str | None) -> list[float]:
    import numpy as np

    from model.config.points import parse_frequencies

    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    if text is None:
        # Not up to the very limits, and no round numbers, on which mains hum lies.
        return [round(float(f), 1) for f in np.linspace(low + 17.3, high - 13.1, 12)]
    found = [float(f) for f in parse_frequencies(text)]
    if not all(low <= f <= high for f in found):
        raise InputError(
            f"--frequencies {text}: the rig's limits.frequency are {low:g} to {high:g} Hz"
        )
    return found


def _live(
    rig: "Rig",
    control: Path,
    *,
    urls: list[str],
    frequencies: list[float],
    grid: str,
    noise: float,
    level: float,
    settle: float,
    listen: float,
    quiet: bool,
) -> "Observation":
    import asyncio

    from controller.diagnosis.drive import Drive
    from controller.diagnosis.sensors import simulated_sensors
    from drivers.amplifier import Amplifier
    from drivers.registry import open_backend
    from model.config.points import parse_pair

    if not 0 < level <= _LEVEL_MAX:
        raise InputError(f"--level {level:g}: take one above 0 and at most {_LEVEL_MAX:g}")
    if not (0 <= settle <= 60 and 0.02 <= listen <= 8):
        raise InputError("--settle takes 0 to 60 s, --listen 0.02 to 8 s")
    nx, ny = parse_pair(grid, what="--grid")
    plate = rig.plate
    points = [
        ((column + 0.5) / nx * plate.length, (row + 0.5) / ny * plate.width)
        for row in range(ny)
        for column in range(nx)
    ]
    at = _urls(rig, urls)
    show = sys.stderr.isatty() and not quiet

    def on_step(text: str) -> None:
        if show:
            sys.stderr.write(f"\r\033[K{text}")
            sys.stderr.flush()

    async def measure() -> "Observation":
        async with simulated_sensors(control, points, noise=noise) as sensors:
            amplifiers = {
                name: Amplifier(open_backend(at[name]), reply_timeout=_REPLY_TIMEOUT)
                for name in rig.amplifiers
            }
            drive = Drive(
                rig,
                amplifiers,
                sensors,
                level=level,
                settle=settle,
                listen=listen,
                on_step=on_step,
            )
            return await drive.run(frequencies)

    try:
        return asyncio.run(measure())
    finally:
        on_step("")


def _urls(rig: "Rig", texts: list[str]) -> dict[str, str]:
    """The URL of each amplifier: the rig's, or what an option says."""
    found = dict(rig.amplifiers)
    for text in texts:
        name, equals, url = text.partition("=")
        if not equals or name not in found:
            raise InputError(
                f"--url {text}: write NAME=URL; the rig has {', '.join(rig.amplifiers)}"
            )
        found[name] = url
    return found
