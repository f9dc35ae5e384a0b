"""Measuring the plate on the table by the amplifiers of its rig, as commands do."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from model.errors import InputError

if TYPE_CHECKING:
    from model.config.document import Document
    from model.identification.measured_plate import MeasuredPlate
    from model.rig.rig import Rig


@contextmanager
def rig_of_file(path: Path) -> "Iterator[tuple[Document, Rig]]":
    """Read a rig's file, or that which a daemon's file names while its daemon cannot run.

    Raises InputError, also where the daemon runs: it holds the amplifiers.
    """
    from controller.daemon.config import daemon_config_of, is_daemon_document, rig_file_of
    from controller.daemon.socket_lock import SocketLock
    from model.config.document import read_document
    from model.rig.file import rig_of

    document = read_document(path)
    if not is_daemon_document(document):
        yield document, rig_of(document)
        return
    config, rig_file = daemon_config_of(document), rig_file_of(document)
    assert rig_file is not None  # noqa: S101  else a problem was reported
    lock = SocketLock(config.socket)
    try:
        yield read_document(rig_file), config.rig
    finally:
        lock.release()


def require_untouched(*, is_known: bool, has_terminal: bool) -> None:
    """Raise InputError, or typer.Abort, unless somebody says that nothing touches the plate."""
    if is_known:
        return
    if not (has_terminal and sys.stdin.isatty()):
        raise InputError(
            "nothing may touch the plate while it is measured; look, and say so with --yes"
        )
    typer.confirm("Nothing touches the plate, and will not for a minute?", abort=True, err=True)


def measured_by_amplifiers(
    rig: "Rig", urls: list[str], *, level: float | None, is_quick: bool, is_shown: bool
) -> "MeasuredPlate":
    """Measure by the rig's amplifiers, with a progress bar on a terminal.

    urls: `[NAME=]URL` in place of those of the rig; level: of every tone, None for the usual one;
    is_quick: every tone on one ERA only. Raises DriverError and InputError.
    """
    import asyncio

    from controller.diagnosis.plate_measurement import PlateSelfMeasurement
    from drivers.opening import Lines

    at = _urls_of(rig, urls)

    async def measure() -> "MeasuredPlate":
        with shown_progress("steps", is_shown=is_shown) as on_step:
            return await PlateSelfMeasurement(
                rig, Lines, at, level=level, is_quick=is_quick, on_step=on_step
            ).run()

    return asyncio.run(measure())


def shown_progress(
    unit: str, *, is_shown: bool
) -> AbstractContextManager[Callable[[int, int], None]]:
    """A progress bar of units in plural, or nothing, which yields its update(done, total)."""
    from model.commands.options import progress_bar

    return progress_bar(unit) if is_shown else nullcontext(lambda done, total: None)


def _urls_of(rig: "Rig", texts: Sequence[str]) -> dict[str, str]:
    """Return the URL of each amplifier by name; texts: NAME=URL, or a URL where there is one.

    Raises InputError for an amplifier that the rig does not have.
    """
    found = dict(rig.amplifiers)
    for text in texts:
        name, equals, url = text.partition("=")
        if len(found) == 1 and "://" in name:
            (name,), equals, url = found, "=", text
        if not equals or name not in found:
            raise InputError(
                f"--url must be NAME=URL with one of {', '.join(rig.amplifiers)}, got {text}"
            )
        found[name] = url
    return found


def measured_line(rig: "Rig", measured: "MeasuredPlate") -> str:
    """What was measured, in one line."""
    from model.counting import counted

    measurement = measured.measurement
    low, high = measurement.frequencies[0], measurement.frequencies[-1]
    return (
        f"{counted(len(rig.eras), 'ERA')}, {counted(len(measurement.sensors), 'sensor')}, "
        f"{counted(len(measurement.frequencies), 'tone')} from {low:g} to {high:g} Hz at a level "
        f"of {measured.level:.3g}, {counted(measurement.count, 'response')} in "
        f"{measured.duration:.1f} s"
    )


def measured_json(measured: "MeasuredPlate") -> dict[str, object]:
    """How it was measured, for programs."""
    measurement = measured.measurement
    return {
        "sensors": list(measured.sensors),
        "sensors_unused": list(measured.notes),
        "frequencies_hz": measurement.frequencies.tolist(),
        "level": measured.level,
        "responses": measurement.count,
        "measure_time_s": measured.duration,
        **measured.details,
    }
