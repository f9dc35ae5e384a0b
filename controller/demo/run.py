"""Runs the demonstration: far end, controller, recorded touches, rows, picture."""

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from controller.demo.far_end import SIM_OPTIONS, WATCHDOG, simulated_plate
from controller.demo.picture import choose_rows, touches_figure
from controller.demo.recorder import TouchRecorder
from controller.demo.touch_row import TouchRow
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from controller.sources.capture import RecordedDatagram, replay_capture
from controller.sources.tuio import TuioSource
from drivers.errors import CommandRefused
from drivers.garbage_collection import no_long_collections
from drivers.opening import Lines
from model.figures import save_figure
from model.rig.file import load_rig
from model.table.table import LocalizationTable
from model.table.timing import Timing

WIRES = (*SIM_OPTIONS, "sim")

CONTACT_TIMEOUT = 2.0
"""Time [s] after which a recorded finger without news is lifted, for a machine that is busy."""

DECAY = 0.1
"""Time [s] for the plate to ring down after the last touch."""


def example_touches_path() -> Path:
    """The recorded touches of the demonstration: installed with this package, or in a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "data" / "touches.tuio"
    return installed if installed.exists() else package.parent / "examples" / "touches.tuio"


async def run_demo(
    rig_file: Path,
    table: LocalizationTable,
    *,
    wire: str,
    touches: Sequence[RecordedDatagram],
    on_row: Callable[[TouchRow], None],
    seed: int | None = 0,
) -> list[TouchRow]:
    """Play recorded touches into a controller, over a wire, onto a simulated plate.

    wire: one of WIRES; touches: of a TUIO capture; on_row: called with each row when complete;
    seed: of the plate within the rig's uncertainty, None for the rig's own. Return all rows in
    order of time. Raises LinkError if the far end is lost.
    """
    rig = load_rig(rig_file)
    async with simulated_plate(
        rig_file, rig.amplifiers, wire=wire, seed=seed, threshold=rig.threshold
    ) as plate:
        tuio = TuioSource(f"tuio:127.0.0.1:0?timeout={CONTACT_TIMEOUT:g}")
        await tuio.open()
        recorder = TouchRecorder(plate, on_row=on_row)
        refused = asyncio.Event()
        controller = Controller(
            rig,
            table,
            lines=Lines,
            urls=plate.urls,
            sources=[tuio],
            observer=noting_refusals(recorder.observer, refused),
            timing=Timing(table),
            watchdog=WATCHDOG,
        )
        await controller.open()
        try:
            with no_long_collections():
                await controller.arm()
                running = asyncio.create_task(controller.run())
                arming = asyncio.create_task(
                    keep_armed(controller, refused, recovered=recorder.recovered)
                )
                playing = asyncio.create_task(_play(touches, tuio, recorder))
                tasks = (running, arming, playing)
                try:
                    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                    for task in tasks:
                        if task.done():
                            task.result()
                finally:
                    for task in tasks:
                        task.cancel()
                    await asyncio.gather(*tasks, return_exceptions=True)
            await recorder.finish()
        finally:
            await controller.close()
    return recorder.rows


def noting_refusals(observer: Observer, refused: asyncio.Event) -> Observer:
    """An observer that also sets an event when an amplifier refuses something."""

    def note(reason: str) -> None:
        refused.set()
        observer.refused(reason)

    return replace(observer, refused=note)


async def keep_armed(
    controller: Controller, refused: asyncio.Event, *, recovered: Callable[[], None]
) -> None:
    """Arm simulated amplifiers again whose watchdogs have expired while the machine stalled.

    refused: set when one refuses something; recovered: called when they are armed again.
    """
    while True:
        await refused.wait()
        refused.clear()
        try:
            await controller.arm()  # changes nothing where all still are
        except CommandRefused:
            await controller.clear()
            await controller.arm()
            recovered()


async def _play(
    touches: Sequence[RecordedDatagram], tuio: TuioSource, recorder: TouchRecorder
) -> None:
    """Play the touches and wait until the last one counts as lifted and the plate is at rest."""
    recorder.start()
    await replay_capture(touches, tuio.host, tuio.port)
    await asyncio.sleep(DECAY)  # the last datagrams arrive
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(CONTACT_TIMEOUT):
            await recorder.all_lifted()
    await asyncio.sleep(DECAY)


def write_picture(table: LocalizationTable, rows: list[TouchRow], folder: Path) -> list[Path]:
    """Draw some of the touches into a folder; return no file if nothing was played."""
    chosen = choose_rows(rows)
    if not chosen:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "touches.png"
    save_figure(touches_figure(table, chosen), path)
    return [path]
