"""A daemon, or the baseline, on the lines of a rig, and a panel that touches it.

The amplifiers are behind serial servers that record arrival times. Real amplifiers and a real panel
would not use the daemon's processors, so the program that simulates them has the highest priority.
The daemon has the priority of `examples/systemd`; floods have the ordinary priority.
"""

import asyncio
import contextlib
import math
import os
import random
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from controller.api.client import AsyncClient
from controller.api.link import LeaseLost, Unreachable
from controller.sources.touch import Touch, TouchFrame
from drivers.protocol.definition import MESSAGES, decode_request
from drivers.protocol.sets import Assembly, is_last, unpack_layers
from drivers.wires.serial_frames import Frame, FrameReader, frame_length, unpack_words
from examples.make_touches import tuio_datagram
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

BAUD = 921_600
BITS = 10  # of a byte on the line: start, eight, stop
QUIET = 0.03  # s; without a set, after which none is under way
_SET, _COMMIT, _STOP = (MESSAGES[name].number for name in ("Set", "Commit", "Stop"))


@dataclass(frozen=True)
class Vibration:
    """A set that drives layers, on one amplifier, from a time [s]: the arrival of its last byte."""

    token: int
    at: float
    layers: frozenset[int]


class _Server:
    """A serial server of this machine for one host.

    A pseudo-terminal would not do: a kernel thread of ordinary priority carries its bytes. On a
    busy machine this thread can wait longer than a watchdog, regardless of the priorities of the
    daemon and of this program.

    on_data: called with bytes from the host, once `listen` was called.
    """

    def __init__(self, on_data: Callable[[bytes], None]) -> None:
        self._on_data = on_data
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._connected: socket.socket | None = None
        self.url = f"serial+tcp://127.0.0.1:{self._listening.getsockname()[1]}"

    def listen(self) -> None:
        """Start to accept a host, in the running event loop."""
        self._listening.setblocking(False)
        asyncio.get_running_loop().add_reader(self._listening, self._accept)

    def _accept(self) -> None:
        self._hang_up()
        self._connected, _ = self._listening.accept()
        self._connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connected.setblocking(False)
        asyncio.get_running_loop().add_reader(self._connected, self._read)

    def _read(self) -> None:
        assert self._connected is not None
        with suppress(BlockingIOError):
            data = b""
            with suppress(ConnectionError):
                data = self._connected.recv(4096)
            if data:
                self._on_data(data)
            else:
                self._hang_up()

    def _hang_up(self) -> None:
        if self._connected is not None:
            asyncio.get_running_loop().remove_reader(self._connected)
            self._connected.close()
            self._connected = None

    def write(self, data: bytes) -> None:
        """Write to the host; lost without one, or if it does not read."""
        if self._connected is not None:
            with suppress(BlockingIOError, ConnectionError):
                self._connected.send(data)

    def close(self) -> None:
        """Close both sockets."""
        self._hang_up()
        asyncio.get_running_loop().remove_reader(self._listening)
        self._listening.close()


class _Device:
    """One amplifier.

    bytes: on its line until now, of sets and commits with their replies; used [s]: its own time for
    them.
    """

    def __init__(self, name: str, channels: int, changed: Callable[[], None]) -> None:
        self.vibrations: list[Vibration] = []
        self.stopped_at = self.changed_at = 0.0  # s; when the last stop, and set, arrived
        self.bytes, self.used = 0, 0.0
        self._changed = changed
        self._reader, self._assembly = FrameReader(), Assembly()
        self._staged: dict[int, frozenset[int]] = {}
        self._end = SerialAmplifiers({1: SimulatedAmplifier(name, channels=channels)}, self._reply)
        self._line = _Server(self._arrived)
        self._line.listen()
        self.url = self._line.url

    def _arrived(self, data: bytes) -> None:
        now = time.monotonic()
        frames = self._reader.feed(data)
        for frame in frames:
            if frame.kind in (_SET, _COMMIT):
                self.changed_at = now
                self.bytes += frame_length(len(frame.payload))
            elif frame.kind == _STOP:
                self.stopped_at = now
        self._end.receive(data, now)
        for frame in frames:  # after the reply: this is not the amplifier's
            if frame.kind in (_SET, _COMMIT):
                self._note(frame, now)
        if frames:
            self._changed()
        self.used += time.monotonic() - now

    def _reply(self, data: bytes) -> None:
        if time.monotonic() - self.changed_at < QUIET:
            self.bytes += len(data)
        self._line.write(data)

    def _note(self, frame: Frame, now: float) -> None:
        """Record the layers that a set drives, when it starts to play."""
        _, values = decode_request(frame.kind, unpack_words(frame.payload))
        token = values["token"]
        if frame.kind == _SET:
            if not is_last(values):
                self._assembly.keep(values, now)
                return
            if self._assembly.first_missing(values) is not None:
                return
            stream = self._assembly.stream(values)
            driven = (
                each.layer
                for each in unpack_layers(stream)
                if any(command.is_driven for command in each.commands)
            )
            self._staged[token] = frozenset(driven)
            if not values["now"]:
                return
        layers = self._staged.pop(token, None)
        if layers:
            self.vibrations.append(Vibration(token, now, layers))

    def close(self) -> None:
        self._line.close()


class FarSide:
    """All amplifiers of a rig; urls by name."""

    def __init__(self, rig: Rig) -> None:
        self._changed = asyncio.Event()
        self._devices: Sequence[_Device] = [
            _Device(
                name,
                1 + max(each.number for each in rig.wiring.values() if each.amplifier == name),
                self._changed.set,
            )
            for name in rig.amplifiers
        ]
        devices = zip(rig.amplifiers, self._devices, strict=True)
        self.urls: Mapping[str, str] = {name: each.url for name, each in devices}

    def close(self) -> None:
        """Close their lines."""
        for each in self._devices:
            each.close()

    def begin(self) -> None:
        """Reset all records of arrived bytes."""
        for each in self._devices:
            each.vibrations.clear()
            each.stopped_at, each.bytes, each.used = 0.0, 0, 0.0

    def playing_since(self, count: int) -> float | None:
        """Return the time [s] at which the last amplifier got sets of `count` layers, else None."""
        found = []
        for each in self._devices:
            layers: frozenset[int] = frozenset()
            for vibration in each.vibrations:
                layers |= vibration.layers
                if len(layers) >= count:
                    found.append(vibration.at)
                    break
        return max(found) if len(found) == len(self._devices) else None

    def stopped_at(self) -> float | None:
        """Return the time [s] at which the last amplifier got a stop, else None."""
        times = [each.stopped_at for each in self._devices]
        return max(times) if all(times) else None

    def sets(self) -> int:
        """Return the number of sets with vibrations that have arrived at any amplifier."""
        return len({one.token for each in self._devices for one in each.vibrations})

    def wire_time(self) -> float:
        """Return the transmission time [s] of sets and replies on the busiest line."""
        return max(each.bytes for each in self._devices) * BITS / BAUD

    def used(self) -> float:
        """Return the time [s] that this program spent on simulating the amplifiers."""
        return sum(each.used for each in self._devices)

    async def until(self, arrived: Callable[[], float | None], timeout: float) -> float | None:
        """Wait until something has arrived; None after a timeout [s]."""
        end = time.monotonic() + timeout
        while (found := arrived()) is None:
            self._changed.clear()
            try:
                async with asyncio.timeout(end - time.monotonic()):
                    await self._changed.wait()
            except TimeoutError:
                return None
        return found

    async def quiet(self) -> None:
        """Wait until no set is being sent."""
        last = max(each.changed_at for each in self._devices)
        if (left := last + QUIET - time.monotonic()) > 0:
            await asyncio.sleep(left)
            await self.quiet()


DAEMON_NICE = -10  # like in the unit file
TIMEOUT = 180.0  # s; a table may have to be built
_STAT = Path("/proc/stat")
_IDLE, _WAITING, _STOLEN = 3, 4, 7  # columns of /proc/stat's line of all processors, proc(5)

_children: set[int] = set()  # process ids of running programs
_ended = 0.0  # s; processor time of ended programs


class EndedEarly(Exception):
    """A program of the benchmark has ended early, or has not become ready."""


def become_device() -> bool:
    """Take the highest priority, not inherited by children; return False if not permitted."""
    try:
        policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(1))
    except (AttributeError, PermissionError):
        return False
    return True


@asynccontextmanager
async def running(
    *command: object, nice: int = 0, has_line: bool = True
) -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
    """Run a program during a `with` block; yield it and its first line of output.

    Raises EndedEarly if it ends before that line.
    """
    global _ended
    process = await asyncio.create_subprocess_exec(
        *map(str, command),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=nice != 0,
    )
    if nice:
        _set_nice(process.pid, nice)
    _children.add(process.pid)
    try:
        line = b""
        if has_line:
            assert process.stdout is not None
            line = await asyncio.wait_for(process.stdout.readline(), TIMEOUT)
            if not line:
                raise EndedEarly(f"{' '.join(map(str, command[1:4]))} has ended")
        yield process, line.decode().strip()
    finally:
        _ended += computed(process.pid)
        _children.discard(process.pid)
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


def _set_nice(process: int, nice: int) -> None:
    """Set the level of a process and of its session, as far as that is permitted.

    If sessions share the processors, the level of a process counts only within its session. The
    level of the session corresponds to `CPUWeight=` of a unit.
    """
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, process, nice)
    with contextlib.suppress(OSError):
        Path(f"/proc/{process}/autogroup").write_text(str(nice), "ascii")


def computed(process: int) -> float:
    """Processor time [s] of all threads of a process so far; 0 where not reported."""
    total = 0
    for file in Path(f"/proc/{process}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):  # the thread has ended
            total += int(file.read_text("ascii").split()[0])
    return total * 1e-9


class OtherLoad:
    """How busy other programs keep the processors, from construction on."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self._before = _busy_with_others()

    def processors(self) -> float:
        """Average number of processors kept busy by others, including the kernel.

        Includes time stolen by other guests of the host; 0 where the system does not report it.
        """
        lasted = max(time.monotonic() - self._begun, 1e-9)
        return max(0.0, _busy_with_others() - self._before) / lasted


def _busy_with_others() -> float:
    """Processor time [s] of all others since the system started."""
    if not _STAT.exists():
        return 0.0
    busy = busy_ticks(_STAT.read_text("ascii").splitlines()[0]) / os.sysconf("SC_CLK_TCK")
    return busy - _ended - sum(map(computed, [os.getpid(), *_children]))


def busy_ticks(line: str) -> int:
    """Ticks of all processors, neither idle nor waiting, from the first line of /proc/stat."""
    ticks = [int(word) for word in line.split()[1:]]
    # The time of guests is included in the first columns.
    return sum(ticks[: _STOLEN + 1]) - ticks[_IDLE] - ticks[_WAITING]


EXAMPLES = Path(__file__).parents[2] / "examples"
DAEMON = (sys.executable, "-m", "controller.cli", "daemon")
RESTING = Touch(1, 0.25, 0.3)  # the quiet finger during taps
UNANSWERED = 0.5  # s
_APART = 0.05  # m; between fingers
_EDGE = 0.06  # of the sensor
_ARMING = 1.0  # s; until the activity after arming has ended
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
        """Send a frame; return the time [s] just before."""
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
    """Run and arm a daemon for an example rig; is_two: whether each half has its own content."""
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
    """Times [s] from touch to wire; unanswered: touches without a set; sets: total number.

    wire, in_amplifiers [s]: medians of the transmission time on the busiest line, and of the time
    of the simulated amplifiers.
    """

    times: np.ndarray
    unanswered: int
    sets: int
    wire: float
    in_amplifiers: float


async def taps(session: Session, count: int, *, is_two: bool = False, seed: int = 1) -> Taps:
    """Tap at random positions; each tap follows the set for the previous tap.

    A new finger touches while another one rests; is_two: a finger in each half.
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
    """Return the fingers of a tap, the newest last."""
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
    raise EndedEarly("the daemon was not ready; its log has the reason")


def _panel(port: int) -> socket.socket:
    panel = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    panel.connect(("127.0.0.1", port))
    return panel


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])
