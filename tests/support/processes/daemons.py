"""Daemons for tests: within the event loop, as a process, or only their API in memory.

In the loop and in virtual time the line to the simulated amplifiers is memory, and every request
is judged; in real time it is a pseudo-terminal. As a process it plays over real
wires to a far end in the test's own process, whose clock, time.monotonic(), is the same for all
processes, or to a far end that is a process too, with its control socket at hand.
"""

import asyncio
import contextlib
import json
import logging
import os
import struct
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.link import Notification
from controller.api.methods import METHODS
from controller.api.schema import ApiMessage, Empty
from controller.api.server import ApiServer, Connection
from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.daemon import Daemon
from controller.process.daemon_process import SocketLock
from controller.process.log import LogThread
from drivers.host.amplifier import Amplifier as AmplifierAmplifier
from drivers.host.set_admission import StagedSet
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import READINGS
from drivers.protocol.records import Number, Refusal, Values
from drivers.protocol.sets import unpack_layers
from kit.chain import Chain
from kit.clock import VirtualLoop, feed
from kit.host_rules import HostRules, tell_first
from kit.plate_judge import PlateJudge
from kit.plates import small_table, write_rig
from kit.wires import WIRES, FarSide, far_side
from model.arrays import FloatArray
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import save_table
from processes.installed import ERA
from processes.patient_daemon import PROGRAM, allow_long_watchdogs, wait_long
from registry import threads
from registry.limits import GuardLimits
from registry.service_manager import ServiceManager
from sim.amplifier.simulated_amplifier import SimulatedAmplifier

PATIENCE = 180.0  # s; generous, for a loaded machine
PLACE = (0.1, 0.1)
READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"


@dataclass
class DaemonBench:
    """A serving daemon, its far end, and the task that runs it."""

    daemon: Daemon
    far: FarSide
    socket: Path
    running: "asyncio.Task[None]"

    async def client(self, name: str = "test") -> AsyncClient:
        """Connect a client."""
        return await AsyncClient.connect(self.socket, name=name, timeout=PATIENCE)


def stated_readings(bench: DaemonBench) -> list[tuple[Number, float]]:
    """The readings of the first amplifier with their values now, by the steps of the table."""
    bench.far.summary()
    stated = bench.far.amplifier.status(bench.far.bench.time)
    return [
        (reading, (stated[reading.name] - reading.quantity.zero) / reading.quantity.per_unit)
        for reading in READINGS
    ]


@cache
def daemon_table() -> LocalizationTable:
    """A small table of the example's plate."""
    return small_table()


def write_daemon(
    folder: Path,
    urls: dict[str, str],
    more: str = "",
    *,
    changes: Sequence[tuple[str, str]] = (),
) -> Path:
    """Write a rig with these URLs and a daemon's file beside it.

    more: further lines of the daemon's file; changes: replacements in the rig's text.
    """
    write_rig(
        folder / "rig.yaml",
        *changes,
        *(
            (f'{name}: {{url: "sim://"}}', f'{name}: {{url: "{url}"}}')
            for name, url in urls.items()
        ),
    )
    path = folder / "daemon.yaml"
    path.write_text(f"rig: rig.yaml\nsocket: era.sock\n{more}", encoding="utf-8")
    return path


@asynccontextmanager
async def ready_daemon(
    folder: Path, more: str = "", **options: Any
) -> AsyncIterator[tuple[DaemonBench, AsyncClient]]:
    """A daemon that is ready to be armed, and a client of it; options: as for `daemon_at`."""
    async with running_daemon(folder, more, **options) as bench, await bench.client() as era:
        await ready(era)
        yield bench, era


@asynccontextmanager
async def running_daemon(
    folder: Path, more: str = "", **options: Any
) -> AsyncIterator[DaemonBench]:
    """A serving daemon; more: further lines of its file; options: as for `daemon_at`."""
    is_patient = not isinstance(asyncio.get_running_loop(), VirtualLoop)
    async with (
        far_end(folder, is_patient=is_patient) as far,
        daemon_at(far, folder, more, **options) as bench,
    ):
        yield bench


@asynccontextmanager
async def far_end(
    folder: Path, *, changes: Sequence[tuple[str, str]] = (), is_patient: bool = False
) -> AsyncIterator[FarSide]:
    """The example's amplifier on a serial line; changes: replacements in the rig's text.

    is_patient: it takes a long watchdog, for a daemon of `patient_daemon` or in this process.
    """
    with pytest.MonkeyPatch.context() as patch:
        if is_patient:
            allow_long_watchdogs(patch)
        rig = load_rig(write_rig(folder / "bench.yaml", *changes))
        async with far_side(WIRES["serial"], rig) as far:
            yield far


@asynccontextmanager
async def daemon_at(
    far: FarSide,
    folder: Path,
    more: str = "",
    *,
    changes: Sequence[tuple[str, str]] = (),
    environment: Mapping[str, str] | None = None,
    table: Callable[[Rig], LocalizationTable] = lambda rig: daemon_table(),
    has_reader: bool = False,
) -> AsyncIterator[DaemonBench]:
    """A serving daemon at an existing far end.

    changes: replacements in the rig's text; environment: that its service manager gives it; table:
    that of its rig; has_reader: whether it reloads as in use, in a child, which takes a second to
    import, or in this process.
    """
    config = load_daemon_config(write_daemon(folder, dict(far.urls), more, changes=changes))
    lock, log = SocketLock(config.socket), LogThread(folder / "log")
    manager = ServiceManager(environment or {})
    loop = asyncio.get_running_loop()
    is_virtual = isinstance(loop, VirtualLoop)
    patch = pytest.MonkeyPatch()
    if not is_virtual:  # a machine that stalls delays daemon, amplifier and test
        wait_long(patch)
    daemon = Daemon(config, table(config.rig), log=log, manager=manager, dashboard=None)
    chain = chain_of(daemon, far) if is_virtual else None
    if not has_reader:
        patch.setattr("controller.daemon.reload.read_in_child", _read_here)
    task = asyncio.create_task(daemon.run(lock))
    logging.getLogger().addHandler(log)
    try:
        await until(lambda: config.socket.is_socket() or task.done())
        if task.done():
            task.result()
        yield DaemonBench(daemon, far, config.socket, task)
    finally:
        daemon.shut_down("end of the test")
        try:
            await asyncio.wait_for(task, None if is_virtual else PATIENCE)
        finally:
            logging.getLogger().removeHandler(log)
            log.close()
            manager.close()
            lock.release()
            patch.undo()
    if chain is not None:
        chain.plate_judge.close()
        chain.judge()


def _read_here(file: Path, frequencies: FloatArray) -> DaemonConfig:
    return load_daemon_config(file).for_table(frequencies)


def chain_of(daemon: Daemon, far: FarSide) -> Chain:
    """The chain of a daemon in virtual time, which hears of its fingers and faults."""
    assert far.machine is not None
    rules = HostRules(far.urls)
    chain = Chain(far, far.machine, rules, PlateJudge(far, rules), lambda: daemon.controller)
    touched = partial(chain.plate_judge.touched, must_be_felt=False)
    for owner, method in ((daemon.controller.cycle, "deliver"), (daemon.inputs, "deliver")):
        tell_first(owner, method, touched)
    for device in far.devices.values():
        tell_first(device, "inject_fault", lambda *_: rules.disturb())
    return chain


@asynccontextmanager
async def holding(
    era: AsyncClient, *places: tuple[float, float], far: FarSide | None = None
) -> AsyncIterator[None]:
    """Hold fingers down while the connection lasts; far: wait until its amplifier plays."""

    async def repeat() -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await era.touch(places or [PLACE])
                await asyncio.sleep(0.03)

    task = asyncio.create_task(repeat())
    try:
        if far is not None:
            await until(lambda: any(far.summary().levels))
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(holds: Callable[[], object], *, patience: float = PATIENCE) -> None:
    """Wait until a condition holds; fail after `patience` [s]."""
    end = threads.now() + patience
    while not holds():
        assert threads.now() < end, "condition not met in time"
        await asyncio.sleep(0.005)


async def until_state(client: AsyncClient, *states: str) -> str:
    """Wait until the daemon is in one of these states; return it."""
    end = threads.now() + PATIENCE
    while (state := (await client.status()).state) not in states:
        assert threads.now() < end, f"daemon stays in {state}: {(await client.status()).cause}"
        await asyncio.sleep(0.01)
    return state


async def ready(era: AsyncClient) -> None:
    """Wait until it can be armed; acknowledge any stop, loss or fault, as of a busy machine."""
    while await until_state(era, READY, "FAULT", "QUICK_STOP_ACTIVE") != READY:
        with contextlib.suppress(RpcError):  # the cause may persist
            await era.clear()


async def next_event(client: AsyncClient, *topics: str) -> Notification:
    """Wait for the next notification of one of these topics."""
    async with asyncio.timeout(PATIENCE):
        async for event in client.events():
            if event.topic in topics:
                return event
    raise AssertionError("connection closed")


async def error_code(request: Awaitable[object]) -> ErrorCode:
    """Await a request that must be refused; return the code."""
    with pytest.raises(RpcError) as caught:
        await request
    return caught.value.code


FEEDING = ("Ping", "Set", "Commit", "Silence", "Arm", "Disarm", "Stop")
"""What a host that is alive sends while something may play."""


@dataclass(frozen=True)
class Asked:
    """A request that an amplifier got at a time [s], and its levels thereafter.

    is_refused: whether it refused the request.
    """

    time: float
    amplifier: str
    name: str
    values: Values
    is_refused: bool
    levels: tuple[float, ...]

    @property
    def raises(self) -> bool:
        """Whether it is a set, of one part, that asks for more than silence."""
        if self.name != "Set" or self.values["parts"] > 1:
            return self.name == "Set"
        layers = unpack_layers(self.values["stream"])
        return any(command.is_driven for layer in layers for command in layer.commands)


class Journal:
    """Listens at a far end from now on."""

    def __init__(self, far: FarSide) -> None:
        self.entries: list[Asked] = []
        self._far = far
        exchange = far.bench.exchange

        def noted(amplifier: str, name: str, values: Values, *, now: float) -> Any:
            is_refused = False
            try:
                return exchange(amplifier, name, values, now=now)
            except Refusal:
                is_refused = True
                raise
            finally:
                at = far.bench.time
                levels = far.bench.amplifiers[amplifier].summary(at).levels
                self.entries.append(Asked(at, amplifier, name, values, is_refused, levels))

        far.bench.exchange = noted  # type: ignore[method-assign]

    async def hear(self, requests: int) -> None:
        """Wait until so many more requests have come; a heartbeat comes every 50 ms."""
        enough = len(self.entries) + requests
        await until(lambda: len(self.entries) >= enough)

    def since(self, time: float) -> list[Asked]:
        """What was asked after a time [s]."""
        return [entry for entry in self.entries if entry.time > time]

    def raising_since(self, time: float) -> list[Asked]:
        """The sets after a time [s] that ask for more than silence."""
        return [entry for entry in self.since(time) if entry.raises]

    def last_fed(self, amplifier: str) -> float:
        """When [s] one of them has taken something that feeds its watchdog, for the last time."""
        return max(
            entry.time
            for entry in self.entries
            if entry.amplifier == amplifier and entry.name in FEEDING and not entry.is_refused
        )

    def widest_gap(self, since: float, until: float) -> float:
        """The longest time [s] between two signs of life in a window."""
        times = [e.time for e in self.since(since) if e.name in FEEDING]
        moments = [since, *(time for time in times if time <= until), until]
        return max(later - earlier for earlier, later in pairwise(moments))


def energised(far: FarSide) -> list[str]:
    """The amplifiers that are enabled now, or on their way out of it, or still audible."""
    summaries = {name: far.summary(name) for name in far.devices}
    alive = ("OPERATION_ENABLED", "SWITCHED_ON", "FAULT_REACTION_ACTIVE")
    return [
        name for name, summary in summaries.items() if summary.state in alive or any(summary.levels)
    ]


def silent_from(far: FarSide) -> float:
    """When [s] every channel of every amplifier is silent, or was; -inf where none ever played."""
    return max(silent_from_of(far, name) for name in far.devices)


def silent_from_of(far: FarSide, name: str) -> float:
    """The same of one amplifier; what has faded is no longer among its tones."""
    far.summary()
    amplifier = cast(SimulatedAmplifier, far.bench.amplifiers[name])
    ends = [tone.silent_from for output in amplifier.outputs for tone in output]
    return max([amplifier.silent_from, *ends])


def loudness(far: FarSide) -> float:
    """The highest level of any channel now."""
    return max(max(far.summary(name).levels) for name in far.devices)


STARTING = 180.0  # s; for a loaded machine
WATCHDOG, REACTION = 0.25, 0.005  # s; the longest time of an amplifier to be silent


class NotServing(AssertionError):
    """A daemon exited before it served: a bug, or no reply in time on a loaded machine."""


@dataclass
class DaemonProcess:
    """A serving or starting daemon."""

    process: asyncio.subprocess.Process
    socket: Path
    far: FarSide
    log: list[dict[str, object]] = field(default_factory=list)

    async def client(self) -> AsyncClient:
        """Connect a client."""
        return await AsyncClient.connect(self.socket, name="test", timeout=PATIENCE)

    async def status(self) -> int:
        """Wait for its exit status."""
        return await asyncio.wait_for(self.process.wait(), PATIENCE)

    def has_logged(self, text: str) -> bool:
        """Whether a text is in its log."""
        return any(text in json.dumps(line) for line in self.log)

    async def serves(self) -> None:
        """Wait until it serves; raises NotServing if it exits instead."""
        await until(
            lambda: self.has_logged("serving at") or self.process.returncode is not None,
            patience=STARTING,
        )
        if self.process.returncode is not None:
            raise NotServing(str(self.log))


@asynccontextmanager
async def daemon_process(
    folder: Path,
    far: FarSide,
    more: str = "",
    *,
    program: Sequence[str | Path] = (ERA,),
    options: Sequence[str] = (),
    environment: dict[str, str] | None = None,
    changes: Sequence[tuple[str, str]] = (),
    waits: bool = True,
) -> AsyncIterator[DaemonProcess]:
    """Run `era daemon` of a file with these further lines, at most until the context ends.

    program: the command before `daemon`; changes: replacements in the rig's text; waits: until it
    serves.
    """
    save_table(daemon_table(), folder / "table.npz")
    config = write_daemon(folder, dict(far.urls), f"table: table.npz\n{more}", changes=changes)
    process = await asyncio.create_subprocess_exec(
        *(*program, "daemon", str(config), *options),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, **(environment or {})},
    )
    assert process.stderr is not None
    daemon = DaemonProcess(process, folder / "era.sock", far)
    reading = asyncio.create_task(_read_log(process.stderr, daemon.log))
    try:
        if waits:
            await daemon.serves()
        yield daemon
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
        await reading


async def _read_log(stream: asyncio.StreamReader, log: list[dict[str, object]]) -> None:
    while line := await stream.readline():
        try:
            log.append(json.loads(line))
        except ValueError:
            log.append({"no json": line.decode()})


async def run_era(*arguments: object) -> tuple[int, str, str]:
    """Run another `era` command; return exit status, stdout and stderr."""
    process = await asyncio.create_subprocess_exec(
        *(ERA, *map(str, arguments)),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    out, err = await asyncio.wait_for(process.communicate(), 3 * PATIENCE)
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


async def disarmed(era: AsyncClient) -> None:
    """Disarm and wait until ready; a loss of the link disarms as well."""
    with contextlib.suppress(RpcError):
        await era.disarm()
    await ready(era)


async def armed(era: AsyncClient) -> None:
    """Arm; again after a loss of the link, as may happen on a loaded machine."""
    end = time.monotonic() + STARTING
    while (await era.status()).state != ENABLED:
        assert time.monotonic() < end, "cannot be armed"
        await ready(era)
        with contextlib.suppress(RpcError):
            await era.arm("test", lease_s=60)


async def play(era: AsyncClient, far: FarSide) -> None:
    """Arm and wait until the amplifier plays for a resting finger; again after a loss."""
    end = time.monotonic() + STARTING
    while time.monotonic() < end:
        await armed(era)
        with contextlib.suppress(AssertionError):
            await until(lambda: loudness(far) > 0, patience=2.0)
            return
    raise AssertionError("nothing is played")


@asynccontextmanager
async def playing_daemon(
    folder: Path, more: str = "", *, waits: bool = True
) -> AsyncIterator[tuple[DaemonProcess, AsyncClient, Journal]]:
    """A daemon that waits for a busy machine, as of `daemon_process`, and plays for a finger.

    With the client that holds it down, and what the amplifier is asked.
    """
    async with (
        far_end(folder, is_patient=True) as far,
        daemon_process(folder, far, more, program=PROGRAM, waits=waits) as daemon,
    ):
        journal = Journal(far)
        await until(daemon.socket.is_socket)
        async with await daemon.client() as era, holding(era):
            await play(era, far)
            yield daemon, era, journal


async def plays_on(
    subject: str, daemon: DaemonProcess, era: AsyncClient, journal: Journal, *, seconds: float = 0.6
) -> None:
    """Assert that it stays enabled for a period, and tell the widest gap between signs of life.

    By a daemon that waits for a busy machine, see `patient_daemon`. what: the disturbance, for the
    printed figure.
    """
    await play(era, daemon.far)
    begin = time.monotonic()
    while time.monotonic() < begin + seconds:
        assert (await era.status()).state == ENABLED
        await asyncio.sleep(0.05)
    tell(f"between signs of life, {subject}", journal.widest_gap(begin, time.monotonic()))


def tell(subject: str, seconds: float) -> None:
    """Print a measured time; it is not asserted, for other programs on the machine lengthen it."""
    sys.stdout.write(f"\nmeasured: {subject}: {1e3 * seconds:.1f} ms\n")


SESSION = 9


@asynccontextmanager
async def playing(
    url: str, tone: AmplifierTone, *, watchdog: float
) -> AsyncIterator[AmplifierAmplifier]:
    """Open, arm and play without a ramp; watchdog [s]: of which it falls silent after this."""
    lines = Lines()
    try:
        amplifier = await lines.amplifier(url, GuardLimits(40, 500, 1), name=url)
        await amplifier.open()
        await amplifier.arm(SESSION, watchdog)
        layers = [AmplifierLayer(0, (tone,), ramp=0.0)]
        await amplifier.stage(StagedSet(layers), 1, now=True)
        yield amplifier
    finally:
        await lines.close()


class Wire(asyncio.Transport):
    """Transport of a client, of a process by its id, that reads nothing."""

    def __init__(self, process: int = 1) -> None:
        peer = SimpleNamespace(getsockopt=lambda *_: struct.pack("3i", process, 0, 0))
        super().__init__({"socket": peer})
        self.waiting = b""
        self.is_aborted = False
        self.is_read = True

    def lines(self) -> list[dict[str, Any]]:
        """Take the lines that were written, as JSON."""
        lines, self.waiting = self.waiting.splitlines(), b""
        return [json.loads(line) for line in lines]

    def is_closing(self) -> bool:
        """Whether it was closed."""
        return self.is_aborted

    def resume_reading(self) -> None:
        """Note it."""
        self.is_read = True

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Keep the data as unread."""
        self.waiting += bytes(data)

    def get_write_buffer_size(self) -> int:
        """Size of the unread data."""
        return len(self.waiting)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Do nothing."""

    def pause_reading(self) -> None:
        """Note it."""
        self.is_read = False

    def abort(self) -> None:
        """Close."""
        self.is_aborted = True

    close = abort


def request(method: str, params: str = "{}", *, id: str | int | None = None) -> bytes:
    """A line with a request, without an id unless one is given."""
    head = "" if id is None else f'"id":{id},'
    return f'{{"jsonrpc":"2.0",{head}"method":"{method}","params":{params}}}\n'.encode()


class ServedApi:
    """A server in memory; clock [s].

    calls: name, parameters and time of each; is_busy: whether a touch is on its way to the wire;
    may_arm: what arming waits for; called: called with each name, and its exceptions are those of
    the method; stops: how often the server itself has stopped all; holder: who holds the lease.
    """

    def __init__(self, *, clock: Callable[[], float] = lambda: 0.0) -> None:
        self.calls: list[tuple[str, ApiMessage, float]] = []
        self.is_busy = False
        self.may_arm = asyncio.Event()
        self.stops = 0
        self.called: Callable[[str], object] = lambda name: None
        self.clock = clock
        self.holder: Connection | None = None
        self._clients: list[Connection] = []
        self._server = ApiServer(
            {name: partial(self._handle, name) for name in METHODS},
            on_disconnect=lambda client: None,
            holds_lease=lambda client: client is self.holder,
            is_busy=lambda: self.is_busy,
            stop_all=self._stop_all,
            clock=lambda: self.clock(),
        )

    @property
    def names(self) -> list[str]:
        """Names of the methods called."""
        return [name for name, _, _ in self.calls]

    def times(self, method: str) -> list[float]:
        """When a method was called [s]."""
        return [time for name, _, time in self.calls if name == method]

    def client(self, *, process: int = 1) -> tuple[Connection, Wire]:
        """A client of a process."""
        client, wire = Connection(self._server), Wire(process)
        client.connection_made(wire)
        self._clients.append(client)
        return client, wire

    async def takes(self, client: Connection, data: bytes) -> None:
        """Let a client send bytes, and serve what is to be served at once."""
        feed(client, data)
        await self.settle()

    async def settle(self) -> None:
        """Run the event loop until nothing is left to be served at once, and a little longer."""
        turns = 8
        while turns:
            await asyncio.sleep(0)
            turns = 8 if any(client.has_lines for client in self._clients) else turns - 1

    def _stop_all(self) -> None:
        self.stops += 1

    def _handle(
        self, name: str, client: Connection, params: ApiMessage
    ) -> ApiMessage | Awaitable[ApiMessage]:
        self.calls.append((name, params, self.clock()))
        self.called(name)
        if name == "play":
            raise KeyError("a bug, with /a/path in it")
        return self._arm() if name == "arm" else METHODS[name].result.model_construct(state="FAULT")

    async def _arm(self) -> ApiMessage:
        await self.may_arm.wait()
        return Empty()


def serving() -> tuple[ServedApi, Connection, Wire]:
    """A server with one client."""
    served = ServedApi()
    return served, *served.client()
