"""A daemon, or the baseline, on the lines of a rig, and a panel that touches it."""

import asyncio
import math
import random
import socket
import sys
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.latency.far_side import FarSide
from benchmarks.latency.machine import DAEMON_NICE, TIMEOUT, EndedEarly, running
from controller.api.client import AsyncClient
from controller.api.link import LeaseLost, Unreachable
from controller.sources.touch import Touch, TouchFrame
from examples.make_touches import tuio_datagram
from model.rig.rig import Rig
from model.rig.rig_file import load_rig

EXAMPLES = Path(__file__).parents[2] / "examples"
DAEMON = (sys.executable, "-m", "controller.cli", "daemon")
RESTING = Touch(1, 0.25, 0.3)  # the quiet finger beside taps
UNANSWERED = 0.5  # s
_APART = 0.05  # m; between fingers
_EDGE = 0.06  # of the sensor
_ARMING = 1.0  # s; until what follows arming is over
_TWO_HALVES = """regions:
  west: {{rectangle: {{start: [0 m, 0 m], end: [{middle} m, {plate.width} m]}}, on_press: buzz}}
  east:
    rectangle: {{start: [{middle} m, 0 m], end: [{plate.length} m, {plate.width} m]}}
    on_press: buzz
elsewhere: null
"""


@dataclass
class Session:
    """A running program with its process id, far side and panel; era: None for the baseline."""

    pid: int
    rig: Rig
    far: FarSide
    panel: socket.socket
    era: AsyncClient | None = None
    socket: Path = Path()
    frames: int = 0

    def touch(self, *touches: Touch) -> float:
        """Send a frame; returns when [s], just before."""
        self.frames += 1
        datagram = tuio_datagram(TouchFrame("bench", 0.0, touches), self.frames)
        sent_at = time.monotonic()
        self.panel.send(datagram)
        return sent_at


@asynccontextmanager
async def daemon_session(
    rig_name: str,
    *,
    program: Sequence[object] = DAEMON,
    is_two: bool = False,
) -> AsyncIterator[Session]:
    """Run and arm a daemon for a rig of the examples; is_two: each half of it has a content."""
    with TemporaryDirectory(prefix="era-latency-") as name:
        folder, port = Path(name), _free_port()
        rig, far = _rig_on_lines(rig_name, folder)
        try:
            more = ""
            if is_two:
                (folder / "layout.yaml").write_text(
                    _TWO_HALVES.format(plate=rig.plate, middle=rig.plate.length / 2), "utf-8"
                )
                more = "layouts: {panel: layout.yaml}\n"
            path, config = folder / "socket", folder / "daemon.yaml"
            config.write_text(
                f"rig: rig.yaml\nsocket: socket\n{more}"
                f"touch:\n  - {{name: panel, url: 'tuio:127.0.0.1:{port}'}}\n"
                "log: {level: warning}\n",
                "utf-8",
            )
            async with (
                running(*program, config, nice=DAEMON_NICE, has_line=False) as (process, _),
                await _client(path, process) as era,
            ):
                armed = AsyncExitStack()
                await armed.enter_async_context(era.armed("latency"))
                await asyncio.sleep(_ARMING)
                with _panel(port) as panel:
                    yield Session(process.pid, rig, far, panel, era, path)
                with suppress(LeaseLost):  # by a stop of another client
                    await armed.aclose()
        finally:
            far.close()


@asynccontextmanager
async def plain_session(rig_name: str) -> AsyncIterator[Session]:
    """Run the baseline for a rig of the examples."""
    with TemporaryDirectory(prefix="era-latency-") as name:
        rig, far = _rig_on_lines(rig_name, Path(name))
        command = (sys.executable, "-m", "benchmarks.latency.plain", *far.urls.values())
        try:
            async with running(*command, nice=DAEMON_NICE) as (process, port):
                with _panel(int(port)) as panel:
                    yield Session(process.pid, rig, far, panel)
        finally:
            far.close()


@dataclass(frozen=True)
class Taps:
    """Times [s] from touch to wire; unanswered: touches without a set; sets: that came in all.

    wire, in_amplifiers [s]: medians of what the busiest line would take, and of what this program
    took in place of amplifiers.
    """

    times: np.ndarray
    unanswered: int
    sets: int
    wire: float
    in_amplifiers: float


async def taps(session: Session, count: int, *, is_two: bool = False, seed: int = 1) -> Taps:
    """Tap so often in random places, each when the set of the one before has come.

    A new finger beside one that rests; is_two: one in each half.
    """
    rng = random.Random(seed)
    far, sets = session.far, 0
    times: list[tuple[float, float, float]] = []
    for number in range(count):
        first, second = _fingers(rng, session.rig, number, is_two=is_two)
        far.begin()
        sent_at = session.touch(first, second)
        found = await far.until(lambda: far.playing_since(1 + is_two), UNANSWERED)
        if found is not None:
            times.append((found - sent_at, far.wire_time(), far.used()))
        await far.quiet()
        await asyncio.sleep(rng.uniform(0.0, 0.02))  # at any phase of heartbeats
        sets += far.sets()
    _, wire, used = np.median(times or [(math.nan, math.nan, math.nan)], axis=0)
    latencies = np.array([each[0] for each in times])
    return Taps(latencies, count - len(times), sets, float(wire), float(used))


async def move_ten(session: Session, seconds: float, rate: float = 60.0) -> None:
    """Move ten fingers in circles of 2 cm radius, a turn a second."""
    plate = session.rig.plate
    begun = time.monotonic()
    for number in range(round(seconds * rate)):
        angle = 2 * math.pi * number / rate
        east, north = 0.02 * math.cos(angle) / plate.length, 0.02 * math.sin(angle) / plate.width
        session.touch(
            *(
                Touch(10 + n, 0.14 + 0.18 * (n % 5) + east, (0.3, 0.7)[n // 5] + north)
                for n in range(10)
            )
        )
        await asyncio.sleep(max(0.0, begun + (number + 1) / rate - time.monotonic()))


async def rest_one(session: Session, seconds: float, rate: float = 20.0) -> None:
    """Let one finger rest."""
    for _ in range(round(seconds * rate)):
        session.touch(RESTING)
        await asyncio.sleep(1 / rate)


def _fingers(rng: random.Random, rig: Rig, number: int, *, is_two: bool) -> tuple[Touch, Touch]:
    """The fingers of a tap, the newest last."""
    while True:
        x, y = (rng.uniform(_EDGE, 1 - _EDGE) for _ in range(2))
        first, second = RESTING, Touch(2 * number + 3, x, y)
        if is_two:
            x, y = (rng.uniform(_EDGE, 1 - _EDGE) for _ in range(2))
            first = Touch(2 * number + 2, x / 2, y)
            second = Touch(2 * number + 3, (second.x + 1) / 2, second.y)
        gap = (first.x - second.x) * rig.plate.length, (first.y - second.y) * rig.plate.width
        if math.hypot(*gap) > _APART:
            return first, second


def _rig_on_lines(rig_name: str, folder: Path) -> tuple[Rig, FarSide]:
    """Write a rig into a folder with the URLs of a far side in place of simulated amplifiers."""
    text = (EXAMPLES / f"{rig_name}.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text, "utf-8")
    rig = load_rig(folder / "rig.yaml")
    far = FarSide(rig)
    for url in far.urls.values():
        text = text.replace('"sim://"', f'"{url}"', 1)
    (folder / "rig.yaml").write_text(text, "utf-8")
    return rig, far


async def _client(path: Path, process: asyncio.subprocess.Process) -> AsyncClient:
    """Connect to a daemon once it is ready to be armed; raises EndedEarly."""
    end = time.monotonic() + TIMEOUT
    while process.returncode is None and time.monotonic() < end:
        with suppress(Unreachable):
            client = await AsyncClient.connect(path, name="latency")
            while (await client.status()).state != "READY_TO_SWITCH_ON":  # noqa: ASYNC110
                await asyncio.sleep(0.05)
            return client
        await asyncio.sleep(0.1)
    raise EndedEarly("the daemon was not ready; its log says why")


def _panel(port: int) -> socket.socket:
    panel = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    panel.connect(("127.0.0.1", port))
    return panel


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])
