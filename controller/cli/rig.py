"""`era rig check`: whether a rig is wired and built as its file says; the group `era rig`."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controller.cli.identify import identify
from model.counting import counted
from model.errors import InputError

if TYPE_CHECKING:
    from model.diagnosis.observation import Observation
    from model.rig.rig import Rig

rig_app = typer.Typer(no_args_is_help=True, help="Check and identify a rig.")

FAILED = 1
_REPLY_TIMEOUT = 0.5  # s; a check may be slow, and silence is the task of the watchdog
_MAX_LEVEL = 0.2  # more than any check needs


rig_app.command()(identify)


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
        typer.Option(
            "--without-phases",
            help="Ignore the phases of the file, which do not refer to the drive.",
        ),
    ] = False,
    url: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=URL", help="URL of an amplifier instead of the one in the rig file."
        ),
    ] = None,
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP", help="Frequencies; default: twelve over the range of the rig."
        ),
    ] = None,
    grid: Annotated[str, typer.Option(metavar="NxM", help="Grid of sensors on the plate.")] = "4x3",
    noise: Annotated[
        float, typer.Option(metavar="M/S2/RTHZ", help="Noise density of the simulated sensors.")
    ] = 0.005,
    level: Annotated[
        float, typer.Option(help="Level of every tone, 0 to 0.2 of full stroke.")
    ] = 0.05,
    settle: Annotated[
        float, typer.Option(metavar="S", help="Settling time before each measurement.")
    ] = 0.8,
    listen: Annotated[float, typer.Option(metavar="S", help="Duration of each measurement.")] = 0.2,
    mesh: Annotated[
        str | None, typer.Option(metavar="NxM", help="Mesh instead of the one in the rig file.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
) -> None:
    """Check whether a rig is wired and built as its file says.

    Drives each channel, or reads measured responses. Exit status 1 if the check fails.
    """
    import time

    from model.diagnosis import diagnosis_report
    from model.diagnosis.verdict import diagnose
    from model.rig.file import load_rig

    if (sensors is None) == (measured is None):
        raise InputError(
            "give either --sensors SOCKET (the control socket of an `era sim` with this plate, to "
            "drive its channels) or --measured FILE"
        )
    rig = load_rig(rig_file, mesh=mesh)
    started = time.perf_counter()
    if measured is not None:
        observation = _from_file(rig, measured, has_phases=not without_phases)
    else:
        assert sensors is not None  # noqa: S101  one of them is given
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
        exactly_known = [*rig.uncertainty.exactly_known]
        answer = {"exactly_known": exactly_known, "elapsed_s": elapsed}
        print(json.dumps({**diagnosis_report.as_json(verdict), **answer}))
    else:
        low, high = verdict.frequencies.min(), verdict.frequencies.max()
        print(
            f"{rig_file}: {counted(verdict.sensor_count, 'sensor')}, "
            f"{counted(len(verdict.frequencies), 'frequency', plural='frequencies')} "
            f"from {low:g} to {high:g} Hz, {elapsed:.1f} s"
        )
        if note := rig.uncertainty.note:
            print(note)
        print()
        print(
            "\n".join(
                [
                    *diagnosis_report.channel_table(verdict),
                    "",
                    *diagnosis_report.verdict_rows(verdict),
                    *diagnosis_report.difference_rows(verdict),
                ]
            )
        )
    if not verdict.is_well:
        raise typer.Exit(FAILED)


def _from_file(rig: "Rig", path: Path, *, has_phases: bool) -> "Observation":
    from model.calibration.responses import responses_of
    from model.calibration.responses_file import read_functions
    from model.diagnosis.observation import Observation

    return Observation(**vars(responses_of(read_functions(path), rig)), has_phases=has_phases)


def _frequencies(rig: "Rig", text: str | None) -> list[float]:
    import numpy as np

    from model.config.points import parse_frequencies

    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    if text is None:
        # Inside the limits, and no multiples of the mains frequency.
        return [round(float(f), 1) for f in np.linspace(low + 17.3, high - 13.1, 12)]
    found = [float(f) for f in parse_frequencies(text)]
    if not all(low <= f <= high for f in found):
        raise InputError(
            f"--frequencies must be within {low:g} to {high:g} Hz, limits.frequency of the rig, "
            f"got {text}"
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

    from controller.cli.amplifier_urls import urls_of
    from controller.diagnosis.channel_sweep import ChannelSweep
    from controller.diagnosis.sensors import simulated_sensors
    from drivers.amplifier import Amplifier
    from drivers.registry import open_backend
    from model.config.points import parse_pair

    if not 0 < level <= _MAX_LEVEL:
        raise InputError(f"--level must be above 0 and at most {_MAX_LEVEL:g}, got {level:g}")
    if not (0 <= settle <= 60 and 0.02 <= listen <= 8):
        raise InputError(
            f"--settle must be 0 to 60 s and --listen 0.02 to 8 s, got {settle:g} and {listen:g} s"
        )
    nx, ny = parse_pair(grid, what="--grid")
    plate = rig.plate
    points = [
        ((column + 0.5) / nx * plate.length, (row + 0.5) / ny * plate.width)
        for row in range(ny)
        for column in range(nx)
    ]
    at = urls_of(rig, urls)
    show = sys.stderr.isatty() and not quiet

    def on_step(text: str) -> None:
        if show:
            sys.stderr.write(f"\r\033[K{text}")
            sys.stderr.flush()

    async def measure() -> "Observation":
        async with simulated_sensors(control, points, noise=noise) as sensors:
            amplifiers = {
                name: Amplifier(
                    open_backend(at[name], rig.voltage_of(name)), reply_timeout=_REPLY_TIMEOUT
                )
                for name in rig.amplifiers
            }
            sweep = ChannelSweep(
                rig,
                amplifiers,
                sensors,
                level=level,
                settle=settle,
                listen=listen,
                on_step=on_step,
            )
            return await sweep.run(frequencies)

    try:
        return asyncio.run(measure())
    finally:
        on_step("")
