"""The demonstration: a daemon over simulated amplifiers, and recorded touches.

`run_demo` plays scenes and returns a row per touch, `run_live` serves the page instead.

In a `VirtualTimeLoop`, with the amplifiers in this process (wire `sim`), every machine gives the
same figures. In real time a machine that is too slow spoils them, and the run is void.
"""

import asyncio
import contextlib
import json
import logging
import os
import socket
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.schema import MAX_LEASE
from controller.daemon.config import DaemonConfig, TouchInput, load_daemon_config
from controller.daemon.daemon import Daemon, page_address
from controller.demo.recorder import TouchRecorder
from controller.demo.simulated_plate import (
    SIM_OPTIONS,
    SIMULATED_WATCHDOG,
    SimulatedPlate,
    simulated_plate,
)
from controller.demo.touch_rows import TouchRow
from controller.effects.layout import BUZZ
from controller.operation.operation_states import DaemonState
from controller.process.daemon_process import SocketLock
from controller.process.log import LogThread, start_log
from controller.sources.touch import TouchFrame, TouchSource
from controller.sources.touch_calibration import ALIGNED
from controller.sources.tuio import TuioSource
from controller.sources.tuio_capture import RecordedDatagram, read_capture
from drivers.errors import LinkError
from model.errors import InputError
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from registry import threads
from registry.service_manager import ServiceManager
from registry.virtual_time import VirtualTimeLoop

MIN_ERAS_FOR_THREE = 8
"""Number of ERAs from which three people have their own vibrations, else two."""

SILENT_SHARE = 0.2
"""Share of the plate's length between the strips of several people."""

SIM = "sim"
"""The wire to amplifiers in this process, the only one in virtual time."""
WIRES = (SIM, *SIM_OPTIONS)

_CONTACT_TIMEOUT = 2.0
"""Time [s] without frames until a recorded finger is lifted, long enough for a busy machine."""

DECAY = 0.1
"""Time [s] for the plate to ring down after the last touch."""

READY_TIMEOUT = 30.0
"""Time [s] within which the daemon must be ready to be armed."""

_RIG_FILE = "rig.yaml"
_RECORDER = ("127.0.0.1", 3333)  # host and port of the sender of recorded touches
_TIMEOUT = 60.0  # s; of a request to the daemon, on a machine that is busy
_PAUSE = 0.05  # s; between two looks at the state

_TWO = {"left": None, "right": None}
_THREE = {"left": (70, 110), "middle": (180, 220), "right": (250, 300)}  # Hz


@dataclass(frozen=True)
class Scene:
    """Recorded touches, with positions relative to the size of the plate.

    layout: content of a layout file; by default only the newest finger feels a vibration.
    """

    touches: Sequence[RecordedDatagram]
    layout: Mapping[str, Any] = field(default_factory=lambda: {"elsewhere": BUZZ})


def example_scenes(rig: Rig) -> list[Scene]:
    """The recorded touches of the demonstration of a rig: one person, then two or three."""
    name = "three_people" if _is_for_three(rig) else "two_people"
    return [
        Scene(read_capture(example_touches_path("touches"))),
        Scene(read_capture(example_touches_path(name)), example_layout(rig)),
    ]


def example_layout(rig: Rig) -> dict[str, Any]:
    """The layout for two or three people at a rig's plate."""
    return layout_of_people(rig.plate, _THREE if _is_for_three(rig) else _TWO)


def _is_for_three(rig: Rig) -> bool:
    return len(rig.eras) >= MIN_ERAS_FOR_THREE


def layout_of_people(
    plate: Plate, bands: Mapping[str, tuple[float, float] | None]
) -> dict[str, Any]:
    """Return a layout of upright strips, from west to east, each with a vibration of its own.

    bands: lowest and highest frequency [Hz] by name, None for any. Between the strips, on a fifth
    of the plate, a finger feels nothing.
    """
    width = (1 - SILENT_SHARE) / len(bands)
    pitch = width + SILENT_SHARE / (len(bands) - 1)
    regions = {}
    for number, (name, band) in enumerate(bands.items()):
        west, east = (plate.length * (number * pitch + side) for side in (0, width))
        regions[name] = {
            "rectangle": {"start": [west, 0], "end": [east, plate.width]},
            "on_press": name,
            **({} if band is None else {"band": [*band]}),
        }
    effects = {name: {"kind": "buzz"} for name in bands}
    return {"effects": effects, "regions": regions, "elsewhere": None}


def example_touches_path(name: str) -> Path:
    """Return a recording of the demonstration, from the package or a checkout."""
    file = f"{name}.tuio"
    package = Path(__file__).parents[1]
    installed = package / "data" / file
    return installed if installed.exists() else package.parent / "examples" / file


class RecordedTouches(TouchSource):
    """Recorded datagrams, read as if they came over the network, one recording after the other."""

    def __init__(self) -> None:
        self._opened: asyncio.Future[Callable[[TouchFrame], None]]
        self._opened = asyncio.get_running_loop().create_future()

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver the frames of `play` until cancelled."""
        self._opened.set_result(deliver)
        await asyncio.get_running_loop().create_future()

    async def play(self, recording: Sequence[RecordedDatagram]) -> None:
        """Play a recording at its pace, as a new sender; wait until the source runs."""
        deliver = await self._opened
        reader = TuioSource(f"tuio:?timeout={_CONTACT_TIMEOUT:g}")
        reader.rejects = self.rejects
        start = threads.now()
        for datagram in recording:
            await asyncio.sleep(max(0.0, start + datagram.time - threads.now()))
            frame = reader.read(datagram.payload, _RECORDER, threads.now())
            if frame is not None:
                deliver(frame)


@dataclass(frozen=True)
class _RecordedInput(TouchInput):
    """The touch input of a daemon that plays recorded touches."""

    source: RecordedTouches

    def make(self) -> TouchSource:
        return self.source


@dataclass(frozen=True)
class DemoRun:
    """The rows of a demonstration, in order of time.

    why_void: why the figures do not count, because the machine was too slow; None if they do.
    """

    rows: list[TouchRow]
    why_void: str | None


async def run_demo(
    rig_file: Path,
    table: LocalizationTable,
    *,
    wire: str,
    scenes: Sequence[Scene],
    on_row: Callable[[TouchRow], None],
    seed: int | None = 0,
) -> DemoRun:
    """Play scenes one after another to a daemon, over a wire, onto a simulated plate.

    rig_file: an absolute path; wire: one of WIRES; on_row: called with each row when complete;
    seed: of the plate within the rig's uncertainty, None for the rig's own. Each scene has a layout
    of its own. Raises LinkError if the far end is lost.
    """
    is_real_time = not isinstance(asyncio.get_running_loop(), VirtualTimeLoop)
    touches = RecordedTouches()
    recorded = _RecordedInput("recorded", "recorded:", ALIGNED, touches)
    simulated = on_simulated_plate(
        rig_file,
        {"socket": "era.sock"},
        layouts=[scene.layout for scene in scenes],
        wire=wire,
        seed=seed,
    )
    with log_errors_only():
        async with simulated as (config, lock, plate):
            try:
                async with asyncio.TaskGroup() as tasks:
                    recorder = TouchRecorder(plate, tasks, on_row=on_row)
                    daemon = Daemon(
                        replace(config, touch=(recorded,)),
                        table,
                        log=LogThread(None),
                        manager=ServiceManager({}),
                        dashboard=None,
                        observe=recorder.observe,
                        watchdog=SIMULATED_WATCHDOG,
                    )
                    serving = tasks.create_task(daemon.run(lock))
                    playing = tasks.create_task(
                        play_scenes(scenes, touches, recorder, daemon, config.socket)
                    )
                    await asyncio.wait({serving, playing}, return_when=asyncio.FIRST_COMPLETED)
                    if not playing.done():  # a signal has ended the daemon
                        raise KeyboardInterrupt
                    daemon.shut_down("the demonstration is over")
            except BaseExceptionGroup as failures:
                raise failures.exceptions[0] from None
    rows = sorted(recorder.rows, key=lambda row: row.time_s)
    return DemoRun(rows, recorder.why_void() if is_real_time else None)


async def run_live(
    rig_file: Path,
    table: LocalizationTable,
    *,
    wire: str,
    dashboard: str,
    seed: int | None = 0,
) -> None:
    """Serve the dashboard of a rig over a wire until Ctrl-C; starts disarmed.

    Fingers in each strip of the plate feel a vibration of their own, those between them nothing.
    rig_file, wire, seed: as for `run_demo`; dashboard: HOST:PORT of the loopback. The daemon uses
    the default socket, so that `era status` and others reach it. Raises InputError if one runs
    already, and LinkError.
    """
    log = start_log(None, level="warning")
    try:
        layout = example_layout(load_rig(rig_file))
        async with on_simulated_plate(rig_file, {}, layouts=[layout], wire=wire, seed=seed) as (
            config,
            lock,
            _,
        ):
            daemon = Daemon(
                config,
                table,
                log=log,
                manager=ServiceManager(),
                dashboard=dashboard,
                shows_token=True,  # its output is for a person, also through a pipe
                watchdog=SIMULATED_WATCHDOG,
            )
            await daemon.run(lock)
    finally:
        log.close()


@contextlib.contextmanager
def log_errors_only() -> Iterator[None]:
    """Log errors to standard error and no warnings, which rows and causes report."""
    handler = logging.StreamHandler()
    handler.setLevel(logging.ERROR)
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)


@contextlib.asynccontextmanager
async def on_simulated_plate(
    rig_file: Path,
    daemon_keys: Mapping[str, object],
    *,
    layouts: Sequence[Mapping[str, Any]],
    wire: str,
    seed: int | None,
) -> AsyncIterator[tuple[DaemonConfig, SocketLock, SimulatedPlate]]:
    """Configuration and socket of a daemon of a rig, and the plate that it drives.

    daemon_keys: keys of the daemon file other than the rig; layouts: contents of its layouts.
    """
    async with contextlib.AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="era-")))
        config = load_daemon_config(_daemon_file(folder, rig_file, daemon_keys, layouts))
        lock = SocketLock(config.socket)
        stack.callback(lock.release)
        rig = config.rig
        thresholds = tuple(dict.fromkeys((rig.threshold, *rig.promised_thresholds)))
        plate = await stack.enter_async_context(
            simulated_plate(rig_file, rig.amplifiers, wire=wire, seed=seed, thresholds=thresholds)
        )
        yield replace(config, urls=plate.urls), lock, plate


def _daemon_file(
    folder: Path,
    rig_file: Path,
    daemon_keys: Mapping[str, object],
    layouts: Sequence[Mapping[str, Any]],
) -> Path:
    """Write the daemon's file; it names the rig by a link, since a path may be any bytes."""
    (folder / _RIG_FILE).symlink_to(rig_file.resolve())
    file = folder / "daemon.yaml"
    named = {_layout_name(number): f"{number}.yaml" for number in range(len(layouts))}
    for name, layout in zip(named.values(), layouts, strict=True):
        (folder / name).write_text(json.dumps(layout), encoding="utf-8")
    content = {"rig": _RIG_FILE, "layouts": named, **daemon_keys}
    file.write_text(json.dumps(content), encoding="utf-8")
    return file


def check_page(address: str) -> None:
    """Raise InputError unless HOST:PORT is of the loopback and can be listened on."""
    host, _, port = page_address(address).rpartition(":")
    family = socket.AF_INET6 if host == "[::1]" else socket.AF_INET
    try:
        socket.create_server((host.strip("[]"), int(port)), family=family).close()
    except OSError as error:
        raise InputError(
            f"--dashboard: cannot listen on {address} ({os.strerror(error.errno or 0)}); stop the "
            "other program or give another address, such as --dashboard 127.0.0.1:0 for any free "
            "port"
        ) from error


async def play_scenes(
    scenes: Sequence[Scene],
    touches: RecordedTouches,
    recorder: TouchRecorder,
    daemon: Daemon,
    path: Path,
) -> None:
    """Arm a daemon at a socket, play the scenes to it, and wait until all touches are lifted.

    Raises LinkError if it cannot be armed, or is disarmed meanwhile.
    """
    await daemon.started.wait()
    async with await AsyncClient.connect(path, name="era demo", timeout=_TIMEOUT) as era:
        try:
            await wait_until_ready(era)
            async with era.armed("the demonstration", lease_s=MAX_LEASE):
                recorder.start()
                for number, scene in enumerate(scenes):
                    await era.layout(_layout_name(number))
                    await touches.play(scene.touches)
                    while recorder.touches:  # noqa: ASYNC110  nothing else waits for this
                        await asyncio.sleep(DECAY)
                await asyncio.sleep(DECAY)
        except RpcError as error:
            raise LinkError(f"demonstration aborted: {error}") from error


async def wait_until_ready(era: AsyncClient) -> None:
    """Wait until the daemon can be armed; raises LinkError after `READY_TIMEOUT`."""
    end = threads.now() + READY_TIMEOUT
    status = await era.status()
    while status.state != DaemonState.READY_TO_SWITCH_ON:
        if threads.now() > end:
            raise LinkError(f"simulated amplifiers: not ready: {status.cause}")
        await asyncio.sleep(_PAUSE)
        status = await era.status()


def _layout_name(number: int) -> str:
    """The name of the layout of a scene."""
    return f"scene_{number}"
